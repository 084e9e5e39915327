"""The catalogue of effects: what the model can be extended by, and what diagnosis looks for."""

from ctr_dynamics.effects import drive, friction, structure, surroundings, tracking
from ctr_dynamics.effects.registry import EFFECTS, Effect, Parameter, Quantity, apply_effects, quantities
from ctr_dynamics.effects.setup import Setup, make_setup
from ctr_dynamics.kernels.backlash import play

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
