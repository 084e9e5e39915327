"""Parameters of the node and of replay: one table, checked values, and the files that hold them."""

from ctr_dynamics.parameters.input_parameters import input_mapping, pose_frame
from ctr_dynamics.parameters.parameter_files import read_parameter_file
from ctr_dynamics.parameters.parameter_table import PARAMETERS, RELIABILITY, parameter
from ctr_dynamics.parameters.parameter_types import Parameter, Value, axes_mask
from ctr_dynamics.parameters.settings import Settings, parse_assignments, without_defaults

__all__ = [
    "PARAMETERS",
    "RELIABILITY",
    "Parameter",
    "Settings",
    "Value",
    "axes_mask",
    "input_mapping",
    "parameter",
    "parse_assignments",
    "pose_frame",
    "read_parameter_file",
    "without_defaults",
]
