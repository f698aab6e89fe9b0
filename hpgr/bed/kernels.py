"""The bed, compiled, and the only one there is: points, strains and stresses of every streamline.

Streamlines do not know of each other. Arrays are (streamline, point), or (point,) of one line, entry to exit; `bed` is
a `hpgr.bed.geometry.Geometry`, `flow` and `elastic` are the constants of a law. A law has one branch, on its tag: a
speed profile in `_descent`, an elastic law in `_response`. The tests hold each against its law's NumPy equation.

Written to compile fast: few functions, without `min` and `max`, slices and allocations, 15 to 60 ms each. Python runs
the first beds of a process all the same.
"""

import math
from typing import NamedTuple

import numpy as np

from hpgr import compiler
from hpgr.laws.flow import NIP, POWER

_HOW = {"no_rewrites": True}  # for nothing here is optional or a whole array: 7 % of the compile time saved
_compiled, _inner = compiler.deferred(**_HOW), compiler.inner(**_HOW)

_PANELS = 64  # 5-point Gauss on 64 panels: travel times to 1e-13 for every entry_fraction down to 1e-9
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2
# of values at the nodes to the coefficients of u, u^2 .. of the integral from 0 to u of the quartic through them
_INTEGRAL = np.linalg.inv(np.vander(_NODES, increasing=True)) / np.arange(1, 6)[:, None]
_DENSEST = 0.99  # of the largest solid fraction, where a bed that stiffens as pores close is held
_MET = 1e-7  # of the mean slowness of a panel, by which a quartic may miss that at its ends


class Line(NamedTuple):
    """The streamline x = xi X(y) of a bed; what holds above a nip and below it follows from the last three.

    Attributes
    ----------
    half_gap, height, b, c : float
        The bed, see `hpgr.bed.geometry.Geometry`.
    xi : float
        Its label.
    nip : float
        Height of the nip, m.
    flux, flux_by_xi : float
        X |v_y| / U at the nip and above it, where the bed keeps its density, m, and its derivative by xi.
    lag : float
        Slip of the bed at the nip over y_n^2, 1/m2.
    """

    half_gap: float
    height: float
    b: float
    c: float
    xi: float
    nip: float
    flux: float
    flux_by_xi: float
    lag: float


# --- motion -------------------------------------------------------------------------------------------------


@_inner
def _line(bed, flow, nip, xi):
    """Return a streamline of a bed with its nip at the height `nip`, m."""
    outer, slope = bed.half_gap + nip * nip * (bed.b + bed.c * nip), nip * (2.0 * bed.b + 3.0 * bed.c * nip)
    kept, t = (1.0 - flow.slip) * outer, xi * slope
    g = 1.0 / math.sqrt(1.0 + t * t)
    lag = flow.slip / (nip * nip)
    return Line(bed.half_gap, bed.height, bed.b, bed.c, xi, nip, kept * g, -kept * t * slope * g * g * g, lag)


@_inner
def _descent(line, flow, y, depth):
    """Return |v| and |v_y| over U, the derivatives of the latter by xi and, along the streamline, by y, and the bed.

    Of the bed the half width X, m, X' and X'', 1/m.
    """
    outer, slope = line.half_gap + y * y * (line.b + line.c * y), y * (2.0 * line.b + 3.0 * line.c * y)
    curvature, t = 2.0 * line.b + 6.0 * line.c * y, line.xi * slope
    steep = 1.0 + t * t
    if flow.law == NIP and y > line.nip:
        fall = line.flux / outer
        by_xi, by_y = line.flux_by_xi / outer, -fall * slope / outer
        return math.sqrt(steep) * fall, fall, by_xi, by_y, outer, slope, curvature
    g = 1.0 / math.sqrt(steep)
    speed, by_y = 1.0 - line.lag * y * y, -2.0 * line.lag * y
    if flow.law == POWER:
        linear = flow.exponent == 1.0
        speed = depth if linear else depth**flow.exponent
        by_y = -flow.exponent * (1.0 if linear else speed / depth) / line.height
    turn = speed * t * g * g * g
    return speed, speed * g, -turn * slope, by_y * g - turn * line.xi * curvature, outer, slope, curvature


