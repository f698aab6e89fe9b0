"""Gap against throughput, fineness and pressure: `python -m studies.gap_sweep`."""

from collections.abc import Sequence

from studies.command import Study, run

STUDY = Study(
    name="gap_sweep",
    main="gap",
    factors=(0.5, 2 / 3, 5 / 6, 1.0, 4 / 3, 5 / 3),
    about=(
        "Sweep the gap between the rolls, and further axes if given, and write throughput, fineness and pressure "
        "of every operating point to outputs/gap_sweep.nc and .png. Default: 0.5 to 1.67 times the scene's gap."
    ),
    caption="While the gap varies, the entry gap is held: the modelled bed reaches up to the same place.",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study and return its exit code; `arguments` default to the command line's."""
    return run(STUDY, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
