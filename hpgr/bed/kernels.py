"""The bed, compiled, and the only one there is: points, strains, stresses, wall force and power of every streamline.

Streamlines do not know of each other. Arrays are (streamline, point), or (point,) of one line, entry to exit; `bed` is
a `hpgr.bed.geometry.Geometry`, `flow` and `elastic` are the constants of a law. A law has one branch, on its tag: a
speed profile in `_descent`, an elastic law in `_response`. The tests hold each against its law's NumPy equation.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from hpgr.laws.flow import NIP, POWER

_compiled = njit(cache=True, nogil=True, error_model="numpy")

_PANELS = 64  # 5-point Gauss on 64 panels: travel times to 1e-13 for every entry_fraction down to 1e-9
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2
_TENSION_NOISE = 1e-9  # of the largest stress; less is rounding of the running sum


class Line(NamedTuple):
    """The streamline x = xi X(y) of a bed, and the height of the nip, of the bed where there is none."""

    half_gap: float
    height: float
    b: float
    c: float
    nip: float
    xi: float


# --- motion -------------------------------------------------------------------------------------------------


@_compiled
def _line(bed, flow, xi):
    """Return a streamline; the nip is at the height R sin(alpha)."""
    nip = min(bed.radius * math.sin(flow.nip_angle), bed.height) if flow.nip_angle > 0 else bed.height
    return Line(bed.half_gap, bed.height, bed.b, bed.c, nip, xi)


@_compiled
def _shape(line, y):
    """Return the half width X of the bed, m, X' and X'', 1/m."""
    outer = line.half_gap + y * y * (line.b + line.c * y)
    return outer, y * (2 * line.b + 3 * line.c * y), 2 * line.b + 6 * line.c * y


@_compiled
def _descent(line, flow, y, depth):
    """Return |v| and |v_y| over U, and the derivatives of the latter by xi and, along the streamline, by y."""
    outer, slope, curvature = _shape(line, y)
    t = line.xi * slope
    steep = 1 + t * t
    if flow.law == NIP and y > line.nip:  # the bed keeps its density: |v_y| = g_n(xi) X_n / X
        nip_outer, nip_slope, _ = _shape(line, line.nip)
        nip_t = line.xi * nip_slope
        g, wide = 1 / math.sqrt(1 + nip_t * nip_t), nip_outer / outer
        return math.sqrt(steep) * g * wide, wide * g, -wide * nip_t * nip_slope * g * g * g, -wide * g * slope / outer
    g = 1 / math.sqrt(steep)
    speed, by_y = 1.0, 0.0
    if flow.law == POWER:
        linear = flow.exponent == 1.0
        speed = depth if linear else depth**flow.exponent
        by_y = -flow.exponent * (1.0 if linear else speed / depth) / line.height
    turn = speed * t * g * g * g
    return speed, speed * g, -turn * slope, by_y * g - turn * line.xi * curvature


@_compiled
def _gradient(line, flow, y, depth):
    """Return |v| / U and the velocity gradient in U/H: v_xx, v_xy, v_yx, v_yy, where v_xy is the change of v_x by y.

    The velocity follows the streamline; its direction varies with x at fixed y because xi does.
    """
    speed, fall, by_xi, by_y = _descent(line, flow, y, depth)
    outer, slope, curvature = _shape(line, y)
    t, v_y = line.xi * slope, -line.height * fall
    v_yx = -line.height * by_xi / outer
    v_yy = -line.height * (by_y - by_xi * t / outer)
    t_x, t_y = slope / outer, line.xi * (curvature - slope * slope / outer)
    return speed, t_x * v_y + t * v_yx, t_y * v_y + t * v_yy, v_yx, v_yy


@_compiled
def _deviator(v_xx, v_xy, v_yx, v_yy):
    """Return xx, yy and xy of the strain rate's deviator in plane strain, and the shear rate sqrt(2/3 e':e')."""
    third = (v_xx + v_yy) / 3
    xx, yy, xy = v_xx - third, v_yy - third, (v_xy + v_yx) / 2
    return xx, yy, xy, math.sqrt(2 / 3 * (xx * xx + yy * yy + third * third + 2 * xy * xy))


@_compiled
def _rates(line, flow, y, depth):
    """Return |v| / U, volumetric (compaction positive) and triaxial shear strain rate in U/H."""
    speed, v_xx, v_xy, v_yx, v_yy = _gradient(line, flow, y, depth)
    _, _, _, shear = _deviator(v_xx, v_xy, v_yx, v_yy)
    # above a nip 0 by construction: what is left is rounding
    return speed, 0.0 if flow.nip_angle > 0 and y > line.nip else -(v_xx + v_yy), shear


