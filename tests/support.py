"""What several test files share: scenes of small size, lines of cells, and one call of the crushing kernel."""

import math
from types import SimpleNamespace

import numba
import numpy as np

from hpgr import presets
from hpgr.grains import kernels, solve
from hpgr.grains.kernels import Passage, Path, Record
from hpgr.grains.march import ore
from hpgr.laws.fragments import Fragments
from hpgr.laws.strength import Strength
from hpgr.results.schema import STATUS

SCENE_TOML = """
[rolls]
diameter = "0.8 m"
width = "0.25 m"
gap = "19 mm"
entry_gap = "163 mm"
speed = "16 rpm"

[feed]
kind = "uniform"
bottom_size = "1 mm"
top_size = "20 mm"
"""

COMPILED = not numba.config.DISABLE_JIT

# A Kolmogorov-Smirnov distance above KS / sqrt(samples) happens by chance once in a million tests:
# 2 exp(-2 KS^2) = 1e-6 (the exact probability is smaller for finite samples).
KS = math.sqrt(math.log(2e6) / 2)
SIGMAS = 5  # a normal deviate leaves +-5 sigma once in 1.7 million tests


def sized(full, reduced):
    """Return `full`, or `reduced` where the kernels run as plain Python."""
    return full if COMPILED else reduced


def plain(function):
    """Return the Python function behind a compiled one, whose globals can be monkeypatched."""
    return getattr(function, "py_func", function)


def one_by_one(run_scene):
    """Return what runs cases by `run_scene`, in the place of `hpgr.run.run_together`."""
    return lambda points, seed, beds: [[run_scene(scene, seed, one, beds) for one in each] for scene, each in points]


# An ore between real rolls under the paper's laws, of which closed forms are known: no slip, nothing scatters
_PAPERS_LAWS = {
    "flow.nip_angle": "9.09 deg",
    "flow.slip": 0.0,
    "elasticity.bulk_modulus": 675384000.0,
    "elasticity.shear_modulus": 312633583.03886926,
    "elasticity.exponent": 0.5,
    "elasticity.densification": 0.0,
    "elasticity.recovery_modulus": None,
    "strength.reference_strength": 1570986.6666666667,
    "strength.weibull_modulus": 1.71,
    "strength.scatter": math.inf,
    "strength.cushioning": 0.586,
    "fragments.exponent": 0.372,
    "fragments.size_exponent": 0.0,
}


def plain_pilot():
    """Return the pilot rolls of the preset under the paper's laws, with an idle torque."""
    return presets.khd_pilot().with_values(_PAPERS_LAWS | {"rolls.entry_gap": 0.06, "rolls.idle_torque": 5330.0})


def plain_industrial():
    """Return the industrial rolls of the preset under the paper's laws."""
    return presets.industrial().with_values(_PAPERS_LAWS | {"rolls.gap": 0.055, "rolls.entry_gap": 0.15})


def unmeasured(test, *names):
    """Return a pilot test of which these were not measured."""
    return test._replace(**{name: getattr(test, name) * math.nan for name in names})


def paper(values=None):
    """Return the paper's scene in a small resolution, with other values by dotted name."""
    small = {"resolution.streamlines": 3, "resolution.points": 61, "resolution.cells": 64}
    return presets.paper().with_values(small | (values or {}))


def line(cells, seed=0, low=0.008, high=0.06):
    """Return sizes and streams of a line of cells, sizes uniform in the log."""
    generator = np.random.default_rng(seed)
    sizes = np.exp(generator.uniform(np.log(low), np.log(high), cells)).astype(np.float32)
    return sizes, streams(cells, seed)


def streams(cells, seed=0):
    """Return independent streams of cells."""
    base = int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0])
    return np.array([split_mix(base + (p + 1) * GOLDEN) for p in range(cells)], np.uint64)


def laws(w=3.04, n=1.0, gamma=1.0, reference_size=0.06, floor=1e-6, k=math.inf, nu=0.0):
    """Return the laws of strength and fragments by the symbols of their constants."""
    strength = Strength(weibull_modulus=w, cushioning=n, reference_size=reference_size, scatter=k)
    fragments = Fragments.model_construct(
        exponent=gamma, size_floor=floor, size_exponent=nu
    )  # a floor of 0 is refused elsewhere
    return SimpleNamespace(strength=strength, fragments=fragments)


