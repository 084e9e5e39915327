"""Re-calibration: nuisances fitted inside their tolerances, with no cause, and the discretisation error there.

In: a problem. Out: the re-calibrated fit, against which every gain counts, and the size of the discretisation error.
"""

from __future__ import annotations

from ctr_dynamics.diagnosis.inference.discretisation_error import correct_discretisation
from ctr_dynamics.diagnosis.inference.fit_problem import Local, Problem, choose_steps
from ctr_dynamics.diagnosis.inference.fit_quality import excess, is_acceptable
from ctr_dynamics.diagnosis.inference.growing_fit import fit_growing
from ctr_dynamics.diagnosis.inference.map_fit import Fit, fit
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.effects import EFFECTS, EffectQuantity, effect_quantities
from ctr_dynamics.errors import InputError
from ctr_dynamics.robot import Robot


def nuisances_of(robot: Robot) -> list[EffectQuantity]:
    """Quantities of ``robot`` with a tolerance, without those that are free beside one effect only."""
    forms = {name for effect in EFFECTS.values() for name in effect.form}
    return [q for q in effect_quantities(robot) if q.tolerance > 0.0 and q.effect not in forms]


def recalibrate(problem: Problem, context: RunContext) -> tuple[Fit, dict[str, float]]:
    """Fit the nuisances, correct ``problem`` for its discretisation error at the fit, and fit again.

    Raises:
        InputError: no simulation succeeds.
    """
    first = fit_nuisances(problem, context)
    context.report("discretisation error")
    choose_steps(problem, first.point, context)
    before = problem.forward_models[0].options
    numerics = correct_discretisation(problem, first.point, context)
    here = problem.residual(first.point)
    if here is None:
        return first, numerics
    refined = problem.forward_models[0].options != before  # the columns of a coarse solution are others
    again = fit(problem, (), first.point, None if refined else Local(here, first.by_key)) or first
    if refined:
        numerics = correct_discretisation(problem, again.point, context)
        there = problem.residual(again.point)
        again = fit(problem, (), again.point, None if there is None else Local(there, again.by_key)) or again
    return again, numerics


def fit_nuisances(problem: Problem, context: RunContext) -> Fit:
    """The nuisances that fit best, from nominal ones on, before any correction for the discretisation error.

    Raises:
        InputError: no simulation succeeds.
    """
    context.report("re-calibration inside tolerance")
    first = fit(problem, (), {}, iterations=problem.options.calibration.first_iterations, polish=False)
    if first is not None:
        first = _from_growing_parts(problem, first, context)
    if first is None:
        raise InputError(
            "the model cannot be simulated near the nominal robot", do="check the robot file and the bag"
        )
    return first


def _from_growing_parts(problem: Problem, first: Fit, context: RunContext) -> Fit | None:
    """The fit to which the first steps of ``first`` lead, or a better one from growing parts of the recordings.

    A fit to all of them at once may stop at any of the minima between turns of phase.
    """
    if excess(problem, first) < problem.options.search.little_left:
        return first
    context.report("re-calibration of growing parts")
    grown = fit_growing(problem, limit=first.cost)
    if grown is not None and is_acceptable(problem, grown):
        return grown
    found = fit(problem, (), first.point, polish=False) or first
    return found if grown is None or found.cost <= grown.cost else grown