@_compiled
def _at(line, flow, place):
    """Return height and depth fraction of a place on the way up from the exit.

    Towards a nip places are y/H. Below a stagnant entry they are -log(depth), which stays exact however close the
    first point comes to it.
    """
    if flow.nip_angle > 0:
        return line.height * place, 1 - place
    return -line.height * math.expm1(-place), math.exp(-place)


@_compiled
def _slowness(line, flow, place):
    """Return the time it takes to cross a place, in H/U."""
    y, depth = _at(line, flow, place)
    _, fall, _, _ = _descent(line, flow, y, depth)
    return (1.0 if flow.nip_angle > 0 else depth) / fall


@_compiled
def _travel(line, flow, start, length):
    """Return the travel time down from the place start + length to `start`, by Gauss quadrature, in H/U."""
    total = 0.0
    for k in range(_NODES.size):
        total += _WEIGHTS[k] * _slowness(line, flow, start + length * _NODES[k])
    return length * total


@_compiled
def _panels(line, flow):
    """Return the places between panels, exit to entry, on the mid-plane; the speed has a kink at the nip."""
    edges = np.empty(_PANELS + 1)
    # high enough, on the mid-plane, that in the same time no tube begins below the nip, already compacted
    _, slope, _ = _shape(line, line.nip)
    top = max(line.height * (1 - flow.entry_fraction), line.nip * math.sqrt(1 + slope * slope))
    for k in range(_PANELS + 1):
        share = 2 * k / _PANELS
        past_nip = min(share, 1.0) * line.nip + max(share - 1, 0.0) * (top - line.nip)
        edges[k] = past_nip / line.height if flow.nip_angle > 0 else -math.log(flow.entry_fraction) / 2 * share
    return edges


@_compiled
def _march_back(line, flow, edges, duration, places):
    """Fill the places of a streamline's points, equal times apart, by Newton's method inside their panels."""
    last = j = places.size - 1
    passed, slow = 0.0, _slowness(line, flow, edges[0])
    for k in range(_PANELS):
        start, width, slow_start = edges[k], edges[k + 1] - edges[k], slow
        time, slow = _travel(line, flow, start, width), _slowness(line, flow, edges[k + 1])
        while j >= 0 and (duration * ((last - j) / last) < passed + time or k == _PANELS - 1):
            left = duration * ((last - j) / last) - passed
            # the cubic through the panel's ends with their slopes is 1e-6 off; each pass squares that
            u, low, high = left / time, time / slow_start - width, time / slow - width
            length = u * (width + (1 - u) * (low * (1 - u) - high * u))
            for _ in range(4):
                miss = _travel(line, flow, start, length) - left
                length -= miss / _slowness(line, flow, start + length)
                if abs(miss) <= 1e-7 * time:
                    break
            places[j] = start + length
            j -= 1
        passed += time


@_compiled
def _strain(line, flow, unit_time, time_step, places, y, volumetric_rate, shear_rate, volumetric, shear):
    """Fill the strains of the step that ends at each point, by the trapezoid rule.

    They count from the onset of compaction, and of the step with the onset only what lies past it does, lest the
    force jump as a point crosses it: past the nip, with the rates there; else past where the rate, linear between
    two points, turns from dilation.
    """
    volumetric[0] = shear[0] = 0.0
    begun, nip = flow.nip_angle > 0, line.nip / line.height
    for j in range(1, y.size):
        past, first_volumetric, first_shear = time_step, volumetric_rate[j - 1], shear_rate[j - 1]
        begun = begun or first_volumetric > 0
        if not begun:
            share = volumetric_rate[j] / (volumetric_rate[j] - first_volumetric) if volumetric_rate[j] > 0 else 0.0
            first_volumetric, first_shear = 0.0, shear_rate[j] + share * (first_shear - shear_rate[j])
            past = share * time_step
        elif flow.nip_angle > 0 and y[j - 1] > line.nip:
            past = unit_time * _travel(line, flow, places[j], nip - places[j]) if y[j] < line.nip else 0.0
            _, first_volumetric, first_shear = _rates(line, flow, line.nip, 1 - nip)
            first_volumetric, first_shear = first_volumetric / unit_time, first_shear / unit_time
        volumetric[j] = (volumetric_rate[j] + first_volumetric) * past / 2
        shear[j] = (shear_rate[j] + first_shear) * past / 2


