"""One bag seen through the model: what the tracker should have read for any values of the effects, and its derivatives.

The way is the estimator's: readings to actuators (:class:`ctr_dynamics.effects.Setup`), the dynamic model, tip to tracker. Derivatives by
quantities that move the model go through the tangent of every step; those of the tracker chain are differences of the last link alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.effects import EFFECTS, Quantity, Setup, apply_effects, make_setup
from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.backlash import play
from ctr_dynamics.kernels.lanes import PACK
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.model.trajectory import InputRows, Trajectory, run
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing.interpolation import Signal

Floats = NDArray[np.float64]
Point = Mapping[
    tuple[str, str], float
]  # coordinates of quantities that are not at their off-values, by (effect, name)
NODES = 10  # from plate to tip: the error in space is then far below that in time (numerics.py measures both)
FRACTION = 1e-3  # of a quantity's unit, for differences of what is cheap to evaluate
GAP = 0.05  # s between joint states beyond which nothing is known of the motion between them
AVERAGE_POINTS = np.array([0.04691008, 0.23076534, 0.5, 0.76923466, 0.95308992])
AVERAGE_WEIGHTS = np.array([0.11846344, 0.23931434, 0.28444444, 0.23931434, 0.11846344])
_INPUTS = ("gain", "offset", "backlash", "beta_offset", "actuator_delay", "load_shift", "tip_force")


@dataclass(frozen=True)
class Prediction:
    """What the tracker should have read.

    Attributes:
        position: (s, 3) m; quaternion: (s, 4) wxyz, at the recording's stamps. trajectory: the tip behind it. failure: empty when whole.
    """

    position: Floats
    quaternion: Floats
    trajectory: Trajectory
    failure: str


class ForwardModel:
    """A recording and a robot.

    Args:
        nodes, dt: the model's resolution.
    """

    def __init__(self, recording: Recording, robot: Robot, nodes: int = NODES, dt: float = 0.003) -> None:
        self.recording, self.robot, self.nodes = recording, robot, nodes
        self.scheme = make_scheme("sdirk3", dt)
        self._models = {False: Model(robot, nodes=nodes), True: Model(robot, nodes=nodes, extended=True)}
        self.nominal = make_setup(self._models[False])
        load = Signal(6)
        for time, *wrench in recording.load.tolist():
            load.add(round(time * 1e9), np.array(wrench))
        # a step across a sharp bend of the load would make the error of the prediction depend on where in the step it lies, and the misfit a
        # rough function of every delay
        bends = load.bends(-np.inf, np.inf, self._models[False].load_kink / dt)
        self._load_events = 1e-9 * np.array(bends, dtype=float)

    def resolved(self, nodes: int, dt: float) -> ForwardModel:
        """The same at another resolution."""
        same = nodes == self.nodes and dt == self.scheme.dt
        return self if same else ForwardModel(self.recording, self.robot, nodes, dt)

    # -- the chain --

    def setup(self, point: Point) -> Setup:
        """Setup at ``point``."""
        setup = self.nominal.copy()
        values: dict[str, dict[str, float]] = {}
        for (effect, name), coordinate in point.items():
            values.setdefault(effect, {})[name] = EFFECTS[effect].find(name).value(coordinate)
        apply_effects(setup, values)
        return setup

    def inputs(self, setup: Setup, extended: bool) -> InputRows:
        """Actuators and load at any times, as the model takes them."""
        n, joints, load = setup.n, self.recording.joints, self.recording.load
        t = joints[:, 0]
        alpha = joints[:, 1 : 1 + n] * setup.gain + setup.offset
        for i in range(n):
            if setup.backlash[i] > 0.0:
                alpha[:, i] = play(np.ascontiguousarray(alpha[:, i]), setup.backlash[i])
        beta = joints[:, 1 + n : 1 + 2 * n] + setup.beta_offset
        steps = np.diff(t)
        turned = smooth(t, alpha)
        slides = np.diff(beta, axis=0) / steps[:, None]
        width = (4 if extended else 3) * n + 6

        def rows(times: Floats) -> Floats:
            out = np.zeros((len(times), width))
            out[:, :n], out[:, n : 2 * n] = turned(times - setup.actuator_delay)
            for i in range(n):
                out[:, 2 * n + i] = np.interp(times, t, beta[:, i])
            if len(load):
                for i in range(6):
                    out[:, 3 * n + i] = np.interp(times - setup.load_shift, load[:, 0], load[:, 1 + i])
            out[:, 3 * n : 3 * n + 3] += setup.tip_force
            if extended:
                interval = np.clip(np.searchsorted(t, times, side="left") - 1, 0, len(steps) - 1)
                out[:, 3 * n + 6 :] = np.where(
                    ((times > t[0]) & (times <= t[-1]))[:, None], slides[interval], 0.0
                )
            return out

        return rows

    def _observe(self, setup: Setup, trajectory: Trajectory) -> tuple[Floats, Floats]:
        """(position (s, 3), quaternion (s, 4)) that the tracker chain makes of a trajectory."""
        stamps = self.recording.stamps
        times = stamps / (1.0 + setup.skew) - setup.delay
        tip = trajectory.tip[:, :7]
        rows = _mean(tip, trajectory.t, times, _window(setup))
        h = rows[:, 3:] / np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
        point = setup.tracker_scale * (rows[:, :3] + rotate(h, setup.lever))
        position = rotate(setup.rotation, point) + setup.translation + setup.drift * stamps[:, None]
        return position, product(setup.rotation, h)

    # -- predictions --

    def predict(self, point: Point) -> Prediction:
        """The tracker's readings at ``point``; where the simulation ends early they are NaN."""
        setup = self.setup(point)
        trajectory = self._run(setup, setup.extended)
        position, quaternion = self._observe(setup, trajectory)
        if trajectory.failure:
            late = self.recording.stamps > trajectory.t[-1]
            position[late], quaternion[late] = np.nan, np.nan
        return Prediction(position, quaternion, trajectory, trajectory.failure)

    def _run(self, setup: Setup, extended: bool, **columns: object) -> Trajectory:
        return run(
            self._models[extended],
            self.scheme,
            setup.block,
            self.inputs(setup, extended),
            self.recording.duration,
            events=(self._load_events + setup.load_shift).tolist(),
            **columns,  # type: ignore[arg-type]
        )

    def residual(self, prediction: Prediction) -> Floats:
        """(s, 6) reading minus prediction: position in m in the tracker's axes, rotation vector in rad in the sensor's axes."""
        return np.hstack(
            [
                self.recording.position - prediction.position,
                to_vectors(product(conjugated(prediction.quaternion), self.recording.quaternion)),
            ]
        )

    def residual_at(self, point: Point) -> Floats | None:
        """(s, 6) residual of the prediction at ``point``; None where it cannot be simulated to the end."""
        try:
            prediction = self.predict(point)
        except InputError:  # no equilibrium to start from
            return None
        return None if prediction.failure else self.residual(prediction)

    def jacobian(self, point: Point, wanted: Sequence[Quantity]) -> tuple[Prediction, Floats]:
        """Prediction at ``point`` and its derivatives (s, 6, len(wanted)) by the coordinates of ``wanted``, each times its ``scale``."""
        setup = self.setup(point)
        changed = [self.setup(moved(point, q, FRACTION)) for q in wanted]
        kinds: list[str] = []
        for other in changed:
            model = not np.array_equal(other.block, setup.block) or any(
                not np.array_equal(getattr(other, name), getattr(setup, name)) for name in _INPUTS
            )
            needs = model and (setup.extended or other.extended)
            kinds.append("tracker" if not model else "extended" if needs else "plain")
        numbers = {kind: [i for i, k in enumerate(kinds) if k == kind] for kind in ("plain", "extended")}
        if numbers["extended"] and len(numbers["plain"]) <= -len(numbers["extended"]) % PACK:
            # the extended model has the same derivatives, and room left in its last pack of columns
            numbers["extended"] += numbers["plain"]
            numbers["plain"] = []
        columns = np.zeros((len(self.recording.stamps), 6, len(wanted)))
        prediction: Prediction | None = None
        for kind, chosen in numbers.items():
            if not chosen and not (kind == "extended" and prediction is None):
                continue
            extended = kind == "extended" and (bool(chosen) or setup.extended)
            trajectory = self._columns(setup, [changed[i] for i in chosen], extended)
            position, quaternion = self._observe(setup, trajectory)
            if trajectory.failure:
                position[self.recording.stamps > trajectory.t[-1]] = np.nan
            if prediction is None or trajectory.failure:
                prediction = Prediction(position, quaternion, trajectory, trajectory.failure)
            if chosen:
                columns[:, :, chosen] = self._through(setup, trajectory)
        assert prediction is not None
        for i, kind in enumerate(kinds):
            if kind == "tracker":
                position, quaternion = self._observe(changed[i], prediction.trajectory)
                columns[:, :3, i] = (position - prediction.position) / FRACTION
                columns[:, 3:, i] = (
                    to_vectors(product(conjugated(prediction.quaternion), quaternion)) / FRACTION
                )
        return prediction, np.nan_to_num(columns)

    def _columns(self, setup: Setup, changed: Sequence[Setup], extended: bool) -> Trajectory:
        if not changed:
            return self._run(setup, extended)
        effect = np.stack([(other.block - setup.block) / FRACTION for other in changed], axis=1)
        base = self.inputs(setup, extended)
        moving = [
            (i, self.inputs(other, extended))
            for i, other in enumerate(changed)
            if any(not np.array_equal(getattr(other, name), getattr(setup, name)) for name in _INPUTS)
        ]
        width = self._models[extended].input_count

        def input_effect(times: Floats) -> Floats:
            out = np.zeros((len(times), width, len(changed)))
            here = base(times)
            for i, rows in moving:
                out[:, :, i] = (rows(times) - here) / FRACTION
            return out

        return self._run(setup, extended, effect=effect, input_effect=input_effect)

    def _through(self, setup: Setup, trajectory: Trajectory) -> Floats:
        """Columns of the tip as columns of the readings, (s, 6, r)."""
        assert trajectory.columns is not None
        times = self.recording.stamps / (1.0 + setup.skew) - setup.delay
        flat = trajectory.columns[:, :7].reshape(len(trajectory.t), -1)
        tip = trajectory.tip[:, :7]
        parts = _window(setup)
        rows = _mean(flat, trajectory.t, times, parts).reshape(len(times), 7, -1)
        h = _mean(tip, trajectory.t, times, parts)[:, 3:]
        norm2 = np.sum(h * h, axis=1)[:, None]
        r = rows.shape[2]
        back = conjugated(h)
        # body rotation vector of a change of a quaternion of any length: 2 vec(h^-1 dh) / |h|^2
        dh = rows[:, 3:].transpose(0, 2, 1)
        turn = 2.0 * product(back[:, None, :].repeat(r, axis=1).reshape(-1, 4), dh.reshape(-1, 4))[:, 1:]
        turn = turn.reshape(len(times), r, 3) / norm2[:, :, None]
        swing = np.cross(turn, setup.lever)
        unit = h / np.sqrt(norm2)
        swing = rotate(unit[:, None, :].repeat(r, axis=1).reshape(-1, 4), swing.reshape(-1, 3)).reshape(
            len(times), r, 3
        )
        shift = setup.tracker_scale * (rows[:, :3].transpose(0, 2, 1) + swing)
        shift = rotate(setup.rotation, shift.reshape(-1, 3)).reshape(len(times), r, 3)
        return np.concatenate([shift, turn], axis=2).transpose(0, 2, 1)


