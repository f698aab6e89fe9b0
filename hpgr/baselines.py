"""Population balance models that users compare with, fitted to pilot tests and predicting others.

Torres & Casali, "A novel approach for the modelling of high-pressure grinding rolls", Minerals Engineering
22 (2009) 1137-1146: the roll width in blocks, each a plug flow through the nip whose breakage rates go
with the block's power.

Hinde & Kalala, "The application of a simplified approach to modelling tumbling mills, stirred media mills
and HPGRs", Minerals Engineering 22 (2009) 633-641: what is retained on a sieve decays exponentially with
specific energy.

SI in and out; size distributions are fractions passing on the sieves of a `PilotTest`, which rise.
"""

import difflib
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from scipy import optimize

from hpgr.tables import PilotTest

PRODUCTS = ("centre", "edge", "total")


class Machine(NamedTuple):
    """Rolls and densities, as both models take them from outside."""

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
    edge_share: float  # fraction of the product that is called edge


class HindeKalala(NamedTuple):
    """Parameters of the Hinde & Kalala model as read here; see `fit_hinde_kalala`.

    The rate per specific energy at which what is retained on the sieve x decays is
    K(x) = rate [(1 - bend) (x/x_1)^exponent + bend (x/x_1)^coarse_exponent].
    """

    rate: float  # K(x_1), kg J-1
    exponent: float
    bend: float  # 0..1
    coarse_exponent: float
    edge_share: float  # fraction of the product that is called edge
    edge_energy: float  # specific energy of the edge / mean specific energy


class Prediction(NamedTuple):
    """What a model says of a test, on the sieves of that test; NaN is "the model does not say"."""

    sizes: np.ndarray  # (size,) m, rising
    centre: np.ndarray  # (size,) fraction passing
    edge: np.ndarray
    total: np.ndarray
    throughput: float  # kg s-1
    power: float  # W
    specific_energy: float  # J kg-1


# ---------------------------------------------------------------------------------------------------
# Torres & Casali


def nip_angle(machine: Machine, opening: float) -> float:
    """Return the angle (rad) at which the feed's bulk density begins to be compacted to the cake.

    The gap there holds at the bulk density what `opening` (m) holds at the cake's:
    bulk_density [opening + D (1 - cos a)] cos a = cake_density opening.

    Raises
    ------
    ValueError
        If no angle does that, because the opening is too wide for the rolls.

    Examples
    --------
    >>> import math
    >>> from hpgr.baselines import Machine, nip_angle
    >>> pilot = Machine(0.8, 0.25, 2740.0, 1630.0, 2300.0)
    >>> round(math.degrees(nip_angle(pilot, 0.0237)), 1)
    9.1
    """
    wide = opening + machine.diameter
    root = wide**2 - 4 * opening * machine.diameter * machine.cake_density / machine.bulk_density
    if root < 0:
        raise ValueError(
            f"opening: got {opening:g} m; rolls of {machine.diameter:g} m cannot nip so much at a cake density "
            f"{machine.cake_density / machine.bulk_density:g} times the bulk density; give a smaller opening"
        )
    return math.acos((wide + math.sqrt(root)) / (2 * machine.diameter))


def throughput(machine: Machine, opening: float, speed: float) -> float:
    """Return cake_density * opening * width * speed (kg s-1).

    Examples
    --------
    >>> from hpgr.baselines import Machine, throughput
    >>> pilot = Machine(0.8, 0.25, 2740.0, 1630.0, 2300.0)
    >>> round(throughput(pilot, opening=0.0237, speed=0.67), 2)  # kg/s
    9.13
    """
    return machine.cake_density * opening * machine.width * speed


def pressing_force(machine: Machine, hydraulic_pressure: float) -> float:
    """Return F = R_p (D/2) L (N), which is the printed 100 R_p (D/2) L with bar and kN.

    Examples
    --------
    >>> from hpgr.baselines import Machine, pressing_force
    >>> pilot = Machine(0.8, 0.25, 2740.0, 1630.0, 2300.0)
    >>> round(pressing_force(pilot, hydraulic_pressure=41e5))  # N
    410000
    """
    return hydraulic_pressure * machine.diameter / 2 * machine.width


