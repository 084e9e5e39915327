"""From the robot to its measurements and back: encoders and actuators, the tip tracker, and signals in time."""

from ctr_dynamics.sensing.actuators import ActuatorCorrection, ActuatorModel, ActuatorSignal
from ctr_dynamics.sensing.measurement import SENSORS, Measurement, Tip
from ctr_dynamics.sensing.tracker import TrackerCorrection, TrackerModel

__all__ = [
    "SENSORS",
    "ActuatorCorrection",
    "ActuatorModel",
    "ActuatorSignal",
    "Measurement",
    "Tip",
    "TrackerCorrection",
    "TrackerModel",
]
