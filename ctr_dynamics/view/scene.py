"""Puts the newest backbone, joints and covariance together to one picture, at most so many times a second."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.io.messages import cdr, topics
from ctr_dynamics.robot import Robot
from ctr_dynamics.view.markers import encode_tubes

Floats = NDArray[np.float64]


class Scene:
    """Takes serialised messages and gives serialised markers.

    Args:
        robot: its tubes are drawn.
        rate_hz: pictures in a second, at most.
        diameter_scale, ellipsoid_scale: magnifications.
    """

    def __init__(
        self, robot: Robot, rate_hz: float = 30.0, diameter_scale: float = 1.0, ellipsoid_scale: float = 10.0
    ) -> None:
        self.robot = robot
        self.diameter_scale, self.ellipsoid_scale = diameter_scale, ellipsoid_scale
        self._period_ns = round(1e9 / rate_hz)
        self._last_ns: int | None = None
        self._beta = list(robot.rest.beta.value)
        self._tip: tuple[int, tuple[Floats, Floats]] | None = None

    def take(self, topic: str, data: bytes) -> tuple[int, bytes] | None:
        """Stamp (ns) and MarkerArray when this message completes a picture that is due; messages that cannot be read are passed over."""
        try:
            if topic == topics.JOINT_STATES:
                self._joints(cdr.decode_joint_state(data))
            elif topic == topics.TIP_POSE:
                stamp_ns, _, numbers = cdr.decode_numbers(data, 43)
                covariance = np.array(numbers[7:]).reshape(6, 6)[:3, :3]
                if np.isfinite(numbers).all():
                    self._tip = (stamp_ns, (np.array(numbers[:3]), covariance))
            elif topic == topics.BACKBONE_STATE:
                return self._backbone(data)
        except cdr.CdrError:
            pass
        return None

    def _joints(self, message: cdr.JointStateIn) -> None:
        at = dict(zip(message.names, message.positions, strict=False))
        beta = [at.get(f"tube{i}_translation", np.nan) for i in range(1, self.robot.n_tubes + 1)]
        if np.isfinite(beta).all():
            self._beta = beta

    def _backbone(self, data: bytes) -> tuple[int, bytes] | None:
        stamp_ns = cdr.decode_stamp(data)
        if self._last_ns is not None and 0 <= stamp_ns - self._last_ns < self._period_ns:
            return None
        cloud = cdr.decode_point_cloud(data)
        if cloud.names != topics.BACKBONE_FIELDS or len(cloud.rows) < 2 or not np.isfinite(cloud.rows).all():
            return None
        self._last_ns = stamp_ns
        tip = self._tip[1] if self._tip is not None and self._tip[0] == stamp_ns else None
        picture = encode_tubes(
            self.robot,
            stamp_ns,
            cloud.frame_id,
            cloud.rows,
            self._beta,
            tip,
            self.diameter_scale,
            self.ellipsoid_scale,
        )
        return stamp_ns, picture
