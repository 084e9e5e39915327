"""From the estimator's numbers to serialised messages: the one place where outputs get their ROS form.

Replay, the view and the node all use `StepEncoder`; rclpy publishes the bytes as they are.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence

import numpy as np

from ctr_dynamics.estimation.monitoring.statuses import output as output_status
from ctr_dynamics.estimation.step_output import Innovation, StepOutput
from ctr_dynamics.io.messages import templates, topics
from ctr_dynamics.io.messages.cdr import ENCAPSULATION
from ctr_dynamics.io.messages.encode import Encoded, StatusLike, encode_diagnostics
from ctr_dynamics.runtime.transform_encoder import TransformEncoder

_TRUE = ENCAPSULATION + b"\x01"
_FALSE = ENCAPSULATION + b"\x00"
_XYZW = [1, 2, 3, 0]
_INNOVATION = [f"{label}.{axis}" for label in ("residual", "variance") for axis in topics.AXES]
_INNOVATION += ["nis", "dof", "accepted", "delay_s"]
_NO_TORQUE = np.zeros(3)


def mode_names(count: int) -> list[str]:
    """Names in the modes message, see the topic table."""
    modes = [f"mode{number}" for number in range(1, count + 1)]
    return [*modes, *(f"{mode}.frequency_hz" for mode in modes), *(f"{mode}.damping_ratio" for mode in modes)]


def jacobian_names(columns: int) -> list[str]:
    """Names in the message of a Jacobian with that many columns, see the topic table."""
    tubes = range(1, (columns - 6) // 2 + 1)
    names = [f"tube{i}_{kind}" for kind in ("rotation", "translation") for i in tubes]
    names += [f"{kind}_{axis}" for kind in ("force", "torque") for axis in "xyz"]
    return [f"{row}.{column}" for row in topics.AXES for column in names]


def innovation_entries(innovation: Innovation) -> dict[str, float]:
    """Named numbers of the innovation message; what is not finite is left out."""
    i = innovation
    values = [*i.residual.tolist(), *i.variance.tolist(), i.nis, i.dof, i.accepted, i.delay_s]
    entries = {name: float(x) for name, x in zip(_INNOVATION, values, strict=True) if math.isfinite(x)}
    if not innovation.accepted:
        words = re.sub(r"[^a-z0-9]+", "_", innovation.reason.lower()).strip("_")
        entries[f"reason.{words or 'unknown'}"] = 1.0
    return entries


class StepEncoder:
    """Turns each `StepOutput` into messages, and says when /diagnostics is due. One per stream of steps.

    Args:
        frame_id: frame of all outputs.
        hardware_id: what /diagnostics are about, the robot's name.
        backbone_every: steps per display backbone, and per message of transforms.
        transforms: makes the latter; None for none.
    """

    def __init__(
        self,
        frame_id: str = "ctr_base",
        hardware_id: str = "",
        backbone_every: int = topics.BACKBONE_EVERY,
        transforms: TransformEncoder | None = None,
    ) -> None:
        self._transforms = transforms
        self.frame_id = frame_id
        self.backbone_every = backbone_every
        self.hardware_id = hardware_id
        self._was: tuple[bool, bool] | None = None  # validity and alarm of the step before
        # of a step: those that hold float64 numbers, filled together, by the numbers of modes and of the Jacobian's columns; points by their number
        self._numbers: dict[tuple[int, int], templates.Template] = {}
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
        """The /diagnostics message of a step, led by the status of its output; the estimator's own may be steps ahead of it."""
        own = output_status("" if out.valid else out.reason or "outputs are invalid", out.k + 1)
        others = [status for status in statuses if status.name != own.name]
        return encode_diagnostics(out.stamp_ns, [own, *others], self.hardware_id)

    def _outputs(self, out: StepOutput) -> list[Encoded]:
        stamp, modes = out.stamp_ns, out.modes
        count = len(modes.frequency_hz)
        backbone = np.asarray(out.backbone)
        points = len(backbone)
        template = self._template(count, out.jacobian.shape[1])
        filled = template.fill(
            stamp,
            out.tip_position, out.tip_quaternion_wxyz[_XYZW], out.tip_covariance,
            out.tip_velocity, out.tip_velocity_covariance,
            out.predicted_position, out.predicted_quaternion_wxyz[_XYZW],
            out.disturbance_force, _NO_TORQUE, out.disturbance_sigma,
            modes.amplitude, modes.frequency_hz, modes.damping, modes.rate, np.zeros(2 * count), modes.direction.T.ravel(),
            out.jacobian,
        )  # fmt: skip
        messages = [Encoded(topic, stamp, data) for topic, data in zip(template.topics, filled, strict=True)]
        messages.append(Encoded(topics.BACKBONE_STATE, stamp, *self._cloud(points).fill(stamp, backbone)))
        if out.k % self.backbone_every == 0:
            messages.append(
                Encoded(
                    topics.BACKBONE, stamp, *self._path(points).fill(stamp, backbone[:, 1:8].astype(float))
                )
            )
            if self._transforms is not None:
                messages.append(self._transforms.encode(out))
        return messages

    def _template(self, count: int, columns: int) -> templates.Template:
        """Of the messages of numbers with ``count`` modes and a Jacobian of ``columns`` columns."""
        key = count, columns
        if key not in self._numbers:
            frame = self.frame_id
            layouts = [
                templates.stamped_numbers(topics.TIP_POSE, frame, 43),
                templates.stamped_numbers(topics.TIP_TWIST, frame, 42),
                templates.stamped_numbers(topics.TIP_POSE_PREDICTED, frame, 7),
                templates.stamped_numbers(topics.DISTURBANCE, frame, 6),
                templates.stamped_numbers(topics.DISTURBANCE_SIGMA, frame, 3),
            ]
            if count:
                layouts.append(
                    templates.joint_state(
                        topics.MODES, frame, mode_names(count), velocities=True, efforts=True
                    )
                )
            if columns:
                layouts.append(
                    templates.joint_state(
                        topics.TIP_JACOBIAN, frame, jacobian_names(columns), velocities=False
                    )
                )
            self._numbers[key] = templates.Template(*layouts)
        return self._numbers[key]

    def _cloud(self, points: int) -> templates.Template:
        if points not in self._clouds:
            self._clouds[points] = templates.PointCloudTemplate(
                topics.BACKBONE_STATE, self.frame_id, topics.BACKBONE_FIELDS, points
            )
        return self._clouds[points]

    def _path(self, points: int) -> templates.Template:
        if points not in self._paths:
            self._paths[points] = templates.Template(templates.path(topics.BACKBONE, self.frame_id, points))
        return self._paths[points]

    def _innovation(self, item: Innovation) -> Encoded:
        entries = innovation_entries(item)
        names = tuple(entries)
        template = self._innovations.get(names)
        if template is None:
            if len(self._innovations) > 64:  # reasons are few; a stream of new ones must not fill the memory
                self._innovations.clear()
            layout = templates.joint_state(topics.INNOVATION, self.frame_id, names, velocities=False)
            template = self._innovations[names] = templates.Template(layout)
        values = np.fromiter(entries.values(), dtype=float, count=len(entries))
        return Encoded(topics.INNOVATION, item.stamp_ns, *template.fill(item.stamp_ns, values))