def power(force: float, angle: float, speed: float) -> float:
    """Return 2 F sin(angle/2) U (W) of both rolls.

    Examples
    --------
    >>> import math
    >>> from hpgr.baselines import power
    >>> round(power(force=410e3, angle=math.radians(9.1), speed=0.67))  # W
    43583
    """
    return 2 * force * math.sin(angle / 2) * speed


def power_shares(blocks: int) -> np.ndarray:
    """Return the (block,) shares of the power: parabolic across the width, zero at its two ends.

    Examples
    --------
    >>> from hpgr.baselines import power_shares
    >>> power_shares(3) * 19
    array([5., 9., 5.])
    """
    y = (2 * np.arange(1, blocks + 1) - blocks - 1) / blocks  # 2 y_k / L
    weight = 1 - y**2
    return weight / weight.sum()


def breakage(parameters: TorresCasali, sizes: np.ndarray) -> np.ndarray:
    """Return b (class, class): the share of what breaks in class j, the column, that lands in class i.

    Classes run from coarse to fine: between the sieves, and below the finest. The fragments of class j
    all pass its lower sieve: b_ij = B(top of i / bottom of j) - B(bottom of i / bottom of j). With sieves
    in one ratio that is the printed B_{i-j+1} - B_{i-j+2}. Every column but the last adds up to 1.

    Examples
    --------
    >>> from hpgr.baselines import TorresCasali, breakage
    >>> ore = TorresCasali(0.5, 1.0, 1.0, 1e-4, 0.0, 0.0, 0.2)  # fragments uniform in size
    >>> breakage(ore, [1e-3, 2e-3, 4e-3])
    array([[0. , 0. , 0. ],
           [0.5, 0. , 0. ],
           [0.5, 1. , 0. ]])
    """
    sieves = np.asarray(sizes, dtype=float)[::-1]
    ratio = sieves[:, None] / np.append(sieves[1:], np.inf)  # (top of class i, bottom of class j)
    finer = parameters.fine_share * ratio**parameters.fine_exponent
    finer += (1 - parameters.fine_share) * ratio**parameters.coarse_exponent
    below = np.vstack([finer[1:], np.zeros(len(sieves))])
    return np.tril(finer - below, -1)


def selection(parameters: TorresCasali, sizes: np.ndarray, reference_size: float) -> np.ndarray:
    """Return the rates per specific energy (class,), kg J-1, coarse to fine; the class below the sieves is kept.

    Examples
    --------
    >>> from hpgr.baselines import TorresCasali, coarsest_class, selection
    >>> ore = TorresCasali(0.5, 1.0, 1.0, 1e-4, 1.0, 0.0, 0.2)  # in proportion to size
    >>> selection(ore, [1e-3, 2e-3, 4e-3], reference_size=coarsest_class([1e-3, 2e-3, 4e-3]))
    array([1.e-04, 5.e-05, 0.e+00])
    """
    sieves = np.asarray(sizes, dtype=float)[::-1]
    log = np.log(np.sqrt(sieves[:-1] * sieves[1:]) / reference_size)
    return np.append(parameters.selection * np.exp(parameters.slope * log + parameters.curvature * log**2), 0.0)


def coarsest_class(sizes: np.ndarray) -> float:
    """Return the geometric mean (m) of the two coarsest sieves, the x_1 of the selection function.

    Examples
    --------
    >>> from hpgr.baselines import coarsest_class
    >>> round(coarsest_class([1e-3, 4.0, 9.0]), 3)
    6.0
    """
    return math.sqrt(sizes[-1] * sizes[-2])


