import pytest
from support import paper

from hpgr import budget, simulate


@pytest.mark.parametrize("record", ["cells", "distributions", "product", "stress only"])
@pytest.mark.parametrize("substeps", [1, 4])
def test_prediction_covers_the_result(record, substeps):
    values = {"resolution.cells": 0} if record == "stress only" else {"resolution.record": record}
    scene = paper(values | {"resolution.photographs": 2})
    cost = budget.predict(scene.with_values({"stress.substeps": substeps}))
    assert cost.bytes >= simulate(scene).nbytes * 0.9  # sieves, scalars and labels are not counted
    assert cost.seconds > 0


def test_prediction_is_near_what_recorded_cells_take():
    scene = paper({"resolution.cells": 1000, "resolution.points": 101})
    assert budget.predict(scene).bytes == pytest.approx(simulate(scene)["size"].nbytes, rel=0.2)


@pytest.mark.parametrize(
    "name", ["resolution.streamlines", "resolution.points", "resolution.cells", "resolution.photographs"]
)
def test_cost_grows_with_every_size(name):
    scene = paper({"resolution.photographs": 2})
    count = {"streamlines": 3, "points": 61, "cells": 64, "photographs": 2}[name.split(".")[1]]
    small, large = budget.predict(scene), budget.predict(scene.with_values({name: 10 * count}))
    assert large.bytes > small.bytes
    assert large.seconds > small.seconds


def test_what_is_not_recorded_costs_less():
    costs = [
        budget.predict(paper({"resolution.cells": 10_000, "resolution.record": record})).bytes
        for record in ("product", "distributions", "cells")
    ]
    assert costs == sorted(costs)
    assert budget.predict(paper({"resolution.cells": 0})).bytes < costs[0]


def test_scene_beyond_the_memory_is_refused_with_bytes_bound_and_remedy(monkeypatch):
    scene = paper()
    needed = budget.predict(scene).bytes
    monkeypatch.setattr(budget, "available_memory", lambda: (needed, "physical memory"))
    with pytest.raises(MemoryError) as error:
        budget.refuse_too_large(scene)
    text = str(error.value)
    assert text.startswith("resolution.cells: got 64 cells x 61 points x 3 streamlines, recording cells")
    for words in (
        f"predicted {needed:,} bytes",
        f"80% of the {needed:,} bytes that physical memory",
        "record 'product'",
    ):
        assert words in text
    monkeypatch.setattr(budget, "available_memory", lambda: (2 * needed, "physical memory"))
    budget.refuse_too_large(scene)


def test_largest_scene_is_refused():
    largest = {
        "resolution.streamlines": 10_000,
        "resolution.points": 10_000_000,
        "resolution.cells": 2_000_000_000,
        "resolution.photographs": 1_000_000,
        "stress.substeps": 10_000,
    }
    for values in (largest, largest | {"resolution.cells": 0}):
        with pytest.raises(MemoryError, match="predicted"):
            budget.refuse_too_large(paper(values))


def test_the_tightest_limit_counts(monkeypatch, tmp_path):
    limit, used = tmp_path / "max", tmp_path / "current"
    limit.write_text("1000\n")
    used.write_text("400\n")
    monkeypatch.setattr(budget, "_CGROUP_FILES", ((limit, used),))
    assert budget.available_memory() == (600, "the cgroup's memory limit")
    limit.write_text("max\n")
    available, name = budget.available_memory()
    assert name == "physical memory"
    assert available > 600
    monkeypatch.setattr(budget, "_CGROUP_FILES", ((tmp_path / "none", used),))
    assert budget.available_memory()[1] == "physical memory"
