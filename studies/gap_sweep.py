"""Gap against throughput, fineness and pressure: `python -m studies.gap_sweep`."""

from studies.sweep.study import Study, sweep_command

STUDY = Study(
    name="gap_sweep",
    main="gap",
    factors=(0.5, 2 / 3, 5 / 6, 1.0, 4 / 3, 5 / 3),
    about=(
        "Sweep the gap between the rolls, and further axes if given, and write throughput, fineness and pressure "
        "of every operating point to outputs/gap_sweep.nc and .png. Default: 0.5 to 1.67 times the scene's gap, or "
        "evenly less, so that the narrowest carries at most twice the force of the scene's own."
    ),
    caption="While the gap varies, the entry gap is held: the modelled bed reaches up to the same place.",
)

main = sweep_command(STUDY)

if __name__ == "__main__":
    raise SystemExit(main())
