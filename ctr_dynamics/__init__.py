"""Dynamics, state estimation and diagnosis of concentric tube robots, with a ROS 2 node.

The public names are those of ``__all__``. They are imported when they are first used, so that ``import ctr_dynamics`` is cheap and changes
nothing in the process. SI units and radians everywhere; positions in the frame ``ctr_base`` unless a text says otherwise.
"""

from importlib import import_module as _import_module
from typing import Any as _Any

__version__ = "0.1.0"

# Public name -> module that defines it.
_PUBLIC = {
    "load_robot": "ctr_dynamics.robot_files",
    "Model": "ctr_dynamics.model.model",
    "Statics": "ctr_dynamics.model.statics",
    "Simulator": "ctr_dynamics.model.simulator",
    "Inputs": "ctr_dynamics.model.simulator",
    "load_scenario": "ctr_dynamics.simulation",
    "simulate": "ctr_dynamics.simulation",
    "Settings": "ctr_dynamics.parameters",
    "Estimator": "ctr_dynamics.estimation.estimator",
    "open_bag": "ctr_dynamics.io",
    "replay": "ctr_dynamics.runtime.replay",
    "diagnose": "ctr_dynamics.diagnosis.from_bags",
    "InputError": "ctr_dynamics.errors",
}

__all__ = [
    "Estimator",
    "InputError",
    "Inputs",
    "Model",
    "Settings",
    "Simulator",
    "Statics",
    "diagnose",
    "load_robot",
    "load_scenario",
    "open_bag",
    "replay",
    "simulate",
]


def __getattr__(name: str) -> _Any:
    """A public name, imported at its first use (PEP 562)."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(_import_module(_PUBLIC[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, "__version__"})
