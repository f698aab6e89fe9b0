"""Feed top size against throughput, fineness and pressure: `python -m studies.feed_sweep`."""

from collections.abc import Sequence

from studies.command import Study, run

STUDY = Study(
    name="feed_sweep",
    main="feed_top_size",
    factors=(0.4, 0.6, 0.8, 1.0),
    about=(
        "Sweep the top size of the feed, and further axes if given, and write throughput, fineness and pressure of "
        "every operating point to outputs/feed_sweep.nc and .png. Default: 0.4 to 1 times the scene's top size."
    ),
    caption=(
        "The size of the feed acts on the product only: the bed's pressure and throughput do not depend on it "
        "in this model."
    ),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study and return its exit code; `arguments` default to the command line's."""
    return run(STUDY, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