def moved(point: Point, quantity: Quantity, share: float) -> dict[tuple[str, str], float]:
    """``point`` with one coordinate changed by ``share`` of its scale."""
    other = dict(point)
    other[quantity.key] = other.get(quantity.key, quantity.off) + share * quantity.scale
    return other


def at_times(values: Floats, t: Floats, times: Floats) -> Floats:
    """Rows of ``values`` (K, c) on the even grid ``t`` at ``times``, by cubics through four neighbours; held outside."""
    if len(t) < 4:  # a simulation that failed at once
        return np.repeat(values[-1:], len(times), axis=0)
    dt = t[1] - t[0]
    x = np.clip((times - t[0]) / dt, 0.0, len(t) - 1.0)
    i = np.clip(np.floor(x).astype(int), 1, max(len(t) - 3, 1))
    x = (x - i)[:, None]
    weights = (
        -x * (x - 1.0) * (x - 2.0) / 6.0,
        (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0,
        -(x + 1.0) * x * (x - 2.0) / 2.0,
        (x + 1.0) * x * (x - 1.0) / 6.0,
    )
    last = len(t) - 1
    out = np.zeros((len(times), values.shape[1]))
    for k, w in enumerate(weights):
        out += w * values[np.minimum(i + k - 1, last)]
    return out


def smooth(t: Floats, values: Floats) -> Callable[[Floats], tuple[Floats, Floats]]:
    """Values and rates at any times (k,) of samples (s, n) at ``t`` (s,): cubic between samples with the slope of the two neighbours at each (Catmull
    and Rom), a straight line across gaps, held outside.

    Encoders scatter. A straight line from sample to sample has a bend at each, which steps in time of much the same length meet or miss; the
    misfit would be a rough function of every delay.
    """
    h = np.diff(t)[:, None]
    secants = np.diff(values, axis=0) / h
    slopes = np.vstack(
        [secants[:1], (h[:-1] * secants[1:] + h[1:] * secants[:-1]) / (h[:-1] + h[1:]), secants[-1:]]
    )
    gap = h > GAP
    first, last = (np.where(gap, secants, s) for s in (slopes[:-1], slopes[1:]))

    def at(times: Floats) -> tuple[Floats, Floats]:
        i = np.clip(np.searchsorted(t, times, side="left") - 1, 0, len(h) - 1)
        x = np.clip((times - t[i]) / h[i, 0], 0.0, 1.0)[:, None]
        a, b, d = first[i] - secants[i], last[i] - secants[i], secants[i]
        value = values[i] + h[i] * x * (d + (1.0 - x) * ((1.0 - x) * a - x * b))
        rate = d + (1.0 - x) * (1.0 - 3.0 * x) * a - x * (2.0 - 3.0 * x) * b
        inside = (times > t[0]) & (times <= t[-1])
        return value, np.where(inside[:, None], rate, 0.0)

    return at


def _window(setup: Setup) -> list[tuple[float, float]]:
    """(age in s, weight) of what a tracker averages."""
    if setup.averaging <= 0.0:
        return [(0.0, 1.0)]
    return [
        (float(x) * setup.averaging, float(w)) for x, w in zip(AVERAGE_POINTS, AVERAGE_WEIGHTS, strict=True)
    ]


def _mean(values: Floats, t: Floats, times: Floats, parts: Sequence[tuple[float, float]]) -> Floats:
    """Weighted mean of ``values`` at ``times`` minus the ages of ``parts``."""
    out = np.zeros((len(times), values.shape[1]))
    for age, weight in parts:
        out += weight * at_times(values, t, times - age)
    return out


def conjugated(h: Floats) -> Floats:
    """Inverses of unit quaternions (k, 4)."""
    return h * np.array([1.0, -1.0, -1.0, -1.0])


def product(a: Floats, b: Floats) -> Floats:
    """Hamilton products of quaternions (k, 4) or (4,), row by row."""
    aw, ax, ay, az = np.moveaxis(np.atleast_2d(a), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.atleast_2d(b), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def rotate(h: Floats, v: Floats) -> Floats:
    """Vectors (k, 3) or (3,) turned by unit quaternions (k, 4) or (4,), row by row."""
    h, v = np.atleast_2d(h), np.atleast_2d(v)
    w, u = h[:, :1], h[:, 1:]
    return v + 2.0 * np.cross(u, np.cross(u, v) + w * v)


def to_vectors(h: Floats) -> Floats:
    """Rotation vectors (k, 3) rad, shorter than pi, of unit quaternions (k, 4)."""
    h = np.where(h[:, :1] < 0.0, -h, h)
    norm = np.linalg.norm(h[:, 1:], axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(norm, h[:, :1])
    return h[:, 1:] * np.where(norm > 1e-12, angle / np.maximum(norm, 1e-12), 2.0)