@_compiled
def lay(bed, flow, surface_speed, y, speed, volumetric_rate, shear_rate, volumetric, shear):
    """Lay the material points; return the time step, s, and the closest that neighbours come in height, m.

    Fills heights, m, speeds, m/s, and strain rates, 1/s, of the points, and the strains of the step that ends at each.
    """
    lines, points = y.shape
    middle = _line(bed, flow, 0.0)
    edges, places, unit_time = _panels(middle, flow), np.empty(points), bed.height / surface_speed
    duration, closest = 0.0, math.inf
    for k in range(_PANELS):
        duration += _travel(middle, flow, edges[k], edges[k + 1] - edges[k])
    time_step = duration * unit_time / (points - 1)
    for i in range(lines):
        line = _line(bed, flow, bed.xi[i])
        _march_back(line, flow, edges, duration, places)
        for j in range(points):
            y[i, j], depth = _at(line, flow, places[j])
            relative, volumetric_rate[i, j], shear_rate[i, j] = _rates(line, flow, y[i, j], depth)
            speed[i, j] = surface_speed * relative
            volumetric_rate[i, j] /= unit_time
            shear_rate[i, j] /= unit_time
            if j > 0:
                closest = min(closest, y[i, j - 1] - y[i, j])
        rates = volumetric_rate[i], shear_rate[i]
        _strain(line, flow, unit_time, time_step, places, y[i], rates[0], rates[1], volumetric[i], shear[i])
    return time_step, closest


# --- stress -------------------------------------------------------------------------------------------------


@_compiled
def _response(elastic, eps_v, eps_s):
    """Return p and q of the state functions and the moduli p_v, p_s = q_v and q_s of the tangent, all over phi^3, Pa.

    At zero strain the bed is free of stress.
    """
    c, bulk, shear = elastic.exponent, elastic.bulk_modulus, elastic.shear_modulus
    if not eps_v > 0:
        stiff = 1.0 if c == 0 else 0.0
        return 0.0, 0.0, stiff * bulk, 0.0, stiff * 3 * shear
    power, eta = eps_v**c, eps_s / eps_v
    pressure = power * eps_v * (bulk / (c + 1) + 1.5 * shear * c * (eta * eta))
    return (
        pressure,
        3 * shear * (power * eps_v) * eta,
        power * (bulk + 1.5 * shear * c * (c - 1) * (eta * eta)),
        power * 3 * shear * c * eta,
        power * 3 * shear,
    )


@_compiled
def _hold_strains(elastic, feed_solid_fraction, max_solid_fraction, volumetric, shear, eps_v, eps_s, phi, limited):
    """Fill strains and solid fractions of a streamline: running sums, shear held at the convexity limit."""
    sum_v = least_v = sum_s = least_s = 0.0
    for j in range(eps_v.size):
        sum_v += volumetric[j]
        least_v = min(least_v, sum_v)
        eps_v[j] = sum_v - least_v
        sum_s += shear[j]
        eps_s[j], limited[j] = sum_s, False
        if elastic.largest_shear_ratio < math.inf:
            # min(s + d, limit) at every step is the plain sum plus the running minimum of limit - plain sum
            limit = elastic.largest_shear_ratio * eps_v[j]
            least_s = min(least_s, limit - sum_s)
            # where the limit is tiny beside the plain sum, rounding would carry their difference past it
            eps_s[j] = min(max(sum_s + least_s, 0.0), limit)
            limited[j] = limit - sum_s <= least_s and eps_v[j] > 0
        phi[j] = min(feed_solid_fraction * math.exp(eps_v[j]), max_solid_fraction)


@_compiled
def _add_stresses(elastic, time_step, volumetric_rate, eps_v, eps_s, phi, p, q):
    """Fill the stresses of a streamline; return the lowest of their running sums, and of the state function of p.

    By increments of the state functions, or by Euler's rule, which takes rate and tangent at the start of the step
    and of shear only the elastic part: what the convexity limit takes as plastic loads nothing.
    """
    sum_p = least_p = sum_q = least_q = least_state = 0.0
    begun = False
    state_p, state_q, p_v, p_s, q_s = _response(elastic, eps_v[0], eps_s[0])
    p[0] = q[0] = 0.0
    for j in range(1, p.size):
        new_p, new_q, new_p_v, new_p_s, new_q_s = _response(elastic, eps_v[j], eps_s[j])
        if elastic.euler:
            begun = begun or volumetric_rate[j - 1] > 0
            d_v, d_s = volumetric_rate[j - 1] * time_step, eps_s[j] - eps_s[j - 1]
            stiffness = phi[j - 1] * phi[j - 1] * phi[j - 1] if begun else 0.0
            d_p, d_q = p_v * d_v + p_s * d_s, p_s * d_v + q_s * d_s
        else:
            middle = (phi[j] + phi[j - 1]) / 2
            stiffness = middle * middle * middle
            d_p, d_q = new_p - state_p, new_q - state_q
        sum_p += stiffness * d_p
        least_p = min(least_p, sum_p)
        p[j] = sum_p - least_p
        sum_q += stiffness * d_q
        least_q = min(least_q, sum_q)
        q[j] = sum_q - least_q
        state_p, state_q, p_v, p_s, q_s = new_p, new_q, new_p_v, new_p_s, new_q_s
        least_state = min(least_state, state_p)
    return least_p, least_q, least_state


