"""Actuators and load at the stages of a step, from the values around them in time."""

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.layout import input_rows

compiled = njit(cache=True, nogil=True, error_model="numpy")


@compiled
def on_lines(values, time_ns, value, rate):
    """``value`` (size,) and its ``rate``, 1/s, at a time on the lines through three ``values`` and their stamps in ns. At the middle one the
    rate is that of the first line."""
    before, middle, after, before_ns, middle_ns, after_ns = values
    first = time_ns <= middle_ns
    begin, end = (before, middle) if first else (middle, after)
    begin_ns, end_ns = (before_ns, middle_ns) if first else (middle_ns, after_ns)
    for i in range(len(value)):
        rate[i] = (end[i] - begin[i]) * (1e9 / (end_ns - begin_ns))
        value[i] = begin[i] + rate[i] * ((time_ns - begin_ns) * 1e-9)


@compiled
def stage_rows(times, t0_ns, joints, load, rows, beta_rate):
    """Fill ``rows`` (stages, inputs) and ``beta_rate`` (N,) at ``times`` (s after ``t0_ns``) from the values around them; see :func:`on_lines`.

    The order in a row is that of :data:`ctr_dynamics.kernels.layout.INPUTS`.
    """
    n = len(beta_rate)
    given = input_rows(n)
    value, rate = np.empty(2 * n), np.empty(2 * n)
    wrench, change = np.empty(6), np.empty(6)
    for k in range(len(times)):
        time_ns = t0_ns + np.int64(np.rint(times[k] * 1e9))
        on_lines(joints, time_ns, value, rate)
        on_lines(load, time_ns, wrench, change)
        for i in range(n):
            rows[k, given.alpha + i], rows[k, given.alpha_rate + i] = value[i], rate[i]
            rows[k, given.beta + i] = value[n + i]
        for i in range(6):  # force and torque
            rows[k, given.force + i] = wrench[i]
        for i in range(rows.shape[1] - given.beta_rate):
            rows[k, given.beta_rate + i] = rate[n + i]
    beta_rate[:] = rate[n:]


@compiled
def corrected_rows(bare, load, effect, theta, rows):
    """Into ``rows`` (stages, inputs): ``bare`` with the ``load`` (inputs,) and what the parameters ``theta`` (p,) add by their ``effect`` (inputs,
    p)."""
    for i in range(bare.shape[1]):
        shift = load[i]
        for k in range(len(theta)):
            shift += effect[i, k] * theta[k]
        for stage in range(len(bare)):
            rows[stage, i] = bare[stage, i] + shift
