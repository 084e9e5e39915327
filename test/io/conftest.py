"""Steps and messages that the tests of messages, bags and replay share, as fixtures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.schemas import typestore
from ctr_dynamics.runtime.step_encoder import innovation_entries, jacobian_names, mode_names

T0_NS = 1_700_000_000_000_000_000
BAGS = Path(__file__).parents[1] / "data" / "bags"


def unit_quaternion(rng: np.random.Generator) -> np.ndarray:
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def make_innovation(rng: np.random.Generator, stamp_ns: int, **changes: Any) -> SimpleNamespace:
    item = SimpleNamespace(
        stamp_ns=stamp_ns,
        residual=rng.normal(size=6) * 1e-3,
        variance=rng.uniform(1e-8, 1e-6, 6),
        nis=float(rng.chisquare(6)),
        dof=6,
        accepted=True,
        delay_s=0.004,
        reason="",
    )
    vars(item).update(changes)
    return item


def make_step(
    k: int = 11, points: int = 37, modes: int = 3, seed: int = 0, **changes: Any
) -> SimpleNamespace:
    """A step with the fields of StepOutput and random content."""
    rng = np.random.default_rng(seed + k)
    stamp_ns = T0_NS + k * topics.STEP_NS
    out = SimpleNamespace(
        stamp_ns=stamp_ns,
        k=k,
        valid=True,
        reason="",
        tip_position=rng.normal(size=3) * 0.1,
        tip_quaternion_wxyz=unit_quaternion(rng),
        tip_covariance=rng.normal(size=(6, 6)),
        tip_velocity=rng.normal(size=6),
        tip_velocity_covariance=rng.normal(size=(6, 6)),
        predicted_position=rng.normal(size=3) * 0.1,
        predicted_quaternion_wxyz=unit_quaternion(rng),
        backbone=rng.normal(size=(points, 15)).astype(np.float32),
        modes=SimpleNamespace(
            frequency_hz=rng.uniform(1, 30, modes),
            damping=rng.uniform(0, 0.1, modes),
            amplitude=rng.normal(size=modes) * 1e-3,
            rate=rng.normal(size=modes) * 1e-2,
            direction=rng.normal(size=(modes, 3)),
        ),
        disturbance_force=rng.normal(size=3) * 0.05,
        disturbance_sigma=rng.uniform(0.01, 0.1, 3),
        innovations=[make_innovation(rng, stamp_ns - 1_000_000)],
        solver=SimpleNamespace(iterations=5, sweeps=9, outcome="ok"),
        jacobian=rng.normal(size=(6, 10)),
    )
    vars(out).update(changes)
    return out


class Reference:
    """The same messages built field by field with the message classes of rosbags."""

    def __init__(self, frame_id: str = "ctr_base") -> None:
        self.frame_id = frame_id
        self.types = typestore().types

    def make(self, ros_type: str, /, *args: Any, **kwargs: Any) -> Any:
        return self.types[ros_type](*args, **kwargs)

    def header(self, stamp_ns: int, frame_id: str | None = None) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", stamp_ns // 10**9, stamp_ns % 10**9)
        return self.make("std_msgs/msg/Header", stamp, self.frame_id if frame_id is None else frame_id)

    def vector(self, v: Any) -> Any:
        return self.make("geometry_msgs/msg/Vector3", *map(float, v))

    def pose(self, position: Any, wxyz: Any) -> Any:
        w, x, y, z = map(float, wxyz)
        return self.make(
            "geometry_msgs/msg/Pose",
            self.make("geometry_msgs/msg/Point", *map(float, position)),
            self.make("geometry_msgs/msg/Quaternion", x, y, z, w),
        )

    def pose_stamped(self, stamp_ns: int, position: Any, wxyz: Any) -> Any:
        return self.make("geometry_msgs/msg/PoseStamped", self.header(stamp_ns), self.pose(position, wxyz))

    def joint_state(
        self,
        stamp_ns: int,
        names: Any,
        positions: Any,
        velocities: Any = (),
        frame_id: str | None = None,
        efforts: Any = (),
    ) -> Any:
        return self.make(
            "sensor_msgs/msg/JointState",
            self.header(stamp_ns, frame_id),
            list(names),
            np.array(positions, dtype=float),
            np.array(velocities, dtype=float),
            np.array(efforts, dtype=float),
        )

    def wrench_stamped(self, stamp_ns: int, force: Any, torque: Any) -> Any:
        wrench = self.make("geometry_msgs/msg/Wrench", self.vector(force), self.vector(torque))
        return self.make("geometry_msgs/msg/WrenchStamped", self.header(stamp_ns), wrench)

    def diagnostics(self, stamp_ns: int, statuses: Any, hardware_id: str = "") -> Any:
        listed = [
            self.make(
                "diagnostic_msgs/msg/DiagnosticStatus",
                level=s.level,
                name="ctr_estimator: " + s.name,
                message=s.message,
                hardware_id=hardware_id,
                values=[self.make("diagnostic_msgs/msg/KeyValue", k, v) for k, v in s.values.items()],
            )
            for s in statuses
        ]
        return self.make("diagnostic_msgs/msg/DiagnosticArray", self.header(stamp_ns, ""), listed)

    def step(self, out: Any) -> dict[str, Any]:
        """Message per topic of a valid step (the last innovation only)."""
        t = out.stamp_ns
        cloud_fields = [
            self.make("sensor_msgs/msg/PointField", name, 4 * i, 7, 1)
            for i, name in enumerate(topics.BACKBONE_FIELDS)
        ]
        points = len(out.backbone)
        count = len(out.modes.frequency_hz)
        innovation = out.innovations[-1]
        entries = innovation_entries(innovation)
        covariance_of = {
            "pose": self.make(
                "geometry_msgs/msg/PoseWithCovariance",
                self.pose(out.tip_position, out.tip_quaternion_wxyz),
                out.tip_covariance.reshape(36),
            ),
            "twist": self.make(
                "geometry_msgs/msg/TwistWithCovariance",
                self.make(
                    "geometry_msgs/msg/Twist",
                    self.vector(out.tip_velocity[:3]),
                    self.vector(out.tip_velocity[3:]),
                ),
                out.tip_velocity_covariance.reshape(36),
            ),
        }
        return {
            topics.TIP_POSE: self.make(
                "geometry_msgs/msg/PoseWithCovarianceStamped", self.header(t), covariance_of["pose"]
            ),
            topics.TIP_TWIST: self.make(
                "geometry_msgs/msg/TwistWithCovarianceStamped", self.header(t), covariance_of["twist"]
            ),
            topics.TIP_POSE_PREDICTED: self.pose_stamped(
                t, out.predicted_position, out.predicted_quaternion_wxyz
            ),
            topics.BACKBONE: self.make(
                "nav_msgs/msg/Path",
                self.header(t),
                [self.pose_stamped(t, row[1:4], row[[7, 4, 5, 6]]) for row in out.backbone],
            ),
            topics.BACKBONE_STATE: self.make(
                "sensor_msgs/msg/PointCloud2",
                header=self.header(t),
                height=1,
                width=points,
                fields=cloud_fields,
                is_bigendian=False,
                point_step=60,
                row_step=60 * points,
                data=np.frombuffer(out.backbone.tobytes(), dtype=np.uint8),
                is_dense=True,
            ),
            topics.MODES: self.joint_state(
                t,
                mode_names(count),
                [*out.modes.amplitude, *out.modes.frequency_hz, *out.modes.damping],
                [*out.modes.rate, *[0.0] * (2 * count)],
                efforts=out.modes.direction.T.ravel(),
            ),
            topics.TIP_JACOBIAN: self.joint_state(
                t, jacobian_names(out.jacobian.shape[1]), out.jacobian.ravel()
            ),
            topics.INNOVATION: self.joint_state(innovation.stamp_ns, entries, list(entries.values())),
            topics.DISTURBANCE: self.wrench_stamped(t, out.disturbance_force, (0, 0, 0)),
            topics.DISTURBANCE_SIGMA: self.make(
                "geometry_msgs/msg/Vector3Stamped", self.header(t), self.vector(out.disturbance_sigma)
            ),
            topics.VALID: self.make("std_msgs/msg/Bool", bool(out.valid)),
        }


@pytest.fixture
def step() -> Callable[..., SimpleNamespace]:
    return make_step


@pytest.fixture
def innovation() -> Callable[..., SimpleNamespace]:
    return make_innovation


@pytest.fixture
def reference() -> Reference:
    return Reference()


@pytest.fixture(scope="session")
def bags() -> Path:
    """Folder of the bags that come with the tests."""
    return BAGS
