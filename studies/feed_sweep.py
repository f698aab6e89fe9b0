"""Feed top size against throughput, fineness and pressure: `python -m studies.feed_sweep`."""

from studies.sweep.study import Study, sweep_command

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

main = sweep_command(STUDY)

if __name__ == "__main__":
    raise SystemExit(main())
