"""The one table of parameters: it drives declaration, replay's --set, checks, documentation and YAML."""

from __future__ import annotations

import math
from difflib import get_close_matches

from ctr_dynamics.errors import InputError
from ctr_dynamics.parameters.parameter_types import Parameter, axes_mask

SCHEMES = ("backward_euler", "bdf2", "trapezoid", "bdf_alpha", "sdirk2", "sdirk3", "radau")
RELIABILITY = ("best_effort", "reliable")
ZEROS = (0.0, 0.0, 0.0)

PARAMETERS: tuple[Parameter, ...] = (
    Parameter(
        "robot",
        "str",
        "till2020_tissue",
        "",
        "Name of a shipped robot, or path of a robot file.",
        read_only=True,
    ),
    Parameter(
        "input_timeout_s",
        "float",
        0.1,
        "s",
        "Longest time to wait for joint states, or to extrapolate them.",
        0.003,
        10.0,
    ),
    Parameter(
        "joints.rotation_names",
        "texts",
        (),
        "",
        "Joint names of the rotations, innermost tube first, or their places in a message without names. "
        "Empty: `tubeN_rotation`, also with a prefix or counted from 0.",
    ),
    Parameter(
        "joints.translation_names",
        "texts",
        (),
        "",
        "Joint names of the translations, likewise. Empty: `tubeN_translation`.",
    ),
    Parameter(
        "joints.rotation_scale",
        "floats",
        (1.0,),
        "",
        "Factor from a rotation reading to alpha in rad (0.0174533 for degrees): one number, one a tube, or the rows of a matrix.",
        -1e6,
        1e6,
        nonzero=True,
    ),
    Parameter(
        "joints.rotation_offset_rad",
        "floats",
        (0.0,),
        "rad",
        "Added to a scaled rotation reading: alpha = scale * reading + offset. One number, or one a tube.",
        -1e4,
        1e4,
    ),
    Parameter(
        "joints.translation_scale",
        "floats",
        (1.0,),
        "",
        "Factor from a translation reading to beta in m (0.001 for mm, negative where a lab counts inwards): likewise.",
        -1e6,
        1e6,
        nonzero=True,
    ),
    Parameter(
        "joints.translation_offset_m",
        "floats",
        (0.0,),
        "m",
        "Added to a scaled translation reading: beta = scale * reading + offset. One number, or one a tube.",
        -10.0,
        10.0,
    ),
    Parameter(
        "joints.unwrap",
        "bool",
        True,
        "",
        "Whether angles that a driver gives modulo a turn are made continuous.",
    ),
    Parameter(
        "model.scheme", "str", "radau", "", "Time integration scheme.", choices=SCHEMES, read_only=True
    ),
    Parameter(
        "model.alpha",
        "float",
        -0.45,
        "",
        "Parameter alpha of the scheme bdf_alpha.",
        -0.5,
        0.5,
        read_only=True,
    ),
    Parameter(
        "model.nodes",
        "int",
        12,
        "",
        "Least number of arc-length nodes along the robot; model.accuracy_m may want more.",
        8,
        1000,
        read_only=True,
    ),
    Parameter(
        "model.accuracy_m",
        "float",
        0.05e-3,
        "m",
        "Largest error of the tip by the nodes, rms over 4 s after a load is cut that deflects the tip by a third of its length.",
        1e-6,
        1.0,
        read_only=True,
    ),
    Parameter(
        "model.tolerance",
        "float",
        1e-4,
        "",
        "Scaled residual at the tip below which the shooting has converged.",
        1e-11,
        1e-3,
    ),
    Parameter(
        "filter.enabled", "bool", True, "", "Whether the tracker is fused; false runs the open-loop model."
    ),
    Parameter(
        "filter.rank",
        "int",
        24,
        "",
        "Least number of columns of the covariance factor. It is rounded up to 16, 24, 32 or 40 for two tubes.",
        4,
        40,
        read_only=True,
    ),
    Parameter(
        "filter.gate_probability",
        "float",
        0.9999,
        "",
        "Chi-square probability of the gate; a measurement outside it is rejected.",
        0.9,
        0.999999,
    ),
    Parameter(
        "filter.tip_force_sigma_N",
        "float",
        0.0,
        "N",
        "Smallest standard deviation per axis of the unknown tip force; 0: what moves the tip by half a percent of the tracker's noise.",
        0.0,
        10.0,
    ),
    Parameter(
        "filter.tip_force_sigma_max_N",
        "float",
        0.0,
        "N",
        "Largest standard deviation per axis of the unknown tip force; 0: what bends the robot by a tenth of its exposed length. "
        "The innovations decide between the smallest and the largest; equal values fix it.",
        0.0,
        10.0,
    ),
    Parameter(
        "filter.tip_force_change_s",
        "float",
        20.0,
        "s",
        "Mean time between two changes of the standard deviation of the unknown tip force.",
        0.01,
        1e6,
    ),
    Parameter(
        "filter.tip_force_time_s",
        "float",
        0.3,
        "s",
        "Correlation time of the unknown tip force.",
        0.001,
        1000.0,
    ),
    Parameter(
        "filter.window_s",
        "float",
        0.2,
        "s",
        "Largest age at which a measurement is still fused at its own stamp, and at which joints and loads still count.",
        0.0,
        2.0,
    ),
    Parameter(
        "misfit.window_s",
        "float",
        10.0,
        "s",
        "Window of the consistency monitor.",
        1.0,
        600.0,
    ),
    Parameter(
        "misfit.nis_limit",
        "float",
        1.3,
        "",
        "Largest mean NIS per degree of freedom over the window without a warning.",
        1.0,
        100.0,
    ),
    Parameter(
        "misfit.cusum_slack",
        "float",
        0.5,
        "",
        "Slack of the CUSUM: excess of the NIS per degree of freedom that it does not count.",
        0.0,
        10.0,
    ),
    Parameter(
        "misfit.cusum_limit",
        "float",
        60.0,
        "",
        "Largest CUSUM of the NIS without a warning.",
        1.0,
        1e6,
    ),
    Parameter(
        "misfit.whiteness_limit",
        "float",
        2.5,
        "",
        "Largest Ljung-Box statistic of the innovations per degree of freedom without a warning.",
        1.0,
        1000.0,
    ),
    Parameter(
        "tracker.delay_s",
        "float",
        0.0,
        "s",
        "Delay added to that of the robot file. It is positive when poses are older than their stamps.",
        -0.2,
        0.2,
    ),
    Parameter(
        "tracker.lever_arm_m",
        "floats",
        ZEROS,
        "m",
        "Position of the sensor in the tip frame, added to that of the robot file.",
        -1.0,
        1.0,
        size=3,
    ),
    Parameter(
        "tracker.registration_rotation_rad",
        "floats",
        ZEROS,
        "rad",
        "Rotation vector of ctr_base in the tracker's frame, composed with the registration of the robot file.",
        -2 * math.pi,
        2 * math.pi,
        size=3,
    ),
    Parameter(
        "tracker.registration_translation_m",
        "floats",
        ZEROS,
        "m",
        "Origin of ctr_base in the tracker's frame, composed with the registration of the robot file.",
        -100.0,
        100.0,
        size=3,
    ),
    Parameter(
        "tracker.mount_rotation_rad",
        "floats",
        ZEROS,
        "rad",
        "Rotation vector of the sensor in the tip frame.",
        -2 * math.pi,
        2 * math.pi,
        size=3,
    ),
    Parameter(
        "tracker.frame_id",
        "str",
        "",
        "",
        "Frame that the tracker's poses are in; empty: `output.frame_id`. The registration says how it lies. "
        "Poses in another frame are brought into it by the transforms on `/tf` and `/tf_static`.",
    ),
    Parameter(
        "tracker.child_frame_id",
        "str",
        "",
        "",
        "Child frame of the sensor, in transforms and odometry; empty: the only one there is.",
    ),
    Parameter(
        "tracker.stamps",
        "str",
        "header",
        "",
        "When a pose was measured: at the stamp in its header, or on its arrival (log time of a bag).",
        choices=("header", "arrival"),
    ),
    Parameter(
        "tracker.axes",
        "str",
        "xyzrpy",
        "",
        "Axes that the tracker measures: positions, then rotations about the tip's x (r), y (p) and z (y).",
        syntax=axes_mask,
        syntax_text="subset of xyzrpy, in that order",
    ),
    Parameter(
        "output.policy",
        "str",
        "predict",
        "",
        "When a step is taken. wait: after a joint state with its stamp or a later one has arrived (default of replay). "
        "predict: on time, with extrapolated joints.",
        choices=("wait", "predict"),
    ),
    Parameter(
        "output.max_age_s",
        "float",
        0.06,
        "s",
        "An output that is older than this when it goes out is invalid: the node was held up, or joint states came late. Live node alone.",
        0.003,
        60.0,
    ),
    Parameter(
        "output.largest_deviation_m",
        "float",
        0.0,
        "m",
        "Largest standard deviation of the tip's position (root of the trace) at which outputs are valid. 0 stands for 5 % of tube 1's length.",
        0.0,
        1.0,
    ),
    Parameter(
        "output.backbone_every",
        "int",
        11,
        "",
        "Steps between two messages of the backbone path.",
        1,
        1000,
        read_only=True,
    ),
    Parameter(
        "output.frame_id",
        "str",
        "ctr_base",
        "",
        "Frame of every output. Loads must name this frame or none, and so must poses while `tracker.frame_id` is empty.",
        read_only=True,
    ),
    Parameter(
        "output.publish_tf",
        "bool",
        False,
        "",
        "Publish the ends of the tubes as frames on `/tf`, and `ctr_base` in the tracker's frame where `tracker.frame_id` names one.",
        read_only=True,
    ),
    Parameter(
        "qos.subscription_reliability",
        "str",
        "best_effort",
        "",
        "Reliability that the node requests from publishers.",
        choices=RELIABILITY,
        read_only=True,
    ),
    Parameter(
        "qos.subscription_depth", "int", 50, "", "Queue depth of each input topic.", 1, 10000, read_only=True
    ),
    Parameter(
        "qos.publisher_reliability",
        "str",
        "reliable",
        "",
        "Reliability that the node offers to subscribers.",
        choices=RELIABILITY,
        read_only=True,
    ),
    Parameter(
        "qos.publisher_depth", "int", 10, "", "Queue depth of each output topic.", 1, 10000, read_only=True
    ),
    Parameter(
        "record.path",
        "str",
        "",
        "",
        "MCAP file for a recording of inputs and outputs; empty for none.",
        read_only=True,
    ),
    Parameter(
        "record.rolling_s",
        "float",
        0.0,
        "s",
        "Length of the ring buffer of inputs. It is written when the consistency monitor warns, by `~/save_snapshot`, "
        "and at exit during a warning; 0 for none.",
        0.0,
        600.0,
        read_only=True,
    ),
    Parameter(
        "record.rolling_path",
        "str",
        "",
        "",
        "MCAP file for the ring buffer, replaced each time. Empty: `ctr_estimator_rolling.mcap` in the ROS log folder.",
        read_only=True,
    ),
    Parameter(
        "timing_report",
        "str",
        "",
        "",
        "JSON file for the punctuality of the steps, written at exit; empty for none.",
        read_only=True,
    ),
)

_BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}
_REMOVED = {"model.dt_s": "steps always take 3 ms: remove it"}


def parameter(name: str) -> Parameter:
    """The parameter of that name.

    Raises:
        InputError: unknown, with the nearest name.
    """
    try:
        return _BY_NAME[name]
    except KeyError:
        near = get_close_matches(name, _BY_NAME, 1)
        hint = _REMOVED.get(name) or (f"did you mean '{near[0]}'?" if near else "see docs/parameters.md")
        raise InputError(f"unknown parameter '{name}'", do=hint) from None
