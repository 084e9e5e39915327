"""A measurement against the tip of its time: innovation, covariance and noise, with what is known of the tracker's timing."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.adapted_variances import AdaptedVariances
from ctr_dynamics.estimation.filter.expected_tracker import ExpectedTracker
from ctr_dynamics.estimation.filter.filter_records import TipComparison, Update
from ctr_dynamics.estimation.filter.jitter_noise import with_jitter
from ctr_dynamics.sensing import Tip
from ctr_dynamics.sensing.tracker import DELAY, STATES

Floats = NDArray[np.float64]
NEGLIGIBLE = 1e-4  # of a variance: half a ten thousandth of the deviation


def second_order(variance: Floats, axes: NDArray[np.int64], length: float) -> Floats:
    """(a,) mean squares of what the tangent of the tip's motion misses, m^2 and rad^2.

    A robot of ``length`` (m) that turns its tip by an angle moves it on an arc. The next term of the series is half the square of the angle, or of
    the way by the length. Where these are normal, its mean square is three quarters of the square of their variance.

    Args:
        variance: (a,) m^2 and rad^2, of the tip, on the measured ``axes`` (a,) out of 0 to 5.
    """
    turns = axes >= 3
    way, angle = float(variance[~turns].sum()), float(variance[turns].sum())
    found: Floats = 0.75 * np.where(turns, angle, way / length) ** 2
    return found


def compare_with_tip(
    expected: ExpectedTracker,
    tip_at: Callable[[float], Tip | None],
    dt: float,
    bias: Floats,
    pi: Floats,
    adapted: AdaptedVariances,
    stamp: float,
    position: Floats,
    quaternion: Floats,
    stamp_error_s: float = 0.0,
) -> Update | TipComparison:
    """A measurement against the tip of its time; the record alone where there is nothing to compare it with.

    Args:
        expected: the tracker.
        tip_at: the tip with its columns at a time (s); None outside the window. dt: s, of a step.
        bias: (22,) tracker states. pi: (r + 22, r + 22) covariance. adapted: noise of the tracker.
        stamp, position, quaternion, stamp_error_s: of the measurement; see :meth:`~ctr_dynamics.estimation.filter.ekf.RodEkf.update`.
    """
    tracker = expected.model
    time = stamp - tracker.delay - bias[DELAY]
    tip = tracker.observed_tip(tip_at, time)
    if tip is None:
        return Update.impossible("outside the window of stored steps")
    nu, H, S, whitened = tracker.innovation(bias, tip, pi, position, quaternion)
    if not math.isfinite(nu.sum() + S.sum() + whitened.sum()):
        return Update.impossible("the innovation is not finite")
    extra_noise, half_jitter_gain, noise = np.zeros_like(S), 0.0, tracker.noise
    bent = second_order(S.diagonal() - noise.diagonal(), tracker.axes, adapted.reach)
    if (bent > NEGLIGIBLE * noise.diagonal()).any():
        extra_noise += np.diag(bent)
        S += extra_noise
    scatter = expected.scatter(stamp_error_s)
    if adapted.noisy or scatter or expected.slower:
        S += (adapted.noise - 1.0 if adapted.noisy else 0.0) * noise
        slower = expected.slower.observed_tip(tip_at, time) if expected.slower else None
        if slower is not None:
            change = tracker.innovation(bias, slower, pi, position, quaternion)[0] - nu
            added = np.multiply.outer(change, change)
            extra_noise += added
            S += added
        if scatter:
            before, at = tracker.observed_tip(tip_at, time - dt) or tip, len(pi) - STATES + DELAY
            earlier = tracker.innovation(bias, before, pi, position, quaternion)[1]
            scattered = with_jitter(nu, S, noise, scatter, -H[:, at], -earlier[:, at], dt)
            nu, S, half_jitter_gain = scattered.nu, scattered.S, scattered.half_jitter_gain
            extra_noise += scattered.extra_noise
        whitened = np.linalg.solve(np.linalg.cholesky(S), nu)
    axes, (residual, variance, white) = tracker.axes, np.full((3, 6), np.nan)
    residual[axes], variance[axes], white[axes] = nu, S.diagonal(), whitened
    nis = float(whitened @ whitened)
    record = Update(residual, variance, nis, len(nu), False, "", white, half_jitter_gain=half_jitter_gain)
    return TipComparison(nu, H, S, extra_noise, record)