@_inner
def _rates(line, flow, y, depth):
    """Return |v| / U, volumetric (compaction positive) and shear strain rate in U/H, `across`, and X |v_y| / U, m.

    The velocity follows the streamline; its direction varies with x at fixed y because xi does. `across` is
    n.(-e').n over the shear rate, n normal to the streamline and e' the strain rate's deviator: 1 in uniaxial
    compaction.
    """
    speed, fall, by_xi, by_y, outer, slope, curvature = _descent(line, flow, y, depth)
    t, v_y = line.xi * slope, -line.height * fall
    v_yx = -line.height * by_xi / outer
    v_yy = -line.height * (by_y - by_xi * t / outer)
    v_xx = slope / outer * v_y + t * v_yx
    v_xy = line.xi * (curvature - slope * slope / outer) * v_y + t * v_yy
    third = (v_xx + v_yy) / 3.0
    xx, yy, xy = v_xx - third, v_yy - third, (v_xy + v_yx) / 2.0
    shear = math.sqrt(2.0 / 3.0 * (xx * xx + yy * yy + third * third + 2.0 * xy * xy))
    across = (2.0 * t * xy - xx - t * t * yy) / ((1.0 + t * t) * shear) if shear > 0.0 else 0.0
    # above a nip 0 by construction: what is left is rounding
    return speed, 0.0 if flow.nip_angle > 0.0 and y > line.nip else -(v_xx + v_yy), shear, across, outer * fall


@_inner
def _at(line, flow, place):
    """Return height and depth fraction of a place on the way up from the exit.

    Towards a nip places are y/H. Below a stagnant entry they are -log(depth), which stays exact however close the
    first point comes to it.
    """
    if flow.nip_angle > 0.0:
        return line.height * place, 1.0 - place
    depth = math.exp(-place)
    return line.height * (1.0 - depth), depth


@_inner
def _slowness(line, flow, place):
    """Return the time it takes to cross a place, in H/U."""
    y, depth = _at(line, flow, place)
    return (1.0 if flow.nip_angle > 0.0 else depth) / _descent(line, flow, y, depth)[1]


@_inner
def _travel(line, flow, start, length):
    """Return the travel time down from the place start + length to `start`, by Gauss quadrature, in H/U."""
    total = 0.0
    for k in range(_NODES.size):
        total += _WEIGHTS[k] * _slowness(line, flow, start + length * _NODES[k])
    return length * total


@_inner
def _march_back(line, flow, edges, duration, places):
    """Fill the places of a streamline's points, equal times apart.

    Inside a panel time is the integral of a quartic, right to 1e-9 of a panel's where the quartic meets the slowness
    at the panel's ends; where it does not, by Newton's method on the quadrature.
    """
    last = j = places.size - 1
    passed, slow = 0.0, _slowness(line, flow, edges[0])
    for k in range(_PANELS):
        start, width, slow_start = edges[k], edges[k + 1] - edges[k], slow
        first = second = third = fourth = fifth = 0.0
        for m in range(_NODES.size):
            at_node = width * _slowness(line, flow, start + width * _NODES[m])
            first += _INTEGRAL[0, m] * at_node
            second += _INTEGRAL[1, m] * at_node
            third += _INTEGRAL[2, m] * at_node
            fourth += _INTEGRAL[3, m] * at_node
            fifth += _INTEGRAL[4, m] * at_node
        time, slow = first + second + third + fourth + fifth, _slowness(line, flow, edges[k + 1])
        end = first + 2.0 * second + 3.0 * third + 4.0 * fourth + 5.0 * fifth
        met = abs(first - width * slow_start) + abs(end - width * slow) < _MET * time
        low, high = time / (width * slow_start) - 1.0, time / (width * slow) - 1.0
        while j >= 0 and (duration * ((last - j) / last) < passed + time or k == _PANELS - 1):
            left = duration * ((last - j) / last) - passed
            # the cubic through the panel's ends with their slopes is 1e-6 off; each pass squares that
            u = left / time
            u *= 1.0 + (1.0 - u) * (low * (1.0 - u) - high * u)
            miss = u * (first + u * (second + u * (third + u * (fourth + u * fifth)))) - left
            u -= miss / (first + u * (2.0 * second + u * (3.0 * third + u * (4.0 * fourth + u * 5.0 * fifth))))
            length = u * width
            for _ in range(0 if met else 4):
                miss = _travel(line, flow, start, length) - left
                length -= miss / _slowness(line, flow, start + length)
            places[j] = start + length
            j -= 1
        passed += time


