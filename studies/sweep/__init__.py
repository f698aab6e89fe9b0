"""Space x replicates -> cases -> dask futures -> one Dataset.

A case is one scene with one replicate number. Finished cases are kept in a folder, if one is given, and read back
instead of being computed again. Whatever a case does, only its own place in the result is left NaN, with its status
and message beside it. What is heavy loads late, for a command's `--help` does without.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from hpgr.fields import check_number, path_of
from hpgr.scene import Scene, check_scene
from studies.sweep.space import Space, SweepSpec, axes_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["sweep"]


def sweep(
    scene: Scene,
    space: "Mapping[Any, Any] | xr.Dataset",
    replicates: int = 1,
    seed: int = 0,
    client: Any = None,
    threads: int = 2,
    progress: bool = False,
    tolerance: float | None = None,
    max_cost: float = 60.0,
    folder: str | Path | None = None,
    recompute: bool = False,
    timeout: float | None = None,
    record: Literal["product", "distributions", "cells"] = "product",
) -> "xr.Dataset":
    """Run `scene` everywhere in `space`, and return the summaries as one Dataset.

    Parameters
    ----------
    scene : Scene
        Base scene; what is recorded of it is `record`. Of a space with scenes of its own only its resolution counts.
    space : mapping or xarray.Dataset
        Scene fields, by dotted or plain name, each with its values: SI numbers, quantities, or text with a unit. Fields
        make a product, as in ``{"gap": ["40 mm", "60 mm"], "feed.top_size": [0.04, 0.06]}``, but for those

        - of a tuple, ``{("gap", "roll_speed"): [("40 mm", 2.0), ("60 mm", 2.5)]}``, which vary together along
          `sample`: lists of operating points, designs (`studies.sweep.space.sobol_design`), posterior samples;
        - of a Dataset, or DataArrays, that share a dimension: they vary together along it.

        ``{"scene": {"soft": one, "hard": other}}`` runs named scenes in turn.
    replicates : int
        Independent repetitions of every case.
    seed : int
        Seed of all randomness. Operating points share their random numbers, so curves are smooth.
    client : distributed.Client, optional
        A dask cluster to run on; default the active client if there is one, or else threads of this process.
    threads : int
        Threads if no client is given.
    progress : bool
        Whether to show on standard error what is read back, the predicted cost, and progress.
    tolerance : float, optional
        Wanted relative error, as in `hpgr.simulate`: every operating point gets a resolution of its own, and
        its estimated errors. Where streamlines differ, variables along them are left out.
    max_cost : float
        Predicted seconds that meeting the tolerance may take at an operating point.
    folder : path, optional
        Where finished cases are kept, for this sweep and later ones; default: nowhere. Cases that it holds already are
        read back. Sweeps may share a folder, also at the same time: none computes what another is computing.
    recompute : bool
        Whether to compute cases that the folder holds already.
    timeout : float, optional
        Seconds that a case may take. Cases then run in processes of their own, so that one that hangs or dies loses
        only itself; starting them takes about 3 s.
    record : {"product", "distributions", "cells"}
        What is kept of every case; other than the product, each case is a file in the folder, and
        `studies.open_cases` opens them together. The result holds the summaries either way.

    Returns
    -------
    xarray.Dataset
        Dims: of the space (gap, press_force, roll_speed, feed_top_size, or section and field; `sample`, `scene`, or the
        user's own), replicate, streamline, sieve. Swept fields are coordinates along them. Every summary variable of
        `hpgr.simulate`; `status` and `message` of every case; of gap, force, speed and feed top size what is held
        fixed, as scalar coordinates. A case that was refused or failed holds NaN. Bits do not depend on threads,
        workers or order, nor on what was read back.

    Raises
    ------
    TypeError
        If `scene` is none.
    ValueError
        If there is no such scene field, or it has no or doubled values, or one that it refuses; if cases are to be
        recorded whole and no folder is given.
    OSError
        If finished cases cannot be kept, or the scheduler is lost; what was kept before is as it was.

    Examples
    --------
    >>> import hpgr
    >>> from studies.sweep import sweep
    >>> base = hpgr.presets.paper().with_values({"resolution.cells": 100, "resolution.points": 50})
    >>> result = sweep(base, {"rolls.gap": ["40 mm", "60 mm"]}, replicates=2)
    >>> dict(result["p80_total"].sizes)
    {'gap': 2, 'replicate': 2}
    """
    check_scene(scene)
    space = Space(axes_of(space), replicates)
    if "rolls.gap" in space.fields and (
        "rolls.specific_pressing_force" in space.fields
        or any(one.rolls.specific_pressing_force for one in space.bases(scene).values())
    ):
        raise ValueError(
            "rolls.gap: got it beside rolls.specific_pressing_force, under which the gap floats; give one of them"
        )
    given = {"seed": seed, "replicates": replicates, "threads": threads, "max_cost": max_cost}
    given |= {name: value for name, value in {"tolerance": tolerance, "timeout": timeout}.items() if value is not None}
    for name, value in given.items():
        check_number(name, value)
    base = scene.with_values({"resolution.record": record})
    if record != "product" and folder is None:
        raise ValueError(f"folder: got None; record={record!r} needs a folder, which takes a file of each case")
    folder = None if folder is None else path_of("folder", folder)
    from studies.sweep import assemble, cases, isolated, run

    if client is not None:
        run.check_client(client)
    spec = SweepSpec(base, seed, tolerance, max_cost, timeout, cases.code_version())
    task = run.run_batch if timeout is None else isolated.run_isolated
    with ExitStack() as stack:
        kept = None if folder is None else stack.enter_context(cases.CaseFolder(folder, recompute))
        plan = run.Plan(spec, space._replace(replicates=int(replicates)), kept)
        result = assemble.assemble(spec, plan.space, run.results(plan, client, threads, task, progress))
        if spec.whole:
            assemble.write_manifest(plan, result)
        return result
