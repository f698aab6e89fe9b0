"""The bed, compiled, and the only one there is: points, strains, stresses, wall force and power of every streamline.

Streamlines do not know of each other. Arrays are (streamline, point), entry to exit; `bed` is a
`hpgr.bed.geometry.Geometry`, `flow` and `elastic` are the constants of a law. A law has one branch, on its tag: a
speed profile in `_descent`, an elastic law in `_response`. The tests hold each against its law's NumPy equation.
"""

import math

import numpy as np
from numba import njit

from hpgr.laws.flow import NIP, POWER

_compiled = njit(cache=True, nogil=True, error_model="numpy")

_PANELS = 64  # 5-point Gauss on 64 panels: travel times to 1e-13 for every entry_fraction down to 1e-9
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2
_TENSION_NOISE = 1e-9  # of the largest stress; less is rounding of the running sum


# --- motion -------------------------------------------------------------------------------------------------


@_compiled
def nip_height(bed, flow):
    """Return the height above which the bed is not compacted by construction, R sin(alpha), m; the bed's if none."""
    return min(bed.radius * math.sin(flow.nip_angle), bed.height) if flow.nip_angle > 0 else bed.height


@_compiled
def _shape(bed, y):
    """Return half width X of the bed, m, X' and X'', 1/m."""
    return (
        bed.half_gap + y * y * (bed.b + bed.c * y),
        y * (2 * bed.b + 3 * bed.c * y),
        2 * bed.b + 6 * bed.c * y,
    )


@_compiled
def _descent(bed, flow, nip, xi, y, depth):
    """Return |v| and |v_y| over U on the streamline xi, and the derivatives of |v_y| / U by xi and, on it, by y."""
    outer, slope, curvature = _shape(bed, y)
    t = xi * slope
    steep = 1 + t * t
    if flow.law == NIP and y > nip:  # the bed keeps its density: |v_y| = g(xi) X_n / X
        nip_outer, nip_slope, _ = _shape(bed, nip)
        nip_t = xi * nip_slope
        g, wide = 1 / math.sqrt(1 + nip_t * nip_t), nip_outer / outer
        speed = math.sqrt(steep / (1 + nip_t * nip_t)) * nip_outer / outer
        return speed, wide * g, -wide * nip_t * nip_slope * g * g * g, -wide * g * slope / outer
    g = 1 / math.sqrt(steep)
    speed, by_y = 1.0, 0.0
    if flow.law == POWER:
        speed = depth if flow.exponent == 1.0 else depth**flow.exponent
        by_y = -flow.exponent * (1.0 if flow.exponent == 1.0 else speed / depth) / bed.height
    turn = speed * t * g * g * g
    return speed, speed * g, -turn * slope, by_y * g - turn * xi * curvature


@_compiled
def _gradient(bed, flow, nip, xi, y, depth):
    """Return |v| / U and the velocity gradient in U/H: v_xx, v_xy, v_yx, v_yy, where v_xy is the change of v_x by y.

    The velocity follows the streamline x = xi X(y); its direction varies with x at fixed y because xi does.
    """
    speed, fall, by_xi, by_y = _descent(bed, flow, nip, xi, y, depth)
    outer, slope, curvature = _shape(bed, y)
    t, v_y = xi * slope, -bed.height * fall
    v_yx = -bed.height * by_xi / outer
    v_yy = -bed.height * (by_y - by_xi * t / outer)
    t_x, t_y = slope / outer, xi * (curvature - slope * slope / outer)
    return speed, t_x * v_y + t * v_yx, t_y * v_y + t * v_yy, v_yx, v_yy


@_compiled
def _deviator(v_xx, v_xy, v_yx, v_yy):
    """Return xx, yy, zz and xy of the strain rate's deviator, and the triaxial shear rate sqrt(2/3 e':e')."""
    third = (v_xx + v_yy) / 3
    xx, yy, zz, xy = v_xx - third, v_yy - third, -third, (v_xy + v_yx) / 2
    return xx, yy, zz, xy, math.sqrt(2 / 3 * (xx * xx + yy * yy + zz * zz + 2 * xy * xy))


@_compiled
def rates(bed, flow, nip, xi, y, depth):
    """Return |v| / U, volumetric (compaction positive) and triaxial shear strain rate, in U/H."""
    speed, v_xx, v_xy, v_yx, v_yy = _gradient(bed, flow, nip, xi, y, depth)
    _, _, _, _, shear = _deviator(v_xx, v_xy, v_yx, v_yy)
    gripped = flow.nip_angle == 0 or y <= nip
    return speed, -(v_xx + v_yy) if gripped else 0.0, shear  # 0 by construction; what is left is rounding


