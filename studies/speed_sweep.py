"""Roll speed against throughput, fineness and pressure: `python -m studies.speed_sweep`."""

from studies.sweep.study import Study, sweep_command

STUDY = Study(
    name="speed_sweep",
    main="roll_speed",
    factors=(0.5, 0.75, 1.0, 1.25, 1.5, 2.0),
    about=(
        "Sweep the roll speed, and further axes if given, and write throughput, fineness and pressure of every "
        "operating point to outputs/speed_sweep.nc and .png. Default: 0.5 to 2 times the scene's speed. In this "
        "model speed changes throughput and nothing else, with exchange between streamlines or without."
    ),
    caption=(
        "Without exchange between streamlines, speed changes throughput and nothing else: crushing and elasticity "
        "(paper eqs. 1, 2, 4) know no rate."
    ),
    exchange_caption=(
        "With exchange, speed still changes throughput and nothing else: swap rates are proportional to the shear "
        "rate, and so to speed, as is every other rate of the model."
    ),
)

main = sweep_command(STUDY)

if __name__ == "__main__":
    raise SystemExit(main())