@_compiled
def load(elastic, feed_solid_fraction, max_solid_fraction, time_step, volumetric_rate, volumetric, shear, state):
    """March the stresses along every streamline; return whether the law asked for tension or reverse shear somewhere.

    `volumetric` and `shear` are the strains of the step that ends at each point. Fills `state`: strains, solid
    fraction, mean stress p and triaxial shear stress q, Pa, and whether shear is held at the convexity limit. Strains
    and stresses are held at 0 from below.
    """
    eps_v, eps_s, phi, p, q, limited = state
    least_p = least_q = least_state = highest_p = highest_q = 0.0
    for i in range(p.shape[0]):
        _hold_strains(
            elastic,
            feed_solid_fraction,
            max_solid_fraction,
            volumetric[i],
            shear[i],
            eps_v[i],
            eps_s[i],
            phi[i],
            limited[i],
        )
        lowest = _add_stresses(elastic, time_step, volumetric_rate[i], eps_v[i], eps_s[i], phi[i], p[i], q[i])
        least_p, least_q, least_state = min(least_p, lowest[0]), min(least_q, lowest[1]), min(least_state, lowest[2])
        for j in range(p.shape[1]):
            highest_p, highest_q = max(highest_p, p[i, j]), max(highest_q, q[i, j])
    # explicit steps from zero strain miss what the state functions say there; they do so for c < 0 only
    return -least_p > _TENSION_NOISE * highest_p or -least_q > _TENSION_NOISE * highest_q or least_state < 0


# --- what the machine feels ---------------------------------------------------------------------------------


@_compiled
def across(slope, v_xx, v_xy, v_yx, v_yy):
    """Return n.(-e').n over the shear strain rate, n normal to a line of dx/dy = `slope`: 1 in uniaxial compaction.

    With stress and strain rate coaxial the normal stress there is p + 2 q / 3 times this.
    """
    xx, yy, xy, shear = _deviator(v_xx, v_xy, v_yx, v_yy)
    normal = (xx - 2 * slope * xy + slope * slope * yy) / (1 + slope * slope)
    return -normal / shear if shear > 0 else 0.0


@_compiled
def wall_force(bed, flow, y, p, q):
    """Return the integral of the normal stress over the height of the roll's streamline (point,), N/m."""
    line = _line(bed, flow, 1.0)
    force = old_normal = old_y = 0.0
    for j in range(y.size):
        normal, height = p[j], min(y[j], line.nip)
        if q[j] > 0:
            _, slope, _ = _shape(line, y[j])
            _, v_xx, v_xy, v_yx, v_yy = _gradient(line, flow, y[j], 1 - y[j] / line.height)
            normal += 2 / 3 * q[j] * across(slope, v_xx, v_xy, v_yx, v_yy)
        if j > 0:
            force += (old_y - height) * (normal + old_normal) / 2
        old_normal, old_y = normal, height
    return force


@_compiled
def power(bed, flow, y, speed, volumetric, shear, p, q):
    """Return the work of stress on the compacting bed, both halves of the gap, W/m; the last streamline is the roll's.

    Of the mid-plane's side the area between two points is X |v_y| dt / N.
    """
    tubes = y.shape[0] - 1
    total = 0.0
    for i in range(tubes):
        line, old_flux = _line(bed, flow, bed.xi[i]), 0.0
        for j in range(y.shape[1]):
            outer, slope, _ = _shape(line, y[i, j])
            t = line.xi * slope
            flux = outer * speed[i, j] / math.sqrt(1 + t * t)
            if volumetric[i, j] > 0:
                work = (p[i, j] + p[i, j - 1]) / 2 * volumetric[i, j] + (q[i, j] + q[i, j - 1]) / 2 * shear[i, j]
                total += (flux + old_flux) / 2 * work
            old_flux = flux
    return 2 / tubes * total
