"""Diagnosis from recordings and a robot to findings: the stages in their order.

Nothing here knows files: :mod:`ctr_dynamics.diagnosis.request` reads bags, and :mod:`ctr_dynamics.diagnosis.output` writes the outcome.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.configuration_mistakes import FoundMistake, beginning, find_mistake, misfit
from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.diagnosis_result import Diagnosis
from ctr_dynamics.diagnosis.inference.candidates import candidates
from ctr_dynamics.diagnosis.inference.discretisation_error import choose_nodes, correct_discretisation
from ctr_dynamics.diagnosis.inference.evidence import weigh_by_prediction, weigh_discrepancy
from ctr_dynamics.diagnosis.inference.fit_problem import Problem, choose_steps, make_problem
from ctr_dynamics.diagnosis.inference.fit_quality import is_wrong
from ctr_dynamics.diagnosis.inference.hypothesis_search import search_hypotheses
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.diagnosis.inference.recalibration import fit_nuisances, nuisances_of, recalibrate
from ctr_dynamics.diagnosis.inference.residual_tests import rms, whiteness
from ctr_dynamics.diagnosis.inference.tolerance_evidence import tolerance_evidence
from ctr_dynamics.diagnosis.learned.learn import learn_force, on_robot
from ctr_dynamics.diagnosis.recording import Recording, measured_axes
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.verdict.decision import (
    Evidence,
    Verdict,
    decide,
    hypothesis_for_verdict,
    is_unexplained,
)
from ctr_dynamics.diagnosis.verdict.separability import Cause, observability
from ctr_dynamics.diagnosis.verdict.validation import validate
from ctr_dynamics.effects import effect_quantities
from ctr_dynamics.errors import InputError
from ctr_dynamics.robot import Robot


def diagnose_recordings(
    robot: Robot,
    recordings: Sequence[Recording],
    validation: Sequence[Recording] = (),
    *,
    mask: NDArray[np.bool_] | None = None,
    options: DiagnosisOptions | None = None,
    context: RunContext | None = None,
) -> Diagnosis:
    """Diagnose ``recordings`` of ``robot``; ``validation`` bags are predicted only.

    Args:
        mask: (6,) measured axes of the tracker: position, then rotation; None finds out which rotations are there.
        options: numbers of all stages.
        context: progress, workers and time.
    Raises:
        InputError: the nominal model cannot be simulated on a bag.
    """
    options, context = options or DiagnosisOptions(), context or RunContext()
    begin = context.elapsed_s
    result = Diagnosis(robot, list(recordings), options)

    # data: recordings and the axes of the tracker that carry information
    result.notes += [text for r in (*recordings, *validation) for text in r.notes]
    if mask is None:
        mask = measured_axes([*recordings, *validation], result.notes)

    # configuration: units, signs and orders, where the nominal misfit is gross
    context.report("nominal model")
    problem = make_problem(robot, recordings, nuisances_of(robot), mask, options)
    problem.workers = context.workers
    mistake = find_mistake(recordings[0], robot, mask, options, context)
    result.tested.append("config_mistake")
    if mistake is not None and not _tolerances_explain(problem, mistake, context):
        result.mistake = mistake
        return _mistaken(result, problem, context.elapsed_s - begin)

    # forward model: the nominal robot on every recording
    result.problem = problem
    choose_nodes(problem, {}, context)
    result.residual_nominal = problem.residuals({})
    result.nominal_rms = rms(np.concatenate(result.residual_nominal)[:, :3])
    if not math.isfinite(result.nominal_rms):
        raise InputError(
            "the nominal model cannot be simulated on this bag",
            do="check the robot, the joints and the load with `ctr-dynamics info`",
        )

    choose_steps(problem, {}, context)

    # re-calibration: nuisances inside tolerance, and the solver's own error
    recalibrated, result.numerics = recalibrate(problem, context)
    result.recalibrated = result.extended = recalibrated
    result.tested += ["time_discretisation", "space_discretisation"]
    result.whiteness_recalibrated = whiteness(problem, recalibrated)

    # screening and hypotheses: what explains the rest
    positions = np.concatenate([r.position[np.isfinite(r.position).all(axis=1)] for r in recordings])
    pool = candidates(effect_quantities(robot), positions, options.prior)
    effects = sorted({c.effect for c in pool})
    result.tested += effects
    found = result.search = search_hypotheses(problem, pool, recalibrated, context)
    if found is None:
        raise InputError(
            "the re-calibrated model cannot be linearised", do="check the robot file and the bag"
        )
    recalibrated = result.recalibrated = found.no_cause.fit
    result.whiteness_recalibrated = whiteness(problem, recalibrated)
    if context.out_of_time:
        result.notes.append(
            f"the time budget of {context.time_budget_s:g} s is used up: the search was not completed"
        )

    # evidence: what the likeliest hypotheses predict of bags that were not fitted
    held_out = None
    if validation:
        held_out = problem.on(validation)
        choose_steps(held_out, found.best.fit.point, context)
        if any(not is_wrong(problem, e) for e in found.hypotheses):
            context.report("evidence of the validation bags")
            correct_discretisation(held_out, found.best.fit.point, context)
            weigh_by_prediction(found, problem, held_out, context)
    best = hypothesis_for_verdict(found, problem)
    result.extended = best.fit
    result.whiteness_extended = whiteness(problem, best.fit)

    # validation: errors on bags that were not fitted
    if held_out is not None:
        context.report("validation")
        result.validation = validate(held_out, found.no_cause.fit, best.fit)

    # discrepancy: something outside the catalogue competes where noise does not explain what is left
    weighed = None
    if result.whiteness_extended.p < options.residual_tests.noise_p and best.resolved:
        context.report("evidence of a discrepancy")
        weighed = weigh_discrepancy(found, problem, context)
        unexplained = is_unexplained(
            problem, found, best, Evidence(result.whiteness_extended, result.validation, True)
        )
        if unexplained and weighed.leading is not best:
            best = weighed.leading
            result.extended, result.whiteness_extended = best.fit, whiteness(problem, best.fit)
            if held_out is not None:
                result.validation = validate(held_out, found.no_cause.fit, best.fit)

    # verdict
    seen = observability(problem, effects, found.sensitivities)
    result.not_observable = seen.not_observable
    evidence = Evidence(result.whiteness_extended, result.validation, seen.excited, weighed, result.numerics)
    verdict = decide(problem, found, best, evidence, context)
    _take(result, verdict)
    named = any(cause.candidate is not None for cause in verdict.causes)
    if best.members and not named:  # a cause that the verdict does not list is in no robot file
        best = found.no_cause
        result.extended, result.whiteness_extended = best.fit, result.whiteness_recalibrated
        if held_out is not None:
            result.validation = validate(held_out, best.fit, best.fit)
    if named and verdict.discrepancy is not None:
        # values and intervals with the remainder as a correlated process instead of larger noise
        beside = verdict.discrepancy.fit
        result.extended = replace(
            beside, covariance=verdict.discrepancy.covariance, chi2=min(beside.chi2, float(problem.size))
        )
        if held_out is not None:
            result.validation = validate(held_out, found.no_cause.fit, result.extended)

    # output: residuals for findings and report
    result.residual_recalibrated = problem.residuals(recalibrated.point)
    result.residual_extended = problem.residuals(result.extended.point)

    # learned force: what no cause explains, where it predicts bags that were not fitted
    measured = all(map(math.isfinite, result.numerics.values()))
    if verdict.word in ("unknown", "named_with_remainder") and measured and not context.out_of_time:
        base = found.no_cause.fit if verdict.word == "unknown" else best.fit
        _learn(result, problem, base, found.no_cause.fit, validation, context)

    # tolerances: without a cause, whether the robot's values scatter more than the robot file says
    if result.verdict == "clean":
        result.tolerances = tolerance_evidence(found.no_cause.fit, problem.numerics, options.tolerances)
        if result.tolerances.evidence > options.tolerances.substantial and result.tolerances.wider:
            result.verdict = "tolerances"

    result.seconds = context.elapsed_s - begin
    return result


def _tolerances_explain(problem: Problem, mistake: FoundMistake, context: RunContext) -> bool:
    """Whether the nuisances of ``problem`` inside their tolerances leave less of its first recording than ``mistake`` leaves when it is undone."""
    model, options = problem.forward_models[0], problem.options
    try:
        fit = fit_nuisances(problem, context)
    except InputError:
        return False
    recording, fine = beginning(model.recording, options), options.forward_model.fine
    mask = problem.whiteners[0].mask
    return misfit(recording, problem.robot, mask, fine, model.steps, fit.point) < mistake.misfit_undone


def _mistaken(result: Diagnosis, problem: Problem, seconds: float) -> Diagnosis:
    """A mistake of the configuration ends the diagnosis: everything else would be fitted to it."""
    result.verdict = "named"
    result.causes = [Cause(None, "config_mistake", None)]
    result.cause_sets = [(("config_mistake",), None)]
    result.seconds = seconds
    try:
        result.nominal_rms = rms(np.concatenate(problem.residuals({}))[:, :3])
    except InputError:  # no equilibrium to start from
        result.nominal_rms = math.nan
    return result


def _learn(
    result: Diagnosis,
    problem: Problem,
    base: Fit,
    no_cause: Fit,
    validation: Sequence[Recording],
    context: RunContext,
) -> None:
    """Extend ``base`` by a learned force, if there is one that predicts."""
    result.learning = learn_force(problem, base, validation, context)
    force = result.learning.force
    if force is None:
        result.notes.append(f"nothing was learned: {result.learning.reason}")
        return
    own = on_robot(problem, force.robot)
    result.extended, result.whiteness_extended = force.fit, whiteness(own, force.fit)
    result.residual_extended = own.residuals(force.fit.point)
    if validation:
        result.validation = validate(on_robot(problem, force.robot, validation), no_cause, force.fit)


def _take(result: Diagnosis, verdict: Verdict) -> None:
    result.verdict, result.causes, result.cause_sets = verdict.word, verdict.causes, verdict.cause_sets
    result.sensitivities, result.unexplained_force = verdict.sensitivities, verdict.unexplained_force
    result.discrepancy = verdict.discrepancy
    result.notes += verdict.notes
