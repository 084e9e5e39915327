"""What a measured position says of every delay of the tracker. See :mod:`ctr_dynamics.estimation.monitoring.delay_search`."""

import math

import numpy as np

from ctr_dynamics.kernels.compiler import njit

compiled = njit(cache=True, nogil=True, error_model="numpy")
NEGLIGIBLE = -40.0  # logarithm of a weight beside the largest: below the last digit


@compiled
def density_about(level, residual, total, spread):
    """Logarithm of the density of a ``residual`` (3,) about a ``level`` (3,), by that of the noise at zero; ``total``: m^2, its variance per axis,
    and ``spread`` 3 log of that by the noise's. As :func:`~ctr_dynamics.estimation.monitoring.densities.log_density`."""
    square = 0.0
    for axis in range(3):
        square += (residual[axis] - level[axis]) ** 2
    return -0.5 * (square / total + spread)


@compiled
def weigh_delays(residual, before, told, level, evidence):
    """Evidence for delays that have been there since the start, with another measurement.

    ``residual`` (d, 3): m, how far it lies from the open-loop run with every delay. ``before``: level (d, 3) and evidence (d,) up to the last one.
    ``told``: variance of the noise and of a residual (m^2 per axis), gain of the level, and the part of the evidence that counts on. Fills ``level``
    and ``evidence``.
    """
    old_level, old_evidence = before
    noise, total, gain, decay = told
    spread = 3.0 * math.log(total / noise)
    for i in range(len(residual)):
        evidence[i] = decay * old_evidence[i] + density_about(old_level[i], residual[i], total, spread)
        for axis in range(3):
            level[i, axis] = old_level[i, axis] + gain * (residual[i, axis] - old_level[i, axis])


@compiled
def weigh_vibrating(residual, transition, seen, gains, totals, noise, decay, states, evidence):
    """Evidence for delays beside vibrations that the open-loop run lacks, with another measurement.

    ``residual`` (d, 3): m, how far it lies from that run with every delay. ``transition`` (n, n): of level and vibrations of an axis since the last
    one, ``seen`` (n,): which of them a measurement shows. ``gains`` (g, n) and ``totals`` (g,) m^2: of every amplitude. ``noise``: m^2.
    ``decay``: part of the evidence that counts on. Moves ``states`` (g, d, 3, n) and ``evidence`` (g, d).
    """
    size = len(seen)
    moved = np.empty(size)
    for g in range(len(totals)):
        spread = 3.0 * math.log(totals[g] / noise)
        for i in range(len(residual)):
            square = 0.0
            for axis in range(3):
                expected = 0.0
                for row in range(size):
                    value = 0.0
                    for column in range(size):
                        value += transition[row, column] * states[g, i, axis, column]
                    moved[row] = value
                    expected += seen[row] * value
                apart = residual[i, axis] - expected
                square += apart * apart
                for row in range(size):
                    states[g, i, axis, row] = moved[row] + gains[g, row] * apart
            evidence[g, i] = decay * evidence[g, i] - 0.5 * (square / totals[g] + spread)


@compiled
def weigh_changes(residual, before, told, begun, level, evidence, began_ns):
    """Evidence for delays that came about by a change, at the time that speaks most for it; arguments as of :func:`weigh_delays`.

    ``before``: level, evidence and stamps (d,) before the change, up to the last measurement. ``begun``: level (3,), evidence and stamp of a tracker
    that changes after the last measurement. Fills ``level``, ``evidence`` and ``began_ns``.
    """
    old_level, old_evidence, old_began_ns = before
    now_level, now_evidence, now_ns = begun
    noise, total, gain, decay = told
    spread = 3.0 * math.log(total / noise)
    for i in range(len(residual)):
        on = decay * old_evidence[i] + density_about(old_level[i], residual[i], total, spread)
        new = now_evidence + density_about(now_level, residual[i], total, spread)
        evidence[i], began_ns[i] = (new, now_ns) if new > on else (on, old_began_ns[i])
        for axis in range(3):
            was = now_level[axis] if new > on else old_level[i, axis]
            level[i, axis] = was + gain * (residual[i, axis] - was)


@compiled
def compare_delays(delays, ways, present, least, prior, now):
    """Delays that are farther than ``least`` from the ``present`` one, against it and whatever else has the evidence ``now``.

    ``delays`` (d,); ``ways`` (w, d): logarithm of their evidence in every way. ``prior``: logarithm, of each. Returns the logarithm of the odds of
    all, the mean and the deviation of those near the likeliest, and the part of the probability that these have.
    """
    top, likeliest = -math.inf, present
    for way in range(len(ways)):
        for i in range(len(delays)):
            if abs(delays[i] - present) <= least:
                now = max(now, ways[way, i])
            elif ways[way, i] > top:
                top, likeliest = ways[way, i], delays[i]
    if top == -math.inf:
        return -math.inf, present, 0.0, 0.0
    total = near = mean = square = 0.0
    for way in range(len(ways)):
        for i in range(len(delays)):
            below = ways[way, i] - top
            if abs(delays[i] - present) <= least or below < NEGLIGIBLE:
                continue
            weight, away = math.exp(below), delays[i] - likeliest
            total += weight
            if abs(away) <= 2.0 * least:
                near += weight
                mean += weight * away
                square += weight * away * away
    mean /= near
    spread = math.sqrt(max(square / near - mean * mean, 0.0))
    return top + prior + math.log(total) - now, likeliest + mean, spread, near / total
