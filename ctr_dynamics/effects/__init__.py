"""The catalogue of effects: what the model can be extended by, and what diagnosis looks for; and the plant that they act on."""

from ctr_dynamics.effects import catalogue
from ctr_dynamics.effects.plant import Plant
from ctr_dynamics.effects.registry import (
    EFFECTS,
    Effect,
    EffectParameter,
    EffectQuantity,
    Values,
    apply_effects,
    combined,
    effect,
    effect_quantities,
    make_plant,
    per_tube,
    register,
)

__all__ = [
    "EFFECTS",
    "Effect",
    "EffectParameter",
    "EffectQuantity",
    "Plant",
    "Values",
    "apply_effects",
    "combined",
    "effect",
    "effect_quantities",
    "make_plant",
    "per_tube",
    "register",
]

register(*catalogue.CATALOGUE)
