"""The table of topics: what the estimator subscribes to and publishes, with types, rates and the meaning of every
field.

The node, replay, the recorder and the pages in ``msg_docs/`` all follow this table. SI units and radians;
poses and vectors in the base frame ``ctr_base`` (origin at the hole of the base plate, +z along the robot at
the base, +y against gravity). The tip is the end of tube 1, the innermost, and its frame is that of tube 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

STEP_NS = 3_000_000  # model step and output grid
BACKBONE_EVERY = 11  # steps between two messages of the display topic (30 Hz)
DIAGNOSTICS_EVERY = 333  # steps between two /diagnostics messages without news (1 Hz)
JOINT_RATE_HZ = 50.0  # at which joint states should come at least

JOINT_STATES = "/ctr/joint_states"
TRACKER_TIP = "/ctr/tracker/tip"
TIP_LOAD = "/ctr/tip_load"
TIP_POSE = "/ctr/estimator/tip_pose"
TIP_TWIST = "/ctr/estimator/tip_twist"
TIP_POSE_PREDICTED = "/ctr/estimator/tip_pose_predicted"
BACKBONE = "/ctr/estimator/backbone"
BACKBONE_STATE = "/ctr/estimator/backbone_state"
MODES = "/ctr/estimator/modes"
TIP_JACOBIAN = "/ctr/estimator/tip_jacobian"
INNOVATION = "/ctr/estimator/innovation"
DISTURBANCE = "/ctr/estimator/disturbance"
DISTURBANCE_SIGMA = "/ctr/estimator/disturbance_sigma"
VALID = "/ctr/estimator/valid"
DIAGNOSTICS = "/diagnostics"
TF = "/tf"
TF_STATIC = "/tf_static"
TRANSFORMS = (TF, TF_STATIC)  # what poses in other frames are brought into the tracker's by

BACKBONE_FIELDS = ("s", "x", "y", "z", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "ux", "uy", "uz", "sd")
AXES = ("x", "y", "z", "rx", "ry", "rz")  # order of every six-vector and covariance

PER_STEP = "every model step (3 ms, 333.3 Hz)"
ONCE_COMPUTED = f"{PER_STEP}, once computed in idle time after a start"


@dataclass(frozen=True)
class Field:
    """Meaning of one field; `path` also covers everything below it (``pose.position`` covers x, y and z)."""

    path: str
    text: str
    unit: str = "-"


@dataclass(frozen=True)
class Qos:
    """Quality of service that a topic is opened with, unless parameters say otherwise."""

    reliability: Literal["best_effort", "reliable"]
    depth: int
    history: str = "keep last"
    durability: Literal["volatile", "transient_local"] = "volatile"


INPUT_QOS = Qos("best_effort", 50)
OUTPUT_QOS = Qos("reliable", 10)


@dataclass(frozen=True)
class Topic:
    """One topic: name, ROS type, direction seen from the estimator, QoS, rate, meaning and fields."""

    name: str
    ros_type: str
    direction: Literal["in", "out"]
    qos: Qos
    rate: str
    meaning: str
    fields: tuple[Field, ...]
    notes: tuple[str, ...] = ()

    @property
    def has_header(self) -> bool:
        """Whether the message begins with a std_msgs/Header."""
        return any(field.path == "header.stamp" for field in self.fields)

    @property
    def page(self) -> str:
        """File name of the topic's page in msg_docs/."""
        return self.name.strip("/").replace("/", "_") + ".md"


_STAMP = Field(
    "header.stamp", "model time t_k = stamp of the first complete joint state + k * 3,000,000 ns", "s, ns"
)
_FRAME = Field("header.frame_id", "`ctr_base` (parameter `output.frame_id`)")
_BASE = "`ctr_base` (parameter `output.frame_id`) or empty"
_POSITION = "position of the tip in the base frame"
_ORIENTATION = "orientation of the tip frame in the base frame, unit quaternion in ROS order x, y, z, w"
_NOT_INVALID = "Not published for a step whose `/ctr/estimator/valid` is false."
_TOO_OLD = "Where a step exceeds `output.max_age_s` while its messages go out, `false` follows those that are out already."