@_compiled
def _at(bed, flow, place):
    """Return height and depth fraction of a place on the way up from the exit.

    Past a nip places are y/H. Above a stagnant entry they are -log(depth), which stays exact however close the
    first point comes to it.
    """
    if flow.nip_angle > 0:
        return bed.height * place, 1 - place
    return -bed.height * math.expm1(-place), math.exp(-place)


@_compiled
def _slowness(bed, flow, nip, xi, place):
    """Return the time a place takes to cross, in H/U."""
    y, depth = _at(bed, flow, place)
    _, fall, _, _ = _descent(bed, flow, nip, xi, y, depth)
    return 1 / fall if flow.nip_angle > 0 else depth / fall


@_compiled
def _travel(bed, flow, nip, xi, start, length):
    """Return the travel time from the place `start` on, by Gauss quadrature, in H/U."""
    total = 0.0
    for k in range(_NODES.size):
        total += _WEIGHTS[k] * _slowness(bed, flow, nip, xi, start + length * _NODES[k])
    return length * total


@_compiled
def _edges(bed, flow, nip):
    """Return the places between panels, exit to entry; panels end at the nip, where the speed has a kink."""
    edges = np.empty(_PANELS + 1)
    if flow.nip_angle == 0:
        step = -math.log(flow.entry_fraction) / _PANELS
        for k in range(_PANELS + 1):
            edges[k] = k * step
        return edges
    # high enough, on the mid-plane, that in the same time no tube begins below the nip, already compacted
    _, slope, _ = _shape(bed, nip)
    top = max(bed.height * (1 - flow.entry_fraction), nip * math.sqrt(1 + slope * slope))
    half = _PANELS // 2
    for k in range(half + 1):
        edges[k] = k * (nip / half) / bed.height
        edges[half + k] = (nip + k * ((top - nip) / half)) / bed.height
    return edges


@_compiled
def _tabulate(bed, flow, nip, xi, edges, times):
    """Fill `times` with the travel times from the exit to each of the panels' edges; return the last, in H/U."""
    times[0] = 0.0
    for k in range(_PANELS):
        times[k + 1] = times[k] + _travel(bed, flow, nip, xi, edges[k], edges[k + 1] - edges[k])
    return times[_PANELS]


@_compiled
def _march_back(bed, flow, nip, xi, edges, times, duration, places):
    """Fill the places of a streamline's points, equal times apart, by Newton's method inside their panels."""
    last, panel = places.size - 1, 0
    for j in range(last, -1, -1):
        wanted = duration * ((last - j) / last)
        while panel < _PANELS - 1 and times[panel + 1] <= wanted:
            panel += 1
        start, left = edges[panel], wanted - times[panel]
        # the linear guess is within 1e-2 of a panel; each pass squares the error
        panel_time = times[panel + 1] - times[panel]
        length = (edges[panel + 1] - start) * left / panel_time
        for _ in range(4):
            miss = _travel(bed, flow, nip, xi, start, length) - left
            length -= miss / _slowness(bed, flow, nip, xi, start + length)
            if abs(miss) <= 1e-8 * panel_time:
                break
        places[j] = start + length


@_compiled
def _past_nip(bed, xi, nip, y, way):
    """Return how much of the step that crosses the nip and ends at the height y, `way` long, lies past the nip."""
    # there |v| = U, so time is arc length over U; the chord of a step is 1e-6 short of its arc
    outer, _, _ = _shape(bed, y)
    nip_outer, _, _ = _shape(bed, nip)
    return min(math.hypot(xi * outer - xi * nip_outer, y - nip) / way, 1.0) if y < nip else 0.0


@_compiled
def _strain(bed, flow, nip, xi, surface_speed, time_step, y, volumetric_rate, shear_rate, volumetric, shear):
    """Fill the strains of the step that ends at each point of a streamline, by the trapezoid rule.

    They count from the onset of compaction: the first point that compacts, or the nip. Of the step with the nip only
    what lies past it counts, with the rates just past it.
    """
    volumetric[0] = shear[0] = 0.0
    begun = False
    for j in range(1, y.size):
        begun = begun or volumetric_rate[j - 1] > 0 or flow.nip_angle > 0
        past = time_step / 2 if begun else 0.0
        first_volumetric, first_shear = volumetric_rate[j - 1], shear_rate[j - 1]
        if flow.nip_angle > 0 and y[j - 1] > nip:
            past *= _past_nip(bed, xi, nip, y[j], surface_speed * time_step)
            _, first_volumetric, first_shear = rates(bed, flow, nip, xi, nip, 1 - nip / bed.height)
            first_volumetric /= bed.height / surface_speed
            first_shear /= bed.height / surface_speed
        volumetric[j] = (volumetric_rate[j] + first_volumetric) * past
        shear[j] = (shear_rate[j] + first_shear) * past