@_inner
def _strain(i, line, flow, unit_time, time_step, places, y, volumetric_rate, shear_rate, volumetric, shear):
    """Fill the strains of the step that ends at each point of streamline i, by the trapezoid rule.

    They count from the onset of compaction, and of the step with the onset only what lies past it does, lest the
    force jump as a point crosses it: past the nip, with the rates there; else past where the rate, linear between
    two points, turns from dilation.
    """
    volumetric[i, 0] = shear[i, 0] = 0.0
    begun, nip = flow.nip_angle > 0.0, line.nip / line.height
    for j in range(1, places.size):
        past, first_volumetric, first_shear = time_step, volumetric_rate[i, j - 1], shear_rate[i, j - 1]
        begun = begun or first_volumetric > 0.0
        if not begun:
            rate = volumetric_rate[i, j]
            share = rate / (rate - first_volumetric) if rate > 0.0 else 0.0
            first_volumetric, first_shear = 0.0, shear_rate[i, j] + share * (first_shear - shear_rate[i, j])
            past = share * time_step
        elif flow.nip_angle > 0.0 and y[i, j - 1] > line.nip:
            past = unit_time * _travel(line, flow, places[j], nip - places[j]) if y[i, j] < line.nip else 0.0
            _, first_volumetric, first_shear, _, _ = _rates(line, flow, line.nip, 1.0 - nip)
            first_volumetric, first_shear = first_volumetric / unit_time, first_shear / unit_time
        volumetric[i, j] = (volumetric_rate[i, j] + first_volumetric) * past / 2.0
        shear[i, j] = (shear_rate[i, j] + first_shear) * past / 2.0


@_compiled
def lay(
    bed, nip, flow, surface_speed, edges, places, y, speed, volumetric_rate, shear_rate, across, flux, volumetric, shear
):
    """Lay the material points; return the time step, s, and the closest that neighbours come in height, m.

    `edges` are the places between panels of quadrature, exit to entry, `nip` the height of the nip, m, and `places`
    (point,) work space. Fills heights, m, speeds, m/s, strain rates, 1/s, `across` and flux, m2/s, of the points, and
    the strains of the step that ends at each.
    """
    lines, points = y.shape
    middle = _line(bed, flow, nip, 0.0)
    unit_time, duration, closest = bed.height / surface_speed, 0.0, math.inf
    for k in range(_PANELS):
        duration += _travel(middle, flow, edges[k], edges[k + 1] - edges[k])
    time_step = duration * unit_time / (points - 1)
    for i in range(lines):
        line = _line(bed, flow, nip, bed.xi[i])
        _march_back(line, flow, edges, duration, places)
        for j in range(points):
            y[i, j], depth = _at(line, flow, places[j])
            relative, volume, sheared, across[i, j], sunk = _rates(line, flow, y[i, j], depth)
            speed[i, j], flux[i, j] = surface_speed * relative, surface_speed * sunk
            volumetric_rate[i, j], shear_rate[i, j] = volume / unit_time, sheared / unit_time
            if j > 0 and y[i, j - 1] - y[i, j] < closest:
                closest = y[i, j - 1] - y[i, j]
        _strain(i, line, flow, unit_time, time_step, places, y, volumetric_rate, shear_rate, volumetric, shear)
    return time_step, closest


# --- stress -------------------------------------------------------------------------------------------------


@_inner
def _response(elastic, eps_v, eps_s):
    """Return p and q of the state functions and the moduli p_v, p_s = q_v and q_s of the tangent, all over phi^3, Pa.

    At zero strain the bed is free of stress.
    """
    c, bulk, shear = elastic.exponent, elastic.bulk_modulus, elastic.shear_modulus
    if not eps_v > 0.0:
        stiff = 1.0 if c == 0.0 else 0.0
        return 0.0, 0.0, stiff * bulk, 0.0, stiff * 3 * shear
    power, eta = eps_v**c, eps_s / eps_v
    p = power * eps_v * (bulk / (c + 1.0) + 1.5 * shear * c * (eta * eta))
    p_v = power * (bulk + 1.5 * shear * c * (c - 1.0) * (eta * eta))
    return p, 3.0 * shear * (power * eps_v) * eta, p_v, power * 3.0 * shear * c * eta, power * 3.0 * shear