def march(sizes, streams, log_stress, sieves=(), every=False, kernel=kernels.crush, **constants):
    """March copies of a line through a stress history.

    Returns
    -------
    (sizes, streams, breaks), and with `every` also (sizes, classes) after every step.
    """
    given, log_stress, cells = laws(**constants), np.asarray(log_stress, float), sizes.size
    parcels = kernels.make_parcels(1, cells, scattered=math.isfinite(given.strength.scatter))
    parcels.sizes[0, 1:-1], parcels.streams[0, 1:-1] = sizes, streams
    if parcels.weakness is not None:
        parcels.weakness[0, 1:-1] = weakness(given.strength, streams)
    record = Record(snapshots=np.empty((1, log_stress.size, cells), np.float32)) if every else Record()
    if len(sieves):
        counts = np.empty((1, 1 + log_stress.size, len(sieves) + 1), np.int64)
        record = record._replace(sieves=np.array(sieves, float), counts=counts[:, 0], classes=counts[:, 1:])
    path = Path(log_stress[None], given.strength.critical_size_ratio(log_stress)[None])
    passage = Passage(*np.array([[0], [0], [0], [log_stress.size]]))
    kernel(parcels, passage, path, ore(given), kernels.make_work(cells), record)
    found = parcels.sizes[0, 1:-1], parcels.streams[0, 1:-1], int(parcels.breaks[0])
    return (*found, record.snapshots[0], None if record.classes is None else record.classes[0]) if every else found


def weakness(strength, streams):
    """What scattered strength makes of the effective sizes of cells, by the number after each stream's last."""
    numbers = [((split_mix(split_mix(int(state))) >> 12) + 0.5) / 2**52 for state in streams]
    scale = 3 / strength.weibull_modulus or 1.0
    return np.clip(strength.zeta(np.array(numbers)) ** (-1 / scale), 1e-30, 1e30).astype(np.float32)


def critical_log_stress(critical, w=3.04, reference_size=0.06):
    """Return log(sigma_a / sigma_m) at which grains of size `critical` just break without cushioning."""
    return -(3 / w) * math.log(critical / reference_size)


def ks_distance(sample, distribution):
    """Return the largest distance between the sample's and a continuous distribution function."""
    ordered = np.sort(np.asarray(sample, float))
    exact = distribution(ordered)
    count = np.arange(ordered.size + 1) / ordered.size
    return max(np.max(count[1:] - exact), np.max(exact - count[:-1]))


def lose(result, message, status="failed", **place):
    """Make cases of a sweep's result lost, as a sweep would."""
    for name in result.data_vars:
        if result[name].dtype.kind == "f":
            result[name][place] = np.nan
    result["status"][place] = STATUS[status]
    result["message"] = result["message"].astype(object)
    result["message"][place] = message


def under(stress, time_step=1.0):
    """Return as much of a loaded bed as the grains see, compacting everywhere under a stress in Pa."""
    kinematics = SimpleNamespace(volumetric_rate=np.ones_like(stress), time_step=time_step)
    return SimpleNamespace(kinematics=kinematics, stress=SimpleNamespace(pressure=stress, shear_stress=0 * stress))


def crush(scene, stress, seed=0, replicate=0):
    """Crush a scene without exchange under a given stress (streamline, point), Pa."""
    [[crushed]] = solve.crush([solve.Loaded(scene, under(stress), [replicate])], seed)
    return crushed


def draw(feed, cells, source):
    """Sizes of a parcel as the package draws them, from a SeedSequence."""
    uniforms = np.empty((1, cells))
    bases = source.generate_state(2, np.uint64)[None]
    kernels.start_parcels(bases, ore(laws()), np.zeros(1, int), uniforms, np.empty((1, cells + 2), np.uint64), None)
    return feed.quantile(uniforms[0]).astype(np.float32)


def first_cells(scene, seed, key, line=0):
    """The cells of a parcel of feed, as the model page has it: every bit keyed by seed and key; some keys have lines.

    Written out here in plain Python, so that the product of a scene in which nothing breaks is compared with
    something else.
    """
    cells = scene.resolution.cells
    numbers = np.random.SeedSequence(seed, spawn_key=key).generate_state(2 * line + 2, np.uint64)
    base, state = (int(one) for one in numbers[-2:])
    streams = [split_mix(base + (p + 1) * GOLDEN) for p in range(cells)]
    numbers = ((split_mix(state + k * GOLDEN) >> 12) + 0.5 for k in range(1, 2 * cells))
    order = list(range(cells))
    for p in range(cells - 1, 0, -1):
        q = int(next(numbers) * 2.0**-52 * (p + 1))
        order[p], order[q] = order[q], order[p]
    uniforms = np.array([(stratum + next(numbers) * 2.0**-52) / cells for stratum in order])
    sizes = scene.feed.quantile(uniforms).astype(np.float32)
    return np.maximum(sizes, np.float32(kernels.SMALLEST)), np.array(streams, np.uint64)


GOLDEN = 0x9E3779B97F4A7C15


def split_mix(state):
    """SplitMix64's output for a state, in Python's integers (Steele, Lea & Flood 2014)."""
    z = state % 2**64
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB % 2**64
    return z ^ (z >> 31)
