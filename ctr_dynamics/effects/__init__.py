"""The catalogue of effects: what the model can be extended by, and what diagnosis looks for."""

from . import drive, friction, structure, surroundings, tracking
from .play import play
from .registry import EFFECTS, Effect, Parameter, Quantity, apply_effects, quantities
from .setup import Setup, make_setup

__all__ = [
    "EFFECTS",
    "Effect",
    "Parameter",
    "Quantity",
    "Setup",
    "apply_effects",
    "make_setup",
    "play",
    "quantities",
]

_ = (structure, friction, drive, surroundings, tracking)  # registered in this order