@_inner
def _stiffness(elastic, phi, feed, most):
    """Return phi^3, times what it gains as pores close between the solid fractions `feed` and `most`."""
    cube = phi * phi * phi
    if elastic.densification == 0.0:
        return cube
    filled = phi / most if phi / most < _DENSEST else _DENSEST
    return cube * ((1.0 - feed / most) / (1.0 - filled)) ** elastic.densification


@_inner
def _hold_strains(i, elastic, feed, most, volumetric, shear, eps_v, eps_s, phi, limited):
    """Fill strains and solid fractions of streamline i: running sums, shear held at the convexity limit."""
    sum_v = least_v = sum_s = least_s = 0.0
    for j in range(eps_v.shape[1]):
        sum_v += volumetric[i, j]
        least_v = sum_v if sum_v < least_v else least_v
        strain = sum_v - least_v
        sum_s += shear[i, j]
        held, limited[i, j] = sum_s, False
        if elastic.largest_shear_ratio < math.inf:
            # min(s + d, limit) at every step is the plain sum plus the running minimum of limit - plain sum
            limit = elastic.largest_shear_ratio * strain
            least_s = limit - sum_s if limit - sum_s < least_s else least_s
            # where the limit is tiny beside the plain sum, rounding would carry their difference past it
            held = sum_s + least_s if sum_s + least_s > 0.0 else 0.0
            held = held if held < limit else limit
            limited[i, j] = limit - sum_s <= least_s and strain > 0.0
        solid = feed * math.exp(strain)
        eps_v[i, j], eps_s[i, j], phi[i, j] = strain, held, solid if solid < most else most


@_inner
def _add_stresses(i, elastic, feed, most, time_step, volumetric_rate, eps_v, eps_s, phi, p, q):
    """Fill the stresses of streamline i; return the lowest of their running sums, and of the state function of p.

    By increments of the state functions, or by Euler's rule, which takes rate and tangent at the start of the step
    and of shear only the elastic part: what the convexity limit takes as plastic loads nothing.
    """
    sum_p = least_p = sum_q = least_q = least_state = state_p = state_q = p_v = p_s = q_s = 0.0
    begun = False
    for j in range(p.shape[1]):
        new_p, new_q, new_p_v, new_p_s, new_q_s = _response(elastic, eps_v[i, j], eps_s[i, j])
        if j > 0:
            begun = begun or volumetric_rate[i, j - 1] > 0.0
            between = phi[i, j - 1] if elastic.euler else (phi[i, j] + phi[i, j - 1]) / 2.0
            stiffness, d_p, d_q = _stiffness(elastic, between, feed, most), new_p - state_p, new_q - state_q
            if elastic.euler:
                stiffness = stiffness if begun else 0.0
                d_v, d_s = volumetric_rate[i, j - 1] * time_step, eps_s[i, j] - eps_s[i, j - 1]
                d_p, d_q = p_v * d_v + p_s * d_s, p_s * d_v + q_s * d_s
            sum_p += stiffness * d_p
            sum_q += stiffness * d_q
            least_p, least_q = sum_p if sum_p < least_p else least_p, sum_q if sum_q < least_q else least_q
            least_state = new_p if new_p < least_state else least_state
        p[i, j], q[i, j] = sum_p - least_p, sum_q - least_q
        state_p, state_q, p_v, p_s, q_s = new_p, new_q, new_p_v, new_p_s, new_q_s
    return least_p, least_q, least_state


@_compiled
def load(elastic, solid, time_step, volumetric_rate, volumetric, shear, eps_v, eps_s, phi, p, q, limited):
    """March the stresses along every streamline; return the lowest running sums of p and q and state function of p.

    `solid` holds the solid fractions of the feed and at most, `volumetric` and `shear` the strains of the step that
    ends at each point. Fills strains, solid fraction, mean stress p and triaxial shear stress q, Pa, and whether shear
    is held at the convexity limit. Strains and stresses are held at 0 from below.
    """
    least_p = least_q = least_state = 0.0
    feed, most = solid
    for i in range(p.shape[0]):
        _hold_strains(i, elastic, feed, most, volumetric, shear, eps_v, eps_s, phi, limited)
        low_p, low_q, low_state = _add_stresses(
            i, elastic, feed, most, time_step, volumetric_rate, eps_v, eps_s, phi, p, q
        )
        least_p, least_q = low_p if low_p < least_p else least_p, low_q if low_q < least_q else least_q
        least_state = low_state if low_state < least_state else least_state
    return least_p, least_q, least_state
