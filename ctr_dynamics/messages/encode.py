"""From the estimator's numbers to serialised messages: the one place where outputs get their ROS form.

Replay, the recorder and the node all use `StepEncoder`; rclpy publishes the bytes as they are. Beside it
stand the encoders of the input topics (for simulated bags and the driver) and of /diagnostics.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.messages import templates, topics
from ctr_dynamics.messages.cdr import ENCAPSULATION, CdrWriter

if TYPE_CHECKING:
    from ctr_dynamics.estimation.estimator import Innovation, StepOutput

OK, WARN, ERROR, STALE = 0, 1, 2, 3
_TRUE = ENCAPSULATION + b"\x01"
_FALSE = ENCAPSULATION + b"\x00"
_XYZW = [1, 2, 3, 0]


class Encoded(NamedTuple):
    """One message ready to be published or written: its topic, stamp and bytes."""

    topic: str
    stamp_ns: int
    data: bytes


class StatusLike(Protocol):
    """One line of health: level 0 ok, 1 warning, 2 error, 3 stale."""

    @property
    def name(self) -> str: ...
    @property
    def level(self) -> int: ...
    @property
    def message(self) -> str: ...
    @property
    def values(self) -> dict[str, str]: ...


class OutputStatus(NamedTuple):
    """Status of the outputs themselves: ERROR with the reason while they are invalid."""

    name: str
    level: int
    message: str
    values: dict[str, str]


def encode_diagnostics(stamp_ns: int, statuses: Iterable[StatusLike], hardware_id: str = "") -> bytes:
    """A diagnostic_msgs/DiagnosticArray; each name gets the prefix ``ctr_estimator: ``."""
    listed = list(statuses)
    writer = CdrWriter()
    writer.header(stamp_ns, "")
    writer.uint32(len(listed))
    for status in listed:
        writer.uint8(int(status.level))
        writer.string(f"ctr_estimator: {status.name}")
        writer.string(status.message)
        writer.string(hardware_id)
        writer.uint32(len(status.values))
        for key, value in status.values.items():
            writer.string(str(key))
            writer.string(str(value))
    return writer.done()


def encode_joint_state(
    stamp_ns: int, names: Sequence[str], positions: Sequence[float], velocities: Sequence[float] = ()
) -> bytes:
    """A sensor_msgs/JointState with an empty frame and no efforts."""
    writer = CdrWriter()
    writer.header(stamp_ns, "")
    writer.strings(names)
    writer.float64_sequence(positions)
    writer.float64_sequence(velocities)
    writer.float64_sequence(())
    return writer.done()


def encode_pose_stamped(
    stamp_ns: int, frame_id: str, position: Sequence[float], quaternion_xyzw: Sequence[float]
) -> bytes:
    """A geometry_msgs/PoseStamped: position (3,) in m, quaternion in ROS order x, y, z, w."""
    writer = CdrWriter()
    writer.header(stamp_ns, frame_id)
    writer.float64s([*position, *quaternion_xyzw])
    return writer.done()


def encode_wrench_stamped(
    stamp_ns: int, frame_id: str, force: Sequence[float], torque: Sequence[float]
) -> bytes:
    """A geometry_msgs/WrenchStamped: force (3,) in N, torque (3,) in N m."""
    writer = CdrWriter()
    writer.header(stamp_ns, frame_id)
    writer.float64s([*force, *torque])
    return writer.done()


def mode_names(count: int) -> list[str]:
    """Names in the modes message, see the topic table."""
    modes = [f"mode{number}" for number in range(1, count + 1)]
    return [*modes, *(f"{mode}.frequency_hz" for mode in modes), *(f"{mode}.damping_ratio" for mode in modes)]


def innovation_entries(innovation: Innovation) -> dict[str, float]:
    """Named numbers of the innovation message; what is not finite is left out."""
    entries: dict[str, float] = {}
    for label, vector in (("residual", innovation.residual), ("variance", innovation.variance)):
        entries.update({f"{label}.{axis}": float(x) for axis, x in zip(topics.AXES, vector, strict=True)})
    entries["nis"] = float(innovation.nis)
    entries["dof"] = float(innovation.dof)
    entries["accepted"] = float(innovation.accepted)
    entries["delay_s"] = float(innovation.delay_s)
    if not innovation.accepted:
        words = re.sub(r"[^a-z0-9]+", "_", innovation.reason.lower()).strip("_")
        entries[f"reason.{words or 'unknown'}"] = 1.0
    return {name: x for name, x in entries.items() if np.isfinite(x)}


class StepEncoder:
    """Turns each `StepOutput` into messages, and says when /diagnostics is due. One per stream of steps.

    Args:
        frame_id: frame of all outputs.
        hardware_id: name of the robot in /diagnostics.
        backbone_every: steps per display backbone.
    """

    def __init__(
        self,
        frame_id: str = "ctr_base",
        hardware_id: str = "",
        backbone_every: int = topics.BACKBONE_EVERY,
    ) -> None:
        self.frame_id = frame_id
        self.backbone_every = backbone_every
        self.hardware_id = hardware_id
        self._was: tuple[bool, bool] | None = None  # validity and alarm of the step before
        self._pose = templates.stamped_numbers(topics.TIP_POSE, frame_id, 43)
        self._twist = templates.stamped_numbers(topics.TIP_TWIST, frame_id, 42)
        self._predicted = templates.stamped_numbers(topics.TIP_POSE_PREDICTED, frame_id, 7)
        self._force = templates.stamped_numbers(topics.DISTURBANCE, frame_id, 6)
        self._sigma = templates.stamped_numbers(topics.DISTURBANCE_SIGMA, frame_id, 3)
        self._modes: dict[int, templates.Template] = {}
        self._clouds: dict[int, templates.Template] = {}
        self._paths: dict[int, templates.Template] = {}
        self._innovations: dict[tuple[str, ...], templates.Template] = {}

    def encode(
        self,
        out: StepOutput,
        statuses: Callable[[], Sequence[StatusLike]] | None = None,
        alarm: bool = False,
    ) -> list[Encoded]:
        """All messages of one step, `valid` last.

        Args:
            out: the step.
            statuses: asked for the health lines when /diagnostics is due (1 Hz and at changes of validity or alarm);
                None leaves /diagnostics to the caller.
            alarm: whether a warning stands that must not wait for its turn, such as of a snap.

        Raises:
            NotFiniteError: a valid step holds a NaN or an infinity.
        """
        stamp = out.stamp_ns
        messages = [self._innovation(item) for item in out.innovations]
        if out.valid:
            messages += self._outputs(out)
        now = bool(out.valid), alarm
        if statuses is not None and (out.k % topics.DIAGNOSTICS_EVERY == 0 or now != self._was):
            messages.append(Encoded(topics.DIAGNOSTICS, stamp, self.diagnostics(out, statuses())))
        self._was = now
        messages.append(Encoded(topics.VALID, stamp, _TRUE if out.valid else _FALSE))
        return messages

    def diagnostics(self, out: StepOutput, statuses: Sequence[StatusLike]) -> bytes:
        """The /diagnostics message of a step, led by the status of the outputs."""
        if out.valid:
            output = OutputStatus("output", OK, "valid", {})
        else:
            output = OutputStatus("output", ERROR, out.reason or "outputs are invalid", {})
        return encode_diagnostics(out.stamp_ns, [output, *statuses], self.hardware_id)

    def _outputs(self, out: StepOutput) -> list[Encoded]:
        stamp = out.stamp_ns
        points = len(out.backbone)
        backbone = np.asarray(out.backbone)
        force = np.zeros(6)
        force[:3] = out.disturbance_force
        messages = [
            Encoded(
                topics.TIP_POSE,
                stamp,
                self._pose.fill(
                    stamp, out.tip_position, out.tip_quaternion_wxyz[_XYZW], out.tip_covariance.reshape(36)
                ),
            ),
            Encoded(
                topics.TIP_TWIST,
                stamp,
                self._twist.fill(stamp, out.tip_velocity, out.tip_velocity_covariance.reshape(36)),
            ),
            Encoded(
                topics.TIP_POSE_PREDICTED,
                stamp,
                self._predicted.fill(stamp, out.predicted_position, out.predicted_quaternion_wxyz[_XYZW]),
            ),
            Encoded(topics.BACKBONE_STATE, stamp, self._cloud(points).fill(stamp, backbone)),
            Encoded(topics.DISTURBANCE, stamp, self._force.fill(stamp, force)),
            Encoded(topics.DISTURBANCE_SIGMA, stamp, self._sigma.fill(stamp, out.disturbance_sigma)),
        ]
        if len(out.modes.frequency_hz):
            messages.append(Encoded(topics.MODES, stamp, self._mode_message(out)))
        if out.k % self.backbone_every == 0:
            poses = backbone[:, 1:8].astype(float).reshape(-1)
            messages.append(Encoded(topics.BACKBONE, stamp, self._path(points).fill(stamp, poses)))
        return messages

    def _mode_message(self, out: StepOutput) -> bytes:
        modes = out.modes
        count = len(modes.frequency_hz)
        template = self._modes.get(count)
        if template is None:
            template = templates.joint_state(topics.MODES, self.frame_id, mode_names(count), velocities=True)
            self._modes[count] = template
        rates: NDArray = np.zeros(3 * count)
        rates[:count] = modes.rate
        return template.fill(out.stamp_ns, modes.amplitude, modes.frequency_hz, modes.damping, rates)

    def _cloud(self, points: int) -> templates.Template:
        if points not in self._clouds:
            self._clouds[points] = templates.PointCloudTemplate(
                topics.BACKBONE_STATE, self.frame_id, topics.BACKBONE_FIELDS, points
            )
        return self._clouds[points]

    def _path(self, points: int) -> templates.Template:
        if points not in self._paths:
            self._paths[points] = templates.path(topics.BACKBONE, self.frame_id, points)
        return self._paths[points]

    def _innovation(self, item: Innovation) -> Encoded:
        entries = innovation_entries(item)
        names = tuple(entries)
        template = self._innovations.get(names)
        if template is None:
            if len(self._innovations) > 64:  # reasons are few; a stream of new ones must not fill the memory
                self._innovations.clear()
            template = templates.joint_state(topics.INNOVATION, self.frame_id, names, velocities=False)
            self._innovations[names] = template
        values = np.fromiter(entries.values(), dtype=float, count=len(entries))
        return Encoded(topics.INNOVATION, item.stamp_ns, template.fill(item.stamp_ns, values))


def encode_step(out: StepOutput, frame_id: str = "ctr_base") -> list[Encoded]:
    """The messages of one step without /diagnostics. Streams of steps use one `StepEncoder` instead.

    Raises:
        NotFiniteError: a valid step holds a NaN or an infinity.
    """
    return StepEncoder(frame_id).encode(out)
