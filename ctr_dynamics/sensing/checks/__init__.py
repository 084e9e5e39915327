"""Checks of the messages that come in: faults of trackers, drivers, clocks and loads, found one message at a time.

The node, replay, ``info``, import and ``diagnose`` share these checks. They know neither ROS nor the estimator. They are causal: a verdict
depends on the message and on those before it, and the memory of a stream is bounded.
"""

from ctr_dynamics.sensing.checks.check_limits import CheckLimits, CheckOptions
from ctr_dynamics.sensing.checks.input_checks import InputChecks
from ctr_dynamics.sensing.checks.joint_checks import JointChecks
from ctr_dynamics.sensing.checks.load_checks import LoadChecks
from ctr_dynamics.sensing.checks.pose_checks import PoseChecks
from ctr_dynamics.sensing.checks.verdicts import Finding, Findings, Kind, Verdict

__all__ = [
    "CheckLimits",
    "CheckOptions",
    "Finding",
    "Findings",
    "InputChecks",
    "JointChecks",
    "Kind",
    "LoadChecks",
    "PoseChecks",
    "Verdict",
]
