"""A replay's outputs against the truth: errors of position, orientation and velocity, and whether the covariances are right."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_reader import Bag, open_bag
from ctr_dynamics.io.messages.cdr import decode_numbers
from ctr_dynamics.io.messages.topics import STEP_NS, TIP_POSE, TIP_POSE_PREDICTED, TIP_TWIST, VALID
from ctr_dynamics.io.truth_files import Truth, read_truth
from ctr_dynamics.kernels.rotations import conjugate_rows, multiply_rows, to_vector_rows

Floats = NDArray[np.float64]
_XYZW_TO_WXYZ = [3, 0, 1, 2]


class _Series(NamedTuple):
    """Messages of a topic: stamps (k,) ns and their numbers (k, n)."""

    stamps: NDArray[np.int64]
    numbers: Floats


def evaluate(outputs: Path, truth_file: Path) -> dict[str, Any]:
    """Compare outputs with the truth at every valid step that both cover.

    Args:
        outputs: a bag that ``replay --output`` or a node wrote.
        truth_file: see :func:`ctr_dynamics.io.truth_files.read_truth`.

    Returns:
        ``steps`` compared, and those ``outside`` the time of the truth; ``position_m`` (fused) and ``predicted_m`` (open loop),
        ``tracker_position_m`` (fused against what an ideal tracker reports, where the truth has it), ``orientation_rad`` and ``velocity_m_s``: each
        with ``rms``, ``mean`` and ``max`` of the length of the error. ``nees`` of ``position``, ``orientation`` and ``velocity``: mean per degree of
        freedom (1 for right covariances), and ``beyond_3_sigma``, the share of the steps beyond three deviations (0.03 in three dimensions for a
        normal error).

    Raises:
        InputError: no outputs, or none in the time of the truth.
    """
    bag, truth = open_bag(outputs), read_truth(truth_file)
    wanted = {TIP_POSE: 43, TIP_TWIST: 42, TIP_POSE_PREDICTED: 7}
    series, before = _read(bag, wanted)
    poses = series[TIP_POSE]
    if not len(poses.stamps):
        raise InputError(
            f"holds no message on {TIP_POSE}",
            do="give a bag that `ctr-dynamics replay --output` wrote",
            where=str(outputs),
        )
    start_ns = truth.start_ns if truth.start_ns is not None else int(poses.stamps[0]) - before * STEP_NS
    result: dict[str, Any] = {"start_ns": start_ns}
    at = _Interpolated(truth, start_ns)
    inside = at.covers(poses.stamps)
    if not inside.any():
        raise InputError(
            f"no output lies in the time of the truth, {truth.t[0]:.3f} to {truth.t[-1]:.3f} s after stamp {start_ns} ns",
            do="give the truth of that bag",
            where=str(truth_file),
        )
    stamps, numbers = poses.stamps[inside], poses.numbers[inside]
    covariance = numbers[:, 7:].reshape(-1, 6, 6)
    result["steps"], result["outside"] = len(stamps), int((~inside).sum())
    error = numbers[:, :3] - at(truth.position, stamps)
    result["position_m"] = _sizes(error)
    nees = {"position": _nees(error, covariance[:, :3, :3])}
    if truth.tracker_position is not None:
        error = numbers[:, :3] - at(truth.tracker_position, stamps)
        result["tracker_position_m"] = _sizes(error)
        nees["tracker_position"] = _nees(error, covariance[:, :3, :3])
    if truth.quaternion is not None:
        true = at(truth.quaternion, stamps)
        true /= np.linalg.norm(true, axis=1, keepdims=True)
        turned = multiply_rows(numbers[:, 3:7][:, _XYZW_TO_WXYZ], conjugate_rows(true))
        error = to_vector_rows(turned)
        result["orientation_rad"] = _sizes(error)
        nees["orientation"] = _nees(error, covariance[:, 3:, 3:])
    if truth.velocity is not None:
        twists = series[TIP_TWIST]
        inside = at.covers(twists.stamps)
        error = twists.numbers[inside, :3] - at(truth.velocity, twists.stamps[inside])
        result["velocity_m_s"] = _sizes(error)
        nees["velocity"] = _nees(error, twists.numbers[inside, 6:].reshape(-1, 6, 6)[:, :3, :3])
    predicted = series[TIP_POSE_PREDICTED]
    inside = at.covers(predicted.stamps)
    result["predicted_m"] = _sizes(
        predicted.numbers[inside, :3] - at(truth.position, predicted.stamps[inside])
    )
    return {**result, "nees": nees}


def _read(bag: Bag, wanted: dict[str, int]) -> tuple[dict[str, _Series], int]:
    """The topics' numbers, and how many steps lie before the first valid one."""
    stamps: dict[str, list[int]] = {topic: [] for topic in wanted}
    rows: dict[str, list[tuple]] = {topic: [] for topic in wanted}
    before = 0
    for topic, _, data in bag.messages({*wanted, VALID}):
        if topic != VALID:
            stamp_ns, _, numbers = decode_numbers(data, wanted[topic])
            stamps[topic].append(stamp_ns)
            rows[topic].append(numbers)
        elif not stamps[TIP_POSE]:
            before += 1
    return {
        topic: _Series(np.array(stamps[topic], dtype=np.int64), np.array(rows[topic]).reshape(-1, count))
        for topic, count in wanted.items()
    }, before


class _Interpolated:
    """Arrays of a truth at stamps, linear in between."""

    def __init__(self, truth: Truth, start_ns: int) -> None:
        self.t, self.start_ns = truth.t, start_ns

    def seconds(self, stamps: NDArray[np.int64]) -> Floats:
        return np.asarray((stamps - self.start_ns) * 1e-9, dtype=float)

    def covers(self, stamps: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Stamps between the truth's first and last time, with a nanosecond for rounding."""
        t = self.seconds(stamps)
        return np.asarray((t >= self.t[0] - 1e-9) & (t <= self.t[-1] + 1e-9))

    def __call__(self, values: Floats, stamps: NDArray[np.int64]) -> Floats:
        t = self.seconds(stamps)
        return np.stack([np.interp(t, self.t, column) for column in values.T], axis=1)


def _sizes(error: Floats) -> dict[str, float | None]:
    """Root mean square, mean and largest length of errors (k, 3)."""
    if not len(error):
        return {"rms": None, "mean": None, "max": None}
    size = np.linalg.norm(error, axis=1)
    return {"rms": float(np.sqrt(np.mean(size**2))), "mean": float(size.mean()), "max": float(size.max())}


def _nees(error: Floats, covariance: Floats) -> dict[str, float | None]:
    """Normalised estimation error squared of errors (k, 3) with covariances (k, 3, 3); those without volume, as at rest, are left out."""
    size = np.trace(covariance, axis1=1, axis2=2) / 3.0
    regular = np.linalg.det(covariance) > 1e-12 * size**3
    if not regular.any():
        return {"mean": None, "beyond_3_sigma": None}
    e, c = error[regular], covariance[regular]
    squares = np.einsum("ki,ki->k", e, np.linalg.solve(c, e[:, :, None])[:, :, 0])
    return {"mean": float(squares.mean()) / 3.0, "beyond_3_sigma": float(np.mean(squares > 9.0))}