@_compiled
def lay(bed, flow, surface_speed, y, speed, volumetric_rate, shear_rate, volumetric, shear):
    """Lay the material points; return the time step, s.

    Fills heights, m, speeds, m/s, and strain rates, 1/s, of the points, and the strains of the step that ends at each.
    """
    lines, points = y.shape
    nip, unit_time = nip_height(bed, flow), bed.height / surface_speed
    edges, times, places = _edges(bed, flow, nip), np.empty(_PANELS + 1), np.empty(points)
    duration = _tabulate(bed, flow, nip, 0.0, edges, times)
    time_step = duration * unit_time / (points - 1)
    for i in range(lines):
        _tabulate(bed, flow, nip, bed.xi[i], edges, times)
        _march_back(bed, flow, nip, bed.xi[i], edges, times, duration, places)
        for j in range(points):
            y[i, j], depth = _at(bed, flow, places[j])
            relative, volumetric_rate[i, j], shear_rate[i, j] = rates(bed, flow, nip, bed.xi[i], y[i, j], depth)
            speed[i, j] = surface_speed * relative
            volumetric_rate[i, j] /= unit_time
            shear_rate[i, j] /= unit_time
        _strain(
            bed,
            flow,
            nip,
            bed.xi[i],
            surface_speed,
            time_step,
            y[i],
            volumetric_rate[i],
            shear_rate[i],
            volumetric[i],
            shear[i],
        )
    return time_step


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
def across(bed, flow, nip, y):
    """Return n.(-e').n over the shear strain rate on the roll's streamline, n its normal: 1 in uniaxial compaction.

    With stress and strain rate coaxial the normal stress there is p + 2 q / 3 times this.
    """
    _, v_xx, v_xy, v_yx, v_yy = _gradient(bed, flow, nip, 1.0, y, 1 - y / bed.height)
    xx, yy, _, xy, shear = _deviator(v_xx, v_xy, v_yx, v_yy)
    _, slope, _ = _shape(bed, y)
    normal = (xx - 2 * slope * xy + slope * slope * yy) / (1 + slope * slope)
    return -normal / shear if shear > 0 else 0.0


@_compiled
def wall_force(bed, flow, y, p, q):
    """Return the integral of the normal stress over the height of the roll's streamline (point,), N/m."""
    nip = nip_height(bed, flow)
    force = old_normal = old_y = 0.0
    for j in range(y.size):
        normal, height = p[j] + 2 / 3 * q[j] * across(bed, flow, nip, y[j]), min(y[j], nip)
        if j > 0:
            force += (old_y - height) * (normal + old_normal) / 2
        old_normal, old_y = normal, height
    return force


@_compiled
def power(bed, y, speed, volumetric, shear, p, q):
    """Return the work of stress on the compacting bed, both halves of the gap, W/m; the last streamline is the roll's.

    Of the mid-plane's side the area between two points is X |v_y| dt / N.
    """
    tubes = y.shape[0] - 1
    total = 0.0
    for i in range(tubes):
        old_flux = 0.0
        for j in range(y.shape[1]):
            outer, slope, _ = _shape(bed, y[i, j])
            t = bed.xi[i] * slope
            flux = outer * speed[i, j] / math.sqrt(1 + t * t)
            if volumetric[i, j] > 0:
                work = (p[i, j] + p[i, j - 1]) / 2 * volumetric[i, j] + (q[i, j] + q[i, j - 1]) / 2 * shear[i, j]
                total += (flux + old_flux) / 2 * work
            old_flux = flux
    return 2 / tubes * total


@_compiled
def force_at_roll(bed, flow, elastic, feed_solid_fraction, max_solid_fraction, surface_speed, points):
    """Return the force on a bed whose only streamline is the roll's, N/m: all that a floating gap asks for."""
    work, limited = np.empty((11, 1, points)), np.empty((1, points), np.bool_)
    y, volumetric_rate, volumetric, shear, p, q = work[0], work[1], work[2], work[3], work[4], work[5]
    time_step = lay(bed, flow, surface_speed, y, work[6], volumetric_rate, work[7], volumetric, shear)
    state = work[8], work[9], work[10], p, q, limited
    load(elastic, feed_solid_fraction, max_solid_fraction, time_step, volumetric_rate, volumetric, shear, state)
    return wall_force(bed, flow, y[0], p[0], q[0])