TOPICS: tuple[Topic, ...] = (
    Topic(
        JOINT_STATES,
        "sensor_msgs/msg/JointState",
        "in",
        INPUT_QOS,
        f"{JOINT_RATE_HZ:g} Hz or more (100 Hz in the shipped bags)",
        "Rotation and translation of the actuators of all tubes.",
        (
            Field("header.stamp", "time at which the encoders were read", "s, ns"),
            Field("header.frame_id", "not used"),
            Field(
                "name",
                "`tubeN_rotation` and `tubeN_translation` for every tube N = 1.. (1 innermost), any order",
            ),
            Field(
                "position",
                "`tubeN_rotation`: actuator angle alpha_N in rad; `tubeN_translation`: beta_N in m, the "
                "position of the tube's base, zero or negative (behind the base plate)",
                "rad, m",
            ),
            Field("velocity", "not used; may be empty"),
            Field("effort", "not used; may be empty"),
        ),
        (
            "Joints are matched by name, not by index. Other names in the message are ignored. A message without the rotation or "
            "translation of a tube is rejected and counted in `/diagnostics`.",
            "Values are interpolated linearly between two stamps.",
        ),
    ),
    Topic(
        TRACKER_TIP,
        "geometry_msgs/msg/PoseStamped",
        "in",
        INPUT_QOS,
        "the tracker's (40 Hz in the shipped bags)",
        "Measured pose of the tip sensor.",
        (
            Field(
                "header.stamp",
                "acquisition time (parameter `tracker.delay_s` corrects a known delay)",
                "s, ns",
            ),
            Field("header.frame_id", f"{_BASE}; a pose in another frame is rejected"),
            Field("pose.position", "position of the sensor", "m"),
            Field("pose.orientation", "orientation of the sensor, unit quaternion in ROS order x, y, z, w"),
        ),
        (
            "A pose that is late or out of order is fused at its own stamp while it is at most `filter.window_s` (0.2 s) old.",
            "A pose with numbers that are not finite, or with a quaternion whose norm is far from one, is rejected and counted in "
            "`/diagnostics`.",
        ),
    ),
    Topic(
        TIP_LOAD,
        "geometry_msgs/msg/WrenchStamped",
        "in",
        INPUT_QOS,
        "any; optional",
        "Known wrench on the tip (a hung weight, a force sensor). Without this topic the known load is zero.",
        (
            Field("header.stamp", "time of the value; linear between stamps, held after the last", "s, ns"),
            Field("header.frame_id", f"{_BASE}; a wrench in another frame is rejected"),
            Field("wrench.force", "force on the tip, base axes", "N"),
            Field("wrench.torque", "torque about the tip point, base axes", "N m"),
        ),
        (
            "The first value also holds before its stamp, if it comes within 0.1 s of the first joint state. Otherwise the load "
            "before the first stamp is zero.",
        ),
    ),
    Topic(
        TIP_POSE,
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "out",
        OUTPUT_QOS,
        PER_STEP,
        "Fused tip pose.",
        (
            _STAMP,
            _FRAME,
            Field("pose.pose.position", _POSITION, "m"),
            Field("pose.pose.orientation", _ORIENTATION),
            Field(
                "pose.covariance",
                "6 x 6 row by row, order x, y, z, rx, ry, rz; rotations about the base axes",
                "m^2, m rad, rad^2",
            ),
        ),
        (_NOT_INVALID,),
    ),
    Topic(
        TIP_TWIST,
        "geometry_msgs/msg/TwistWithCovarianceStamped",
        "out",
        OUTPUT_QOS,
        PER_STEP,
        "Fused tip velocity.",
        (
            _STAMP,
            _FRAME,
            Field(
                "twist.twist.linear", "rate of change of the tip point, insertion included, base axes", "m/s"
            ),
            Field("twist.twist.angular", "angular velocity of the tip frame, base axes", "rad/s"),
            Field(
                "twist.covariance",
                "6 x 6 row by row, order x, y, z, rx, ry, rz, base axes",
                "m^2/s^2, m rad/s^2, rad^2/s^2",
            ),
        ),
        (
            "Both parts are in base axes, unlike the common convention of a twist in the moving frame.",
            _NOT_INVALID,
        ),
    ),
    Topic(
        TIP_POSE_PREDICTED,
        "geometry_msgs/msg/PoseStamped",
        "out",
        OUTPUT_QOS,
        PER_STEP,
        "Tip pose of the open-loop model: a second run that the tracker never corrects.",
        (
            _STAMP,
            _FRAME,
            Field("pose.position", _POSITION, "m"),
            Field("pose.orientation", _ORIENTATION),
        ),
        (
            "It is not the prior of the filter. Its distance from the tracker is the error of the simulation.",
            _NOT_INVALID,
        ),
    ),
    Topic(
        BACKBONE,
        "nav_msgs/msg/Path",
        "out",
        OUTPUT_QOS,
        "every 11th step (30.3 Hz)",
        "Fused backbone for display (RViz, Foxglove).",
        (
            _STAMP,
            _FRAME,
            Field("poses[].header.stamp", "the same stamp", "s, ns"),
            Field("poses[].header.frame_id", "the same frame"),
            Field("poses[].pose.position", "point of the backbone, from the base to the tip", "m"),
            Field("poses[].pose.orientation", "orientation of tube 1's frame there, x, y, z, w"),
        ),
        (_NOT_INVALID, "Controllers use `/ctr/estimator/backbone_state`, which holds more and costs less."),
    ),
    Topic(
        BACKBONE_STATE,
        "sensor_msgs/msg/PointCloud2",
        "out",
        OUTPUT_QOS,
        PER_STEP,
        "Fused backbone with velocity, curvature and standard deviation, from base to tip.",
        (
            _STAMP,
            _FRAME,
            Field("height", "1"),
            Field("width", "number of points"),
            Field(
                "fields",
                "15 fields of type FLOAT32 (7), count 1, offsets 0, 4, ... 56, named as in the notes",
            ),
            Field("is_bigendian", "false"),
            Field("point_step", "60", "byte"),
            Field("row_step", "60 times width", "byte"),
            Field("data", "the points, one after the other"),
            Field("is_dense", "true: every number is finite"),
        ),
        (
            "`s` is the arc length from the base plate (m).",
            "`x`, `y`, `z` are the position (m), and `qx`, `qy`, `qz`, `qw` the orientation of tube 1's frame.",
            "`vx`, `vy`, `vz` are the velocity in base axes (m/s).",
            "`ux`, `uy`, `uz` are curvature and twist of tube 1 in its own frame (1/m).",
            "`sd` is the standard deviation of the position, the root of the trace of its covariance (m).",
            "Read it with `numpy.frombuffer(msg.data, numpy.float32).reshape(msg.width, 15)`.",
            _NOT_INVALID,
        ),
    ),
    Topic(
        MODES,
        "sensor_msgs/msg/JointState",
        "out",
        OUTPUT_QOS,
        ONCE_COMPUTED,
        "The slowest vibration modes, for a controller that damps vibration.",
        (
            _STAMP,
            _FRAME,
            Field(
                "name",
                "`mode1`..`modeM`, then `mode1.frequency_hz`.., then `mode1.damping_ratio`.. (3 M names)",
            ),
            Field(
                "position",
                "first M: amplitude of the mode, its present contribution to the tip's displacement along the mode's direction, from the "
                "equilibrium at the present actuators and load; next M: frequency; last M: damping ratio (1 = critical)",
                "m, Hz, -",
            ),
            Field("velocity", "first M: time derivative of the amplitude; the other 2 M are zero", "m/s"),
            Field(
                "effort",
                "no effort: the direction of each mode at the tip, a unit vector in base axes; first M: x, next M: y, last M: z",
                "-",
            ),
        ),
        (
            "The first modes are ordered by frequency, the slowest first. From then on a mode keeps its number and its sign while the robot "
            "moves. With M = len(name) / 3 the controller's "
            "state is `position[:M]` and `velocity[:M]`.",
            "Not published before the first modes have been computed.",
            _NOT_INVALID,
        ),
    ),
    Topic(
        TIP_JACOBIAN,
        "sensor_msgs/msg/JointState",
        "out",
        OUTPUT_QOS,
        ONCE_COMPUTED,
        "Static Jacobian of the tip against actuators, and its compliance, for a controller.",
        (
            _STAMP,
            _FRAME,
            Field(
                "name",
                "`ROW.COLUMN`, row by row. Rows: `x`, `y`, `z`, `rx`, `ry`, `rz` of the tip. Columns: `tube1_rotation`.., "
                "`tube1_translation`.., then `force_x`.. and `torque_x`.. on the tip; 6 (2 N + 6) names for N tubes",
            ),
            Field(
                "position",
                "derivative of the row by the column: position in m and rotation in rad about the base axes, by rad, m, N and N m in base axes",
                "m/rad, m/m, m/N, ...",
            ),
            Field("velocity", "empty"),
            Field("effort", "empty"),
        ),
        (
            "Read it with `numpy.reshape(msg.position, (6, -1))`: the first 2 N columns are the Jacobian at constant load, the last 6 the compliance "
            "with the actuators held.",
            "It belongs to the equilibrium of the fused model at the actuators and load of the stamp. It is computed every 0.1 s, and turns with "
            "the mean of the tubes between two computations.",
            "Not published before the first one has been computed.",
            _NOT_INVALID,
        ),
    ),
    Topic(
        INNOVATION,
        "sensor_msgs/msg/JointState",
        "out",
        OUTPUT_QOS,
        "once for every tracker pose, fused or rejected",
        "Result of one tracker measurement: innovation, variance, NIS, degrees of freedom, acceptance and delay.",
        (
            Field("header.stamp", "stamp of the tracker pose", "s, ns"),
            _FRAME,
            Field("name", "names of the numbers, see the notes"),
            Field("position", "the numbers", "see the notes"),
            Field("velocity", "empty"),
            Field("effort", "empty"),
        ),
        (
            "Find a number by its name, not by its index.",
            "`residual.x`, `.y`, `.z`: measured minus expected position (m).",
            "`residual.rx`, `.ry`, `.rz`: rotation from the expected to the measured orientation, about the base axes (rad).",
            "`variance.x` to `variance.rz`: variances of the residuals (m^2, rad^2).",
            "`nis`: normalised innovation squared. `dof`: its degrees of freedom.",
            "`accepted`: 1 if the pose was fused, else 0. `reason.WORDS`, with value 1, says why it was not.",
            "`delay_s`: time from the stamp of the pose to its use (s).",
            "A number that does not exist is left out, for example of an axis that is not measured. No NaN is published.",
        ),
    ),
    Topic(
        DISTURBANCE,
        "geometry_msgs/msg/WrenchStamped",
        "out",
        OUTPUT_QOS,
        PER_STEP,
        "Estimated unknown force on the tip, in addition to the known load of `/ctr/tip_load`.",
        (
            _STAMP,
            _FRAME,
            Field(
                "wrench.force",
                "estimated force, base axes; its standard deviation is in `/ctr/estimator/disturbance_sigma`",
                "N",
            ),
            Field("wrench.torque", "zero: the unknown load is modelled as a force at the tip point", "N m"),
        ),
        (_NOT_INVALID,),
    ),
    Topic(
        DISTURBANCE_SIGMA,
        "geometry_msgs/msg/Vector3Stamped",
        "out",
        OUTPUT_QOS,
        PER_STEP,
        "Standard deviation of the force in `/ctr/estimator/disturbance`.",
        (
            _STAMP,
            _FRAME,
            Field("vector", "standard deviation (1 sigma) of the estimated force, per base axis", "N"),
        ),
        (_NOT_INVALID,),
    ),
    Topic(
        VALID,
        "std_msgs/msg/Bool",
        "out",
        OUTPUT_QOS,
        PER_STEP,
        "Whether the outputs of this step can be used.",
        (
            Field(
                "data",
                "true: the step's outputs are published; false: they are not, or not all of them; `/diagnostics` says why",
            ),
        ),
        ("It has no header. It is published after the other topics of its step.", _TOO_OLD),
    ),
    Topic(
        DIAGNOSTICS,
        "diagnostic_msgs/msg/DiagnosticArray",
        "out",
        OUTPUT_QOS,
        "2 Hz in the node, 1 Hz in a replay, and at once when validity or the snap warning changes",
        "Health of solver, timing, tracker, joints, consistency of the filter and elastic stability.",
        (
            Field("header.stamp", "model time of the step it belongs to", "s, ns"),
            Field("header.frame_id", "empty"),
            Field("status[].level", "0 ok, 1 warning, 2 error, 3 stale"),
            Field("status[].name", "`ctr_estimator: ` and the subject"),
            Field("status[].message", "the problem, with value, limit and unit"),
            Field(
                "status[].hardware_id",
                "name of the robot; behind it in parentheses the node's name with its namespace where it is not `/ctr/estimator`",
            ),
            Field("status[].values[].key", "name of a number, with its unit"),
            Field("status[].values[].value", "the number as text"),
        ),
        (
            "`ctr_estimator: output` is ERROR with the reason while `/ctr/estimator/valid` is false.",
            "`ctr_estimator: misfit` is WARN while mean NIS, CUSUM of the NIS or autocorrelation of the innovations exceeded their limits "
            "(parameters `misfit.*`) within the last window.",
            "It lists the two or three most likely causes by their effect IDs (`ctr_dynamics.effects`), or reports that none of them fits.",
            "With `record.rolling_s` it names the recording of the last seconds and the `ctr-dynamics diagnose` command for it.",
            "In a replay no value depends on the wall clock.",
        ),
    ),
)

