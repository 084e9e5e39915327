"""Next experiment: which motion of the library would tell two hypotheses apart, by how much.

In: a diagnosis. Out: a scenario of the library with the separation that it would give, or none where nothing is left to tell apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.diagnosis_result import Diagnosis
from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.inference.candidates import Candidate
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.diagnosis.inference.sensitivities import Sensitivities
from ctr_dynamics.diagnosis.inference.separation import separation, separation_in
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.diagnosis.step_choice import with_chosen_steps
from ctr_dynamics.diagnosis.whitening import Whitener
from ctr_dynamics.errors import InputError
from ctr_dynamics.model.model import Model
from ctr_dynamics.robot import Robot
from ctr_dynamics.simulation.scenario import Scenario, load_scenario
from ctr_dynamics.simulation.scenario_run import drives

Floats = NDArray[np.float64]
LIBRARY = ("release", "light_release", "reversals", "turns")
MOST_EXCITING = "release"


@dataclass(frozen=True)
class NextExperiment:
    """A scenario of the library and what it is worth; separations in whitened units, None where unknown."""

    description: str
    scenario: Scenario
    before: float | None
    after: float | None


def next_experiment(diagnosis: Diagnosis) -> NextExperiment | None:
    """The most informative experiment; None where nothing is left to tell apart."""
    d = diagnosis
    if d.verdict == "not_excited":
        scenario = load_scenario(MOST_EXCITING)
        text = f"{scenario.description}: excites bending and torsion, which these bags do not"
        return NextExperiment(text, scenario, None, None)
    if d.problem is None or d.extended is None or d.sensitivities is None:
        return None
    cause = next((c for c in d.causes if c.candidate is not None and c.rivals), None)
    if cause is None or cause.candidate is None or cause.separation is None:
        return None
    rival = next((c for c in d.sensitivities.by_candidate if c.effect == cause.rivals[0]), None)
    if rival is None:
        return None
    before = separation(d.problem, d.extended, (cause.candidate,), rival, d.sensitivities)
    best: NextExperiment | None = None
    for name in LIBRARY:
        scenario = load_scenario(name)
        try:
            after = _separation_with(
                scenario, d.problem, d.extended, d.sensitivities, (cause.candidate, rival)
            )
        except InputError:
            continue
        if after is not None and (best is None or best.after is None or after > best.after):
            text = f"{scenario.description}; tells {cause.effect} from {rival.effect}"
            best = NextExperiment(text, scenario, before, after)
    return best


def recording_of(scenario: Scenario, robot: Robot, nodes: int) -> Recording:
    """What a bag of ``scenario`` would hold, without measurements."""
    _, known = drives(scenario, robot, Model(robot, nodes=nodes))
    t = np.arange(math.floor(scenario.duration_s * scenario.rates.joints_hz) + 1) / scenario.rates.joints_hz
    inputs = [known(x) for x in t]
    joints = np.array([[x, *i.alpha, *i.beta] for x, i in zip(t, inputs, strict=True)])
    load = np.zeros((0, 7))
    if scenario.loads:
        corners = {c for item in scenario.loads for c, _ in item.corners()}
        grid = sorted({*t.tolist(), *corners})
        load = np.array([[x, *known(x).force, *known(x).torque] for x in grid])
    stamps = (
        np.arange(math.floor(scenario.duration_s * scenario.rates.tracker_hz) + 1) / scenario.rates.tracker_hz
    )
    still = np.tile([1.0, 0.0, 0.0, 0.0], (len(stamps), 1))
    return Recording(
        scenario.description, scenario.source, {}, joints, load, stamps, np.zeros((len(stamps), 3)), still, ()
    )


def _separation_with(
    scenario: Scenario,
    problem: Problem,
    fit: Fit,
    sensitivities: Sensitivities,
    pair: tuple[Candidate, Candidate],
) -> float | None:
    """Separation of a cause from its rival (``pair``) with the bags of ``problem`` and one of ``scenario`` together."""
    own, rival = pair
    recording = recording_of(scenario, problem.robot, problem.options.forward_model.fine_nodes)
    mask = problem.whiteners[0].mask
    whiten = Whitener(problem.robot, recording.stamps, mask, np.ones(len(recording.stamps), bool))
    forward_model = ForwardModel(recording, problem.robot, problem.forward_models[0].options)
    forward_model = with_chosen_steps(forward_model, whiten, fit.point, problem.options.steps)
    rivals = [q for q in rival.quantities if q.key not in {x.key for x in fit.active}]
    point = {**fit.point, **dict(rival.start)}
    prediction, jacobian = forward_model.jacobian(point, (*fit.active, *rivals))
    if prediction.failure:
        return None
    columns = whiten(jacobian)
    a = len(fit.active)
    old_rival = sensitivities.by_candidate[rival]
    chosen = [i for i, q in enumerate(rival.quantities) if q.key in {x.key for x in rivals}]
    old_rival = old_rival[:, chosen] * [rival.quantities[i].scale for i in chosen]
    everything = np.vstack([fit.columns, columns[:, :a] / [q.scale for q in fit.active]])
    against = np.vstack([old_rival, columns[:, a:]])
    numerics = np.vstack([problem.numerics, np.zeros((len(columns), problem.numerics.shape[1]))])
    return separation_in(fit, everything, (own,), against, numerics)
