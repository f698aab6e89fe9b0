"""simulate(scene) -> Dataset: what a user calls.

Not simulate.py: importing a module of that name would replace the function `hpgr.simulate` by the module.
"""

from typing import Any

import xarray as xr

from hpgr import __version__, budget, machine, pipeline, schema, solve
from hpgr import tolerance as tolerances
from hpgr.keys import refuse_key
from hpgr.pipeline import Prepared
from hpgr.scene import Scene, level_text


def simulate(
    scene: Scene, seed: int = 0, replicate: int = 0, tolerance: float | None = None, max_cost: float = 60.0
) -> xr.Dataset:
    """Simulate the steady machine of `scene`.

    Parameters
    ----------
    scene : Scene
        What is simulated; `scene.resolution.record` decides what is kept.
    seed : int
        Seed of all randomness, at least 0. The same scene and seed give the same bits.
    replicate : int
        Number of an independent repetition with the same seed, at least 0.
    tolerance : float, optional
        Wanted relative error, 1e-4 to 0.5, of P80, the fraction below 1 mm and peak pressure: points, streamlines
        and cells are then chosen so that the estimated error, bias + 2 standard errors, is below it. The Dataset
        then has `p80_total_error`, `fineness_error` and `peak_pressure_error`.
    max_cost : float
        Predicted seconds that meeting the tolerance may take.

    Returns
    -------
    xarray.Dataset
        Dims time (photographs of the steady machine), streamline (mid-plane to roll), point (entry to
        exit), cell and sieve; SI units. `attrs["scene"]` rebuilds the scene with
        `Scene.model_validate_json`; `flags` and `attrs["notes"]` tell which limits were hit.

    Raises
    ------
    ValueError
        If the seed or replicate is not a whole number from 0 to 2**63 - 1, if material points coincide, if exchange
        would need absurdly many passes, if no gap carries the scene's pressing force, or if the tolerance cannot be
        met under `max_cost`.
    MemoryError
        If the scene does not fit this machine's memory; the message has the predicted bytes.

    Examples
    --------
    >>> import hpgr
    >>> scene = hpgr.presets.paper().with_values({"resolution.cells": 200, "resolution.points": 50})
    >>> dataset = hpgr.simulate(scene)
    >>> dict(dataset["size"].sizes)
    {'time': 1, 'streamline': 10, 'point': 50, 'cell': 200}
    """
    refuse_key("seed", seed)
    refuse_key("replicate", replicate)
    chosen = {}
    scene = machine.at_operating_gap(scene)
    if tolerance is not None:
        estimate = tolerances.refine(scene, tolerance, max_cost, seed)
        scene, chosen = machine.at_operating_gap(estimate.scene), estimate.variables()
    budget.refuse_too_large(scene)
    prepared = pipeline.prepare(scene)
    values = pipeline.crush(scene, prepared, seed, replicate)
    notes = values.pop("notes")
    values |= chosen
    return schema.to_dataset(values, _attributes(scene, seed, replicate, prepared) | {"notes": notes})


def _attributes(scene: Scene, seed: int, replicate: int, prepared: Prepared) -> dict[str, Any]:
    return {
        "level": level_text(scene.resolution.level),
        "Conventions": "CF-1.11",
        "title": "Comminution in high pressure grinding rolls, heterarchical model",
        "source": f"hpgr {__version__}",
        "history": f"hpgr {__version__}: simulate(scene, seed={seed}, replicate={replicate})",
        "scene": scene.model_dump_json(),
        "seed": int(seed),
        "replicate": int(replicate),
        "solver": solve.choose(scene),
        "time_step_s": prepared.motion.time_step,
        "streamline_deviation_m": prepared.bed.deviation(),
    }