_TF_TYPE = "tf2_msgs/msg/TFMessage"
_TF_FIELDS = (
    Field("transforms[].header.stamp", "time of the transform", "s, ns"),
    Field("transforms[].header.frame_id", "parent frame"),
    Field("transforms[].child_frame_id", "frame"),
    Field("transforms[].transform.translation", "its origin in the parent frame", "m"),
    Field("transforms[].transform.rotation", "its orientation there, unit quaternion x, y, z, w"),
)
# They belong to everybody: the nodes open them where `tf2_msgs` is installed, as it is with every ROS 2.
TRANSFORM_TOPICS: tuple[Topic, ...] = (
    Topic(
        TF,
        _TF_TYPE,
        "in",
        Qos("best_effort", 100),
        "any in; every 11th step out, with `output.publish_tf`",
        "Frames that move: in for poses in other frames than the tracker's, out the ends of the tubes.",
        _TF_FIELDS,
        (
            "Out, stamps are those of the steps. `ctr_tubeN_tip` is the end of tube N in `ctr_base`, with the orientation of tube 1's frame there. "
            "Another `output.frame_id` changes the names: `left_base` makes `left_tube1_tip`.",
            "With `tracker.frame_id` the registration is published too, as `ctr_base` in that frame.",
            _NOT_INVALID,
        ),
    ),
    Topic(
        TF_STATIC,
        _TF_TYPE,
        "in",
        Qos("reliable", 100, durability="transient_local"),
        "once for each frame",
        "Frames that do not move, for poses in other frames than the tracker's.",
        _TF_FIELDS,
    ),
)

TOPIC: dict[str, Topic] = {topic.name: topic for topic in (*TOPICS, *TRANSFORM_TOPICS)}
INPUTS: tuple[Topic, ...] = tuple(topic for topic in TOPICS if topic.direction == "in")
OUTPUTS: tuple[Topic, ...] = tuple(topic for topic in TOPICS if topic.direction == "out")


def accepts_frame(frame_id: str, frame: str) -> bool:
    """Whether a message that names ``frame_id`` may be taken for one in ``frame``: that one, with a slash before it or not, or none."""
    return not frame_id or frame_id.lstrip("/") == frame
