"""The public face as an editor sees it: read by mypy, never run.

Each comment names an error that must be found; mypy reports a comment without its error as one more.
"""

import hpgr

scene: hpgr.Scene = hpgr.presets.paper().with_values({"rolls.gap": "40 mm"})
dataset = hpgr.simulate(scene, seed=1, tolerance=0.02, max_cost=10.0)
size = hpgr.percentile_size(dataset, 80, total=True)
gap: float = hpgr.operating_gap(scene, "3.5 N/mm^2")
rolls = hpgr.Rolls(diameter=0.8, width=0.25, gap=0.02, entry_gap=0.06, speed=1.6)
speed: float = rolls.speed

hpgr.simulat(scene)  # type: ignore[attr-defined]
hpgr.simulate(scene, sed=1)  # type: ignore[call-arg]
hpgr.simulate("mine.toml")  # type: ignore[arg-type]
hpgr.presets.papr()  # type: ignore[attr-defined]
_ = scene.rols  # type: ignore[attr-defined]
_ = scene.rolls.gapp  # type: ignore[attr-defined]
hpgr.percentile_size(dataset, 80, totl=True)  # type: ignore[call-arg]
