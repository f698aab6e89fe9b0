"""Population balance models that users compare with, fitted to pilot tests and predicting others.

Torres & Casali, "A novel approach for the modelling of high-pressure grinding rolls", Minerals Engineering
22 (2009) 1137-1146: the roll width in blocks, each a plug flow through the nip whose breakage rates go
with the block's power.

Hinde & Kalala, "The application of a simplified approach to modelling tumbling mills, stirred media mills
and HPGRs", Minerals Engineering 22 (2009) 633-641: what is retained on a sieve decays exponentially with
specific energy.

SI in and out; size distributions are fractions passing on the sieves of a `PilotTest`, which rise. Classes run from
coarse to fine: between the sieves, and below the finest.

Examples
--------
>>> import hpgr
>>> from hpgr.baselines import fit_hinde_kalala, fit_torres_casali
>>> from hpgr.tables import read_pilot_tests
>>> folder, scene = hpgr.presets.DATA, hpgr.presets.khd_pilot()
>>> tests = read_pilot_tests(folder / "khd_porphyry_psd.csv", folder / "khd_porphyry_operations.csv")
>>> round(fit_torres_casali(tests[:1], scene).predict(tests[0]).throughput * 3.6, 1)  # t/h
32.9
>>> round(fit_hinde_kalala(tests[:1], scene).predict(tests[0]).specific_energy / 3600, 2)  # kWh/t, 1.44 were measured
1.44
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import optimize

from hpgr.calibration import PARTS, Prediction, measured
from hpgr.laws.flow import cake_nip_angle, densest_ratio
from hpgr.scene import Scene
from hpgr.tables import PilotTest

_EVALUATIONS = 150  # per start, without those for derivatives; the pilot tests take 10 to 35
_LOGARITHMIC = {"selection", "rate"}  # fitted by their logarithm


class Machine(NamedTuple):
    """Rolls and densities, as the model of Torres & Casali takes them from outside."""

    diameter: float  # D, m
    width: float  # L, m
    solid_density: float  # kg m-3
    bulk_density: float  # of the feed at the nip, kg m-3
    cake_density: float  # of the cake leaving the gap, kg m-3


class TorresCasali(NamedTuple):
    """Parameters of the Torres & Casali model.

    A fragment of a particle from the class above x_2 is finer than x with the chance
    a1 (x/x_2)^a2 + (1 - a1) (x/x_2)^a3. A class of size x breaks at the rate per specific energy
    ln(S/S_1) = zeta1 ln(x/x_1) + zeta2 ln(x/x_1)^2.
    """

    fine_share: float  # a1
    fine_exponent: float  # a2
    coarse_exponent: float  # a3
    selection: float  # S_1, kg J-1 (1 t/kWh is 1/3600 kg/J)
    slope: float  # zeta1
    curvature: float  # zeta2
    edge_share: float = 0.2  # fraction of the product that is called edge; told by centre and edge alone


class HindeKalala(NamedTuple):
    """Parameters of the Hinde & Kalala model as read here; see `fit_hinde_kalala`.

    The rate per specific energy at which what is retained on the sieve x decays is
    K(x) = rate [(1 - bend) (x/x_1)^exponent + bend (x/x_1)^coarse_exponent].
    """

    rate: float  # K(x_1), kg J-1
    exponent: float
    bend: float  # 0..1
    coarse_exponent: float
    edge_share: float = 0.2  # fraction of the product that is called edge; this and the next told by centre and edge
    edge_energy: float = 0.5  # specific energy of the edge / mean specific energy


class TorresCasaliModel(NamedTuple):
    """The Torres & Casali model of one machine."""

    machine: Machine
    reference_size: float  # x_1, m
    opening: str = "cake_thickness"  # which thickness holds the cake density; the model has no equation for either
    force: str = "hydraulic_pressure"  # the published F = R_p (D/2) L; or "specific_pressing_force", F = Fsp D L
    blocks: int = 10

    def predict(self, parameters: TorresCasali, test: PilotTest) -> Prediction:
        """Return products, throughput, power and specific energy of `test`, from its feed, speed, opening and force.

        Every feed is treated as fed to the particle bed: single particles nipped above it are not modelled.
        """
        for name in (self.opening, self.force):
            if math.isnan(getattr(test, name)):
                raise ValueError(f"test {test.name}, {name}: not measured; the model needs it; measure it")
        rolls, opening, speed = self.machine, getattr(test, self.opening), test.surface_speed
        if self.force == "hydraulic_pressure":
            newtons = test.hydraulic_pressure * rolls.diameter / 2 * rolls.width  # printed 100 R_p (D/2) L, bar and kN
        else:
            newtons = test.specific_pressing_force * rolls.diameter * rolls.width
        flow = rolls.cake_density * opening * rolls.width * speed
        watts = 2 * newtons * math.sin(nip_angle(rolls, opening) / 2) * speed
        energies = watts / flow * self.blocks * power_shares(self.blocks)
        masses = block_products(parameters, test.sizes, test.feed, energies, self.reference_size)
        passing = {name: np.cumsum(part[::-1]) for name, part in combine(masses, parameters.edge_share).items()}
        return Prediction(math.nan, flow, watts, watts / flow, **passing)


class HindeKalalaModel(NamedTuple):
    """The Hinde & Kalala model."""

    reference_size: float  # x_1, m
    energy_per_force: float  # specific energy / specific pressing force, J kg-1 Pa-1

    def predict(self, parameters: HindeKalala, test: PilotTest) -> Prediction:
        """Return products and specific energy of `test`, from its feed and specific pressing force only.

        The model says nothing of throughput and power: they are NaN, as is the gap in both models. As a population
        balance: a class between the sieves x_j > x_{j+1} breaks at the rate K(x_{j+1}), the decay of the sieve below
        it, and of what breaks the share K(x)/K(x_{j+1}) passes the sieve x. With rates and fragments so tied
        ("compensation") the cumulative balance has the exact solution R(x, E) = R(x, 0) exp(-K(x) E).
        """
        energy = self.energy_per_force * test.specific_pressing_force
        share, ratio = parameters.edge_share, parameters.edge_energy
        rates = decay(parameters, test.sizes, self.reference_size)
        centre, edge = (
            1 - (1 - test.feed) * np.exp(-rates * each)
            for each in (energy * (1 - share * ratio) / (1 - share), energy * ratio)
        )
        total = share * edge + (1 - share) * centre
        return Prediction(math.nan, math.nan, math.nan, energy, centre, edge, total)


class Fit(NamedTuple):
    """A model fitted to tests."""

    model: TorresCasaliModel | HindeKalalaModel
    parameters: TorresCasali | HindeKalala
    rmse: float  # of the fit, percent passing over all measured curves
    constants: tuple[str, ...]  # parameters that were fitted

    def predict(self, test: PilotTest) -> Prediction:
        """Return what the model says of a test."""
        return self.model.predict(self.parameters, test)


# lowest and highest value that a fit may take, and its starts: the published porphyry first, the others around it
_SEARCHES = {
    TorresCasali: (
        TorresCasali(1e-6, 0.01, 0.5, 1e-7, -2.0, -2.0, 0.01),
        TorresCasali(1.0, 5.0, 30.0, 1e-1, 5.0, 0.3, 0.6),
        (
            TorresCasali(0.20, 0.20, 3.51, 0.66 / 3600, -1.26, -0.70, 0.22),
            TorresCasali(0.40, 0.40, 3.0, 1.0 / 3600, 0.0, -0.1, 0.2),
            TorresCasali(0.70, 0.60, 5.0, 2.0 / 3600, 0.5, 0.0, 0.2),
            TorresCasali(0.10, 0.30, 1.5, 0.5 / 3600, -1.0, -0.3, 0.3),
        ),
    ),
    HindeKalala: (
        HindeKalala(1e-7, 0.01, 0.0, 0.1, 0.01, 0.01),
        HindeKalala(1e-1, 5.0, 1.0, 10.0, 0.6, 1.0),
        (
            HindeKalala(2.0 / 3600, 0.4, 0.5, 2.0, 0.2, 0.5),
            HindeKalala(5.0 / 3600, 0.6, 0.9, 3.0, 0.15, 0.3),
            HindeKalala(0.5 / 3600, 0.8, 0.1, 1.5, 0.3, 0.8),
        ),
    ),
}


def fit_torres_casali(tests: Sequence[PilotTest], scene: Scene) -> Fit:
    """Fit the Torres & Casali model to the measured size distributions of `tests` by least squares.

    Rolls and densities are the scene's, or the first test's where it tells them; the cake's density is that of the
    throughput through the measured opening. The force is the hydraulic pressure's where that was measured. ValueError
    if there are no tests, or a test has no opening.
    """
    _refuse_none(tests)
    opening = "gap" if any(math.isnan(test.cake_thickness) for test in tests) else "cake_thickness"
    pressed = all(math.isfinite(test.hydraulic_pressure) for test in tests)
    force = "hydraulic_pressure" if pressed else "specific_pressing_force"
    coarsest = max(coarsest_class(test.sizes) for test in tests)
    model = TorresCasaliModel(_machine_of(tests, scene, opening), coarsest, opening, force)
    return _least_squares(model, tests, TorresCasali)


def _machine_of(tests: Sequence[PilotTest], scene: Scene, opening: str) -> Machine:
    told = tests[0].diameter, tests[0].width, tests[0].solid_density
    own = scene.rolls.diameter, scene.rolls.width, scene.bed.solid_density
    diameter, width, solid = np.where(np.isnan(told), own, told).tolist()
    cakes = [test.throughput / (getattr(test, opening) * width * test.surface_speed) for test in tests]
    known = [cake for cake in cakes if math.isfinite(cake)]
    cake = sum(known) / len(known) if known else 0.85 * solid
    return Machine(diameter, width, solid, solid * scene.bed.feed_solid_fraction, cake)


def fit_hinde_kalala(tests: Sequence[PilotTest], scene: Scene) -> Fit:
    """Fit the Hinde & Kalala model to the measured size distributions of `tests` by least squares.

    The article's printed equations could not be consulted: this is a reading of its approach. What is retained on a
    sieve decays exponentially with specific energy; that the rate is the sum of two powers of size (`decay`) is chosen
    here. Two things are additions of this package. The edge, a share of the product, sees `edge_energy` times the mean
    specific energy, the centre what is left. The specific energy is energy_per_force * specific pressing force, its
    constant fitted to the specific energies of `tests` by least squares, also where one was measured. Nothing is taken
    of the `scene`. ValueError if there are no tests, or none with a specific energy.
    """
    _refuse_none(tests)
    pairs = [(test.specific_pressing_force, measured(test, "specific_energy").item()) for test in tests]
    pairs = [(force, energy) for force, energy in pairs if not math.isnan(energy)]
    if not pairs:
        raise ValueError("specific_energy: got no measured one; one test must have it, or power and throughput; add it")
    force, energy = np.array(pairs).T
    model = HindeKalalaModel(float(max(test.sizes[-1] for test in tests)), float(force @ energy / (force @ force)))
    found = _least_squares(model, tests, HindeKalala)
    ore = found.parameters
    if ore.exponent > ore.coarse_exponent:  # the powers may come out in either order
        turned = {"exponent": ore.coarse_exponent, "coarse_exponent": ore.exponent, "bend": 1 - ore.bend}
        found = found._replace(parameters=ore._replace(**turned))
    return found


MODELS = {"Torres & Casali": fit_torres_casali, "Hinde & Kalala": fit_hinde_kalala}


def _refuse_none(tests: Sequence[PilotTest]) -> None:
    if not tests:
        raise ValueError("tests: got none; a fit needs at least one; give those to calibrate on")


# ---- equations of Torres & Casali


def nip_angle(machine: Machine, opening: float) -> float:
    """Return the angle (rad) at which the feed's bulk density begins to be compacted to the cake.

    ValueError if none does that, because the opening is too wide for the rolls.
    """
    dense = machine.cake_density / machine.bulk_density
    if dense > densest_ratio(opening, machine.diameter):
        raise ValueError(
            f"opening: got {opening:g} m; rolls of {machine.diameter:g} m cannot nip so much at a cake density "
            f"{dense:g} times the bulk density; give a smaller opening"
        )
    return cake_nip_angle(opening, machine.diameter, dense)


def power_shares(blocks: int) -> np.ndarray:
    """Return the (block,) shares of the power: parabolic across the width, zero at its two ends."""
    y = (2 * np.arange(1, blocks + 1) - blocks - 1) / blocks  # 2 y_k / L
    weight = 1 - y**2
    return weight / weight.sum()


def breakage(parameters: TorresCasali, sizes: np.ndarray) -> np.ndarray:
    """Return b (class, class): the share of what breaks in class j, the column, that lands in class i.

    The fragments of class j all pass its lower sieve: b_ij = B(top of i / bottom of j) - B(bottom of i / bottom of j).
    With sieves in one ratio that is the printed B_{i-j+1} - B_{i-j+2}. Every column but the last adds up to 1.
    """
    sieves = np.asarray(sizes, dtype=float)[::-1]
    ratio = sieves[:, None] / np.append(sieves[1:], np.inf)  # (top of class i, bottom of class j)
    finer = parameters.fine_share * ratio**parameters.fine_exponent
    finer += (1 - parameters.fine_share) * ratio**parameters.coarse_exponent
    below = np.vstack([finer[1:], np.zeros(len(sieves))])
    return np.tril(finer - below, -1)


def selection(parameters: TorresCasali, sizes: np.ndarray, reference_size: float) -> np.ndarray:
    """Return the rates per specific energy (class,), kg J-1; the class below the sieves is kept."""
    sieves = np.asarray(sizes, dtype=float)[::-1]
    log = np.log(np.sqrt(sieves[:-1] * sieves[1:]) / reference_size)
    return np.append(parameters.selection * np.exp(parameters.slope * log + parameters.curvature * log**2), 0.0)


def coarsest_class(sizes: np.ndarray) -> float:
    """Return the geometric mean (m) of the two coarsest sieves, the x_1 of the selection function."""
    return math.sqrt(sizes[-1] * sizes[-2])


def block_products(parameters: TorresCasali, sizes, feed, specific_energy, reference_size: float) -> np.ndarray:
    """Return the masses (block, class) that leave blocks of given specific energy (J kg-1).

    Along z the plug flow obeys v_z dm_i/dz = sum_{j<i} S_jk b_ij m_j - S_ik m_i with S_ik = S_i P_k/H_k
    over z* = (D/2) sin(nip angle). With H_k = Q z*/(U N) and v_z = U, z* cancels: the whole path is the
    exponential of the block's specific energy P_k N/Q times one matrix.
    """
    rates = selection(parameters, sizes, reference_size)
    matrix = breakage(parameters, sizes) * rates - np.diag(rates)
    masses = -np.diff(np.asarray(feed)[::-1], append=0.0)
    energies, which = np.unique(specific_energy, return_inverse=True)  # the two halves of the width are alike
    return (_exponentials(energies[:, None, None] * matrix) @ masses)[which]


def _exponentials(matrices: np.ndarray) -> np.ndarray:
    """Return the exponentials of a stack of matrices, by scaling, 14 terms of the series, and squaring.

    scipy.linalg.expm walks through a stack one matrix after another: 6 times slower here, and a fit is
    little else.
    """
    squarings = max(0, math.ceil(math.log2(np.abs(matrices).sum(axis=-2).max() / 0.5 + 1e-300)))
    scaled, one = matrices / 2.0**squarings, np.eye(matrices.shape[-1])
    result = one + scaled / 14  # the first term left out is 0.5**15 / 15! = 2e-17
    for term in range(13, 0, -1):
        result = one + scaled @ result / term
    for _ in range(squarings):
        result = result @ result
    return result


def edge_weights(blocks: int, edge_share: float) -> np.ndarray:
    """Return the (block,) weights of the edge product: half its share of the mass from each end."""
    left = np.clip(edge_share * blocks / 2 - np.arange(blocks), 0.0, 1.0)
    weight = left + left[::-1]
    return weight / weight.sum()


def combine(blocks: np.ndarray, edge_share: float) -> dict[str, np.ndarray]:
    """Return what the product of equal blocks (block, class) is at the centre, at the edge and in total."""
    total = blocks.mean(axis=0)
    edge = edge_weights(len(blocks), edge_share) @ blocks
    return {"centre": (total - edge_share * edge) / (1 - edge_share), "edge": edge, "total": total}


# ---- equation of Hinde & Kalala


def decay(parameters: HindeKalala, sizes: np.ndarray, reference_size: float) -> np.ndarray:
    """Return K (size,), kg J-1: it never falls with size, so that nothing can leave a class upwards."""
    ratio = np.asarray(sizes) / reference_size
    fine = (1 - parameters.bend) * ratio**parameters.exponent
    return parameters.rate * (fine + parameters.bend * ratio**parameters.coarse_exponent)


# ---- fitting


def _least_squares(model, tests, kind) -> Fit:
    """Return the best fit over all starts; what only centre and edge tell keeps its usual value without them."""
    low, high, starts = _SEARCHES[kind]
    apart = any(np.isfinite(test.centre).any() or np.isfinite(test.edge).any() for test in tests)
    free = [name for name in kind._fields if apart or name not in kind._field_defaults]

    def parameters(vector):
        pairs = zip(free, vector, strict=True)
        return kind(**{name: math.exp(x) if name in _LOGARITHMIC else float(x) for name, x in pairs})

    def place_of(values):
        return [math.log(getattr(values, n)) if n in _LOGARITHMIC else getattr(values, n) for n in free]

    def residuals(vector):
        """Return model minus measurement in percent passing wherever there is one."""
        found = parameters(vector)
        pairs = [(model.predict(found, test), test) for test in tests]
        off = np.hstack([100 * (getattr(one, name) - getattr(test, name)) for one, test in pairs for name in PARTS])
        return off[~np.isnan(off)]

    ends = (place_of(low), place_of(high))
    options = {"bounds": ends, "x_scale": "jac", "xtol": 1e-10, "ftol": 1e-10, "max_nfev": _EVALUATIONS}
    fits = [optimize.least_squares(residuals, place_of(start), **options) for start in starts]
    best = min(fits, key=lambda fit: fit.cost)
    return Fit(model, parameters(best.x), float(np.sqrt(np.mean(best.fun**2))), tuple(free))
