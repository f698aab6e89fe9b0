import gc
from types import SimpleNamespace

import numpy as np
import pytest
from numba.core import event
from support import COMPILED, paper

from hpgr import compiler
from hpgr.bed.loaded import inputs_of, load_bed
from hpgr.grains import kernels

NIP = {"flow.kind": "nip", "flow.nip_angle": "9.1 deg", "flow.slip": 0.2}
SCENES = {
    "paper": {},
    "slow start": {"flow.exponent": 2.0, "flow.entry_fraction": 1e-4, "resolution.points": 300},
    "nip": NIP | {"elasticity.densification": 3.0, "elasticity.substeps": 3},
    "euler": {"elasticity.integrator": "euler", "elasticity.exponent": -0.5},
    "shear held": {"elasticity.exponent": 8.0, "elasticity.shear_modulus": "1 GPa"},
    "no compaction": {"rolls.gap": "60 mm", "rolls.entry_gap": "60.000001 mm"},
}


@pytest.mark.skipif(not COMPILED, reason="compares both")
@pytest.mark.parametrize("values", SCENES.values(), ids=SCENES)
def test_python_fills_the_same_bits_as_compiled_code(values, monkeypatch):
    inputs, rows = inputs_of(paper(values)), np.sort(np.random.default_rng(1).random((5, 100), np.float32))
    found = []
    for few in (np.inf, -1):
        monkeypatch.setattr(compiler, "_FEW", few)
        bed, counts = load_bed(inputs), np.empty((5, 7), int)
        kernels.passing_counts(rows, np.linspace(-0.1, 1.1, 7)[:, None], counts)
        found.append([np.asarray(field).tobytes() for part in (*bed[1:4], [counts]) for field in part])
    assert found[0] == found[1]


def test_a_function_is_compiled_once_it_has_filled_a_few_numbers(monkeypatch):
    monkeypatch.setattr(compiler, "_FEW", 10)
    monkeypatch.setattr(compiler, "compiled", lambda: lambda function: lambda numbers: numbers.fill(2.0))
    ones = compiler._Deferred(lambda numbers: numbers.fill(1.0), {})
    numbers = np.zeros(4)
    assert [ones(numbers) or numbers[0] for _ in range(4)] == [1, 1, 2, 2]


def test_no_garbage_is_collected_while_our_functions_are_compiled():
    ours, other = ({"dispatcher": SimpleNamespace(py_func=each)} for each in (kernels.make_work, event.trigger_event))
    with event.trigger_event("numba:compile", ours):
        with event.trigger_event("numba:compile", ours):  # a function that the first one calls
            pass
        with event.trigger_event("numba:compile", other):
            pass
        assert not gc.isenabled()
    assert gc.isenabled()
    with event.trigger_event("numba:compile", other):
        assert gc.isenabled()
    event.end_event("numba:compile", ours)  # of one that has begun before the package was imported
    gc.disable()
    try:
        with event.trigger_event("numba:compile", ours):
            pass
        assert not gc.isenabled()  # as the user wished
    finally:
        gc.enable()