def block_products(parameters, sizes, feed, specific_energy, reference_size) -> np.ndarray:
    """Return the masses (block, class), coarse to fine, that leave blocks of given specific energy (J kg-1).

    Along z the plug flow obeys v_z dm_i/dz = sum_{j<i} S_jk b_ij m_j - S_ik m_i with S_ik = S_i P_k/H_k
    over z* = (D/2) sin(nip angle). With H_k = Q z*/(U N) and v_z = U, z* cancels: the whole path is the
    exponential of the block's specific energy P_k N/Q times one matrix.

    Examples
    --------
    >>> import numpy as np
    >>> from hpgr.baselines import TorresCasali, block_products
    >>> ore = TorresCasali(0.5, 1.0, 1.0, 1e-4, 1.0, 0.0, 0.2)
    >>> energies = np.array([0.0, 5000.0])  # J/kg, of two blocks
    >>> block_products(ore, [1e-3, 2e-3, 4e-3], [0.0, 0.0, 1.0], energies, 2.8e-3).round(2)
    array([[1.  , 0.  , 0.  ],
           [0.6 , 0.17, 0.22]])
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
    """Return the (block,) weights of the edge product: half its share of the mass from each end.

    Examples
    --------
    >>> from hpgr.baselines import edge_weights
    >>> edge_weights(3, 0.21)
    array([0.5, 0. , 0.5])
    """
    left = np.clip(edge_share * blocks / 2 - np.arange(blocks), 0.0, 1.0)
    weight = left + left[::-1]
    return weight / weight.sum()


def combine(blocks: np.ndarray, edge_share: float) -> dict[str, np.ndarray]:
    """Return what the product of equal blocks (block, class) is at the centre, at the edge and in total.

    Examples
    --------
    >>> import numpy as np
    >>> from hpgr.baselines import combine
    >>> found = combine(np.array([[1.0, 0.0], [0.2, 0.8], [1.0, 0.0]]), edge_share=0.2)
    >>> found["edge"], found["total"].round(2)
    (array([1., 0.]), array([0.73, 0.27]))
    """
    total = blocks.mean(axis=0)
    edge = edge_weights(len(blocks), edge_share) @ blocks
    return {"centre": (total - edge_share * edge) / (1 - edge_share), "edge": edge, "total": total}


class TorresCasaliFit(NamedTuple):
    """Fitted Torres & Casali model of one machine."""

    parameters: TorresCasali
    machine: Machine
    reference_size: float  # x_1, m
    blocks: int
    opening: str
    force: str
    rmse: float  # of the fit, percent passing over all measured curves
    at_bounds: tuple[str, ...]  # fitted parameters that stopped at the end of their range
    settled: bool  # False if the search ran out of evaluations before it came to rest

    def predict(self, test: PilotTest) -> Prediction:
        """Return products, throughput, power and specific energy of `test`.

        Of the test its sieves, feed, speed, opening and force are taken, nothing that was measured of
        product, throughput or power. The published model has no equation for the gap either: the
        opening, cake thickness or working gap, is the one measured.
        """
        _refuse(_operating_faults(test, self.opening, self.force))
        return _torres_casali(
            self.parameters, self.machine, test, self.reference_size, self.blocks, self.opening, self.force
        )


def fit_torres_casali(
    tests: Sequence[PilotTest],
    machine: Machine,
    fixed: Mapping[str, float] | None = None,
    *,
    blocks: int = 10,
    opening: Literal["cake_thickness", "gap"] = "cake_thickness",
    force: Literal["hydraulic_pressure", "specific_pressing_force"] = "hydraulic_pressure",
) -> TorresCasaliFit:
    """Fit the Torres & Casali model to the measured size distributions of `tests` by least squares.

    Every feed is treated as fed to the particle bed: single particles nipped above it are not modelled.

    Parameters
    ----------
    fixed
        Parameters of `TorresCasali`, by name, that are not fitted.
    blocks
        Number of blocks across the roll width.
    opening
        Which measured thickness holds the cake density: the flake's or the working gap.
    force
        "hydraulic_pressure" for the published F = R_p (D/2) L; "specific_pressing_force" for F = Fsp D L.

    Raises
    ------
    ValueError
        If tests, machine or fixed parameters cannot be fitted: one error that lists every fault.

    Examples
    --------
    >>> import hpgr
    >>> from hpgr.tables import read_pilot_tests
    >>> from hpgr.baselines import Machine, TorresCasali, fit_torres_casali
    >>> folder = hpgr.presets.DATA
    >>> tests = read_pilot_tests(folder / "khd_porphyry_psd.csv", folder / "khd_porphyry_operations.csv")
    >>> published = TorresCasali(0.20, 0.20, 3.51, 0.66 / 3600, -1.26, -0.70, 0.22)._asdict()
    >>> fixed = {name: value for name, value in published.items() if name != "selection"}
    >>> found = fit_torres_casali(tests[:1], Machine(0.8, 0.25, 2740.0, 1630.0, 2300.0), fixed)
    >>> found.settled, found.at_bounds
    (True, ())
    """
    fixed = dict(fixed or {})
    faults = _machine_faults(machine) + _fit_faults(tests, TorresCasali, _TC_BOUNDS, fixed, {"edge_share"})
    faults += [fault for test in tests for fault in _operating_faults(test, opening, force)]
    if blocks < 1:
        faults.append(f"blocks: got {blocks}; must be at least 1; use about 10")
    _refuse(faults)
    reference = max(coarsest_class(test.sizes) for test in tests)

    def model(parameters: TorresCasali, test: PilotTest) -> Prediction:
        return _torres_casali(parameters, machine, test, reference, blocks, opening, force)

    parameters, error, settled = _least_squares(model, tests, TorresCasali, _TC_BOUNDS, _TC_STARTS, fixed)
    stopped = _at_bounds(parameters, _TC_BOUNDS, fixed)
    return TorresCasaliFit(parameters, machine, reference, blocks, opening, force, error, stopped, settled)


def _torres_casali(parameters, machine, test, reference_size, blocks, opening, force) -> Prediction:
    thickness, speed = getattr(test, opening), test.surface_speed
    if force == "hydraulic_pressure":
        newtons = pressing_force(machine, test.hydraulic_pressure)
    else:
        newtons = test.specific_pressing_force * machine.diameter * machine.width
    flow = throughput(machine, thickness, speed)
    watts = power(newtons, nip_angle(machine, thickness), speed)
    energies = watts / flow * blocks * power_shares(blocks)
    products = combine(
        block_products(parameters, test.sizes, test.feed, energies, reference_size), parameters.edge_share
    )
    passing = {name: _passing(masses) for name, masses in products.items()}
    return Prediction(test.sizes, **passing, throughput=flow, power=watts, specific_energy=watts / flow)


def _passing(masses: np.ndarray) -> np.ndarray:
    """Return the fractions passing, fine to coarse, of masses per class, coarse to fine."""
    return np.cumsum(masses[::-1])


# ---------------------------------------------------------------------------------------------------
# Hinde & Kalala


def decay(parameters: HindeKalala, sizes: np.ndarray, reference_size: float) -> np.ndarray:
    """Return K (size,), kg J-1: it never falls with size, so that nothing can leave a class upwards.

    Examples
    --------
    >>> from hpgr.baselines import HindeKalala, decay
    >>> ore = HindeKalala(1e-4, 1.0, 0.0, 2.0, 0.2, 0.5)
    >>> decay(ore, [1e-3, 2e-3, 4e-3], reference_size=4e-3)
    array([2.5e-05, 5.0e-05, 1.0e-04])
    """
    ratio = np.asarray(sizes) / reference_size
    fine = (1 - parameters.bend) * ratio**parameters.exponent
    return parameters.rate * (fine + parameters.bend * ratio**parameters.coarse_exponent)


def retained(parameters, sizes, feed, specific_energy, reference_size) -> np.ndarray:
    """Return the fraction (size,) retained: R(x, E) = R(x, 0) exp(-K(x) E).

    As a population balance: a class between the sieves x_j > x_{j+1} breaks at the rate K(x_{j+1}), the
    decay of the sieve below it, and of what breaks the share K(x)/K(x_{j+1}) passes the sieve x. With
    rates and fragments so tied ("compensation") the cumulative balance has this exact solution.

    Examples
    --------
    >>> from hpgr.baselines import HindeKalala, retained
    >>> ore = HindeKalala(1e-4, 1.0, 0.0, 2.0, 0.2, 0.5)
    >>> retained(ore, [1e-3, 2e-3, 4e-3], [0.0, 0.0, 1.0], specific_energy=5000.0, reference_size=4e-3).round(2)
    array([0.88, 0.78, 0.  ])
    """
    return (1 - np.asarray(feed)) * np.exp(-decay(parameters, sizes, reference_size) * specific_energy)


class HindeKalalaFit(NamedTuple):
    """Fitted Hinde & Kalala model."""

    parameters: HindeKalala
    reference_size: float  # x_1, m
    energy_per_force: float  # specific energy / specific pressing force, J kg-1 Pa-1
    rmse: float  # of the fit, percent passing over all measured curves
    at_bounds: tuple[str, ...]  # fitted parameters that stopped at the end of their range
    settled: bool  # False if the search ran out of evaluations before it came to rest

    def predict(self, test: PilotTest) -> Prediction:
        """Return products and specific energy of `test`, from its feed and specific pressing force only.

        The model says nothing of throughput and power: they are NaN.
        """
        return _hinde_kalala(self.parameters, test, self.reference_size, self.energy_per_force)


def fit_hinde_kalala(tests: Sequence[PilotTest], fixed: Mapping[str, float] | None = None) -> HindeKalalaFit:
    """Fit the Hinde & Kalala model to the measured size distributions of `tests` by least squares.

    The article's printed equations could not be consulted: this is a reading of its approach. What is
    retained on a sieve decays exponentially with specific energy (`retained`); that the rate is the sum
    of two powers of size (`decay`) is chosen here. Two things are additions of this package. The edge,
    a share of the product, sees `edge_energy` times the mean specific energy, the centre what is left.
    The specific energy is energy_per_force * specific pressing force, its constant fitted to the specific
    energies of `tests` by least squares, also where one was measured.

    Raises
    ------
    ValueError
        If the tests or fixed parameters cannot be fitted: one error that lists every fault.

    Examples
    --------
    >>> import hpgr
    >>> from hpgr.tables import read_pilot_tests
    >>> from hpgr.baselines import fit_hinde_kalala
    >>> folder = hpgr.presets.DATA
    >>> tests = read_pilot_tests(folder / "khd_porphyry_psd.csv", folder / "khd_porphyry_operations.csv")
    >>> fixed = {"bend": 0.0, "coarse_exponent": 1.0, "edge_share": 0.18, "edge_energy": 0.5}
    >>> found = fit_hinde_kalala(tests[:1], fixed)
    >>> round(found.energy_per_force * 2.5e6 / 3600, 2)  # kWh/t at 2.5 N/mm2, as measured
    1.44
    """
    fixed = dict(fixed or {})
    faults = _fit_faults(tests, HindeKalala, _HK_BOUNDS, fixed, {"edge_share", "edge_energy"})
    measured = [(test.specific_pressing_force, _specific_energy(test)) for test in tests]
    measured = [(force, energy) for force, energy in measured if not math.isnan(energy)]
    if tests and not measured:
        faults.append("specific_energy: got no measured one; one test must have it, or power and throughput; add it")
    _refuse(faults)
    force, energy = np.array(measured).T
    constant = float(force @ energy / (force @ force))
    reference = float(max(test.sizes[-1] for test in tests))

    def model(parameters: HindeKalala, test: PilotTest) -> Prediction:
        return _hinde_kalala(parameters, test, reference, constant)

    parameters, error, settled = _least_squares(model, tests, HindeKalala, _HK_BOUNDS, _HK_STARTS, fixed)
    stopped = _at_bounds(parameters, _HK_BOUNDS, fixed)
    powers_free = not {"exponent", "coarse_exponent", "bend"} & fixed.keys()
    if powers_free and parameters.exponent > parameters.coarse_exponent:  # they may come out in either order
        parameters = parameters._replace(
            exponent=parameters.coarse_exponent, coarse_exponent=parameters.exponent, bend=1 - parameters.bend
        )
    return HindeKalalaFit(parameters, reference, constant, error, stopped, settled)


def _hinde_kalala(parameters: HindeKalala, test: PilotTest, reference_size, energy_per_force) -> Prediction:
    energy = energy_per_force * test.specific_pressing_force
    share, ratio = parameters.edge_share, parameters.edge_energy
    energies = {"centre": energy * (1 - share * ratio) / (1 - share), "edge": energy * ratio}
    passing = {
        name: 1 - retained(parameters, test.sizes, test.feed, each, reference_size) for name, each in energies.items()
    }
    passing["total"] = share * passing["edge"] + (1 - share) * passing["centre"]
    return Prediction(test.sizes, **passing, throughput=math.nan, power=math.nan, specific_energy=energy)


def _specific_energy(test: PilotTest) -> float:
    return test.power / test.throughput if math.isnan(test.specific_energy) else test.specific_energy


# ---------------------------------------------------------------------------------------------------
# Fitting, and how far off


def rmse(prediction: Prediction, test: PilotTest) -> dict[str, float]:
    """Return the root mean square error in percent passing of centre, edge and total.

    It runs over every sieve where the curve was measured, the coarsest too; NaN if it was not.

    Examples
    --------
    >>> import math
    >>> import hpgr
    >>> from hpgr.tables import read_pilot_tests
    >>> from hpgr.baselines import Prediction, rmse
    >>> folder = hpgr.presets.DATA
    >>> [test, *_] = read_pilot_tests(folder / "khd_porphyry_psd.csv", folder / "khd_porphyry_operations.csv")
    >>> perfect = Prediction(test.sizes, test.centre, test.edge, test.total, math.nan, math.nan, math.nan)
    >>> rmse(perfect, test)
    {'centre': 0.0, 'edge': 0.0, 'total': 0.0}
    """
    found = {}
    for name in PRODUCTS:
        error = 100 * (getattr(prediction, name) - getattr(test, name))
        error = error[~np.isnan(error)]
        found[name] = float(np.sqrt(np.mean(error**2))) if len(error) else math.nan
    return found


# lowest and highest value that a fit may take; "log" fits the logarithm
_TC_BOUNDS = {
    "fine_share": (1e-6, 1.0),
    "fine_exponent": (0.01, 5.0),
    "coarse_exponent": (0.5, 30.0),
    "selection": (1e-7, 1e-1),
    "slope": (-2.0, 5.0),
    "curvature": (-2.0, 0.3),
    "edge_share": (0.01, 0.6),
}
_HK_BOUNDS = {
    "rate": (1e-7, 1e-1),
    "exponent": (0.01, 5.0),
    "bend": (0.0, 1.0),
    "coarse_exponent": (0.1, 10.0),
    "edge_share": (0.01, 0.6),
    "edge_energy": (0.01, 1.0),
}
_EVALUATIONS = 150  # per start, without those for derivatives; the pilot tests take 10 to 35
_LOGARITHMIC = {"selection", "rate"}
# the published porphyry first; the others around it
_TC_STARTS = (
    TorresCasali(0.20, 0.20, 3.51, 0.66 / 3600, -1.26, -0.70, 0.22),
    TorresCasali(0.40, 0.40, 3.0, 1.0 / 3600, 0.0, -0.1, 0.2),
    TorresCasali(0.70, 0.60, 5.0, 2.0 / 3600, 0.5, 0.0, 0.2),
    TorresCasali(0.10, 0.30, 1.5, 0.5 / 3600, -1.0, -0.3, 0.3),
)
_HK_STARTS = (
    HindeKalala(2.0 / 3600, 0.4, 0.5, 2.0, 0.2, 0.5),
    HindeKalala(5.0 / 3600, 0.6, 0.9, 3.0, 0.15, 0.3),
    HindeKalala(0.5 / 3600, 0.8, 0.1, 1.5, 0.3, 0.8),
)


def _least_squares(model: Callable, tests, kind, bounds, starts, fixed) -> tuple:
    """Return the best parameters over all starts, their RMSE in percent passing, and whether it came to rest."""
    free = [name for name in kind._fields if name not in fixed]

    def parameters(vector):
        values = {
            name: math.exp(value) if name in _LOGARITHMIC else float(value)
            for name, value in zip(free, vector, strict=True)
        }
        return kind(**values, **fixed)

    def coordinates(values):
        return [math.log(values[name]) if name in _LOGARITHMIC else values[name] for name in free]

    def residuals(vector):
        found = (_differences(model(parameters(vector), test), test) for test in tests)
        return np.concatenate(list(found))

    low, high = (coordinates({name: bound[side] for name, bound in bounds.items()}) for side in (0, 1))
    if not free:
        return kind(**fixed), float(np.sqrt(np.mean(residuals([]) ** 2))), True
    fits = [
        optimize.least_squares(
            residuals,
            coordinates(start._asdict()),
            bounds=(low, high),
            x_scale="jac",
            xtol=1e-10,
            ftol=1e-10,
            max_nfev=_EVALUATIONS,
        )
        for start in starts
    ]
    best = min(fits, key=lambda fit: fit.cost)
    return parameters(best.x), float(np.sqrt(np.mean(best.fun**2))), best.status > 0


def _at_bounds(parameters, bounds, fixed) -> tuple[str, ...]:
    return tuple(
        name
        for name, value in parameters._asdict().items()
        if name not in fixed and any(math.isclose(value, end, rel_tol=1e-3, abs_tol=1e-6) for end in bounds[name])
    )


def _differences(prediction: Prediction, test: PilotTest) -> np.ndarray:
    """Return model minus measurement in percent passing wherever there is one."""
    pairs = [(getattr(prediction, name), getattr(test, name)) for name in PRODUCTS]
    found = np.concatenate([100 * (model - measured) for model, measured in pairs])
    return found[~np.isnan(found)]


# ---------------------------------------------------------------------------------------------------
# Bad input


def _refuse(faults: list[str]) -> None:
    if faults:
        raise ValueError("\n".join(faults))


def _machine_faults(machine: Machine) -> list[str]:
    faults = [
        f"machine.{name}: got {value:g}; must be above 0 and finite; give it in SI"
        for name, value in machine._asdict().items()
        if not 0 < value < math.inf
    ]
    if not faults and not machine.bulk_density < machine.cake_density <= machine.solid_density:
        faults.append(
            f"machine: got bulk, cake and solid densities {machine.bulk_density:g}, {machine.cake_density:g}, "
            f"{machine.solid_density:g} kg m-3; must rise in this order; correct the cake density"
        )
    return faults


def _operating_faults(test: PilotTest, opening: str, force: str) -> list[str]:
    faults = []
    for role, field, known in (
        ("opening", opening, ("cake_thickness", "gap")),
        ("force", force, ("hydraulic_pressure", "specific_pressing_force")),
    ):
        other = next((name for name in known if name != field), known[0])
        if field not in known:
            faults.append(f"{role}: got {field!r}; must be one of {', '.join(known)}; did you mean {other!r}?")
        elif math.isnan(getattr(test, field)):
            faults.append(
                f"test {test.name}, {field}: not measured; the model needs it; measure it or pass {role}={other!r}"
            )
    return faults


def _fit_faults(tests, kind, bounds, fixed, of_edges) -> list[str]:
    """Return why parameters of `kind` cannot be fitted to `tests`."""
    faults = []
    for name, value in fixed.items():
        if name not in kind._fields:
            close = difflib.get_close_matches(name, kind._fields, n=1, cutoff=0.3) or [kind._fields[0]]
            faults.append(f"fixed: got {name!r}; must be one of {', '.join(kind._fields)}; did you mean {close[0]!r}?")
        elif not bounds[name][0] <= value <= bounds[name][1]:
            low, high = bounds[name]
            faults.append(f"fixed {name}: got {value:g}; must be within {low:g} and {high:g}; correct it")
    if not tests:
        return [*faults, "tests: got none; a fit needs at least one; give those to calibrate on"]
    split = any(np.isfinite(test.centre).any() or np.isfinite(test.edge).any() for test in tests)
    missing = [name for name in kind._fields if name in of_edges - fixed.keys()]
    if missing and not split:
        faults.append(
            f"tests: got no centre or edge product; {' and '.join(missing)} cannot be fitted to the total alone; "
            f"give fixed={{{missing[0]!r}: ...}}"
        )
    known = sum(np.isfinite(getattr(test, name)).sum() for test in tests for name in PRODUCTS)
    free = len(set(kind._fields) - fixed.keys())
    if known < free:
        faults.append(f"tests: got {known} measured points; must be at least the {free} free parameters; add tests")
    return faults
