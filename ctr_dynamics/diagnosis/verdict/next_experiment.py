"""The next experiment: which motion of the library would tell two explanations apart, by how much."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.inference.candidates import Candidate
from ctr_dynamics.diagnosis.inference.map_fit import prior_variance
from ctr_dynamics.diagnosis.inference.sensitivities import left_over, separation
from ctr_dynamics.diagnosis.pipeline import Diagnosis
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.diagnosis.whitening import Whitener
from ctr_dynamics.errors import InputError
from ctr_dynamics.model.model import Model
from ctr_dynamics.robot import Robot
from ctr_dynamics.simulation.scenario import Scenario, load_scenario
from ctr_dynamics.simulation.scenario_run import drives

Floats = NDArray[np.float64]
LIBRARY = ("release", "light_release", "reversals", "turns")
START = "release"  # what excites most, for bags that excite nothing


@dataclass(frozen=True)
class Plan:
    """A scenario of the library and what it is worth; separations in whitened units, None where unknown."""

    description: str
    scenario: Scenario
    before: float | None
    after: float | None


def planned(scenario: Scenario, robot: Robot) -> Recording:
    """What a bag of ``scenario`` would hold, without readings."""
    _, known = drives(scenario, robot, Model(robot, nodes=16))
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


def plan(diagnosis: Diagnosis) -> Plan | None:
    """The most informative experiment; None where nothing is left to tell apart."""
    d = diagnosis
    if d.verdict == "not_excited":
        scenario = load_scenario(START)
        return Plan(
            f"{scenario.description}: excites bending and torsion, which these bags do not",
            scenario,
            None,
            None,
        )
    if d.problem is None or d.best is None or d.at_best is None:
        return None
    member = next((m for m in d.members if m.candidate is not None and m.rivals), None)
    if member is None or member.candidate is None or member.separation is None:
        return None
    rivals = [c for c in d.at_best.signatures if c.effect == member.rivals[0]]
    if not rivals:
        return None
    rival = rivals[0]
    before = separation(d.problem, d.best, (member.candidate,), rival, d.at_best)
    best: Plan | None = None
    for name in LIBRARY:
        scenario = load_scenario(name)
        try:
            after = _separation(d, scenario, member.candidate, rival)
        except InputError:
            continue
        if after is not None and (best is None or best.after is None or after > best.after):
            text = f"{scenario.description}; tells {member.effect} from {rival.effect}"
            best = Plan(text, scenario, before, after)
    return best


def _separation(d: Diagnosis, scenario: Scenario, own: Candidate, rival: Candidate) -> float | None:
    """Separation of the two with these bags and one of ``scenario`` together."""
    assert d.problem is not None
    assert d.best is not None
    assert d.at_best is not None
    fit = d.best
    recording = planned(scenario, d.robot)
    forward_model = ForwardModel(recording, d.robot, d.problem.forward_models[0].nodes)
    rivals = [q for q in rival.quantities if q.key not in {x.key for x in fit.active}]
    point = {**fit.point, **dict(rival.start)}
    prediction, jacobian = forward_model.jacobian(point, (*fit.active, *rivals))
    if prediction.failure:
        return None
    mask = d.problem.whiteners[0].mask
    whiten = Whitener(d.robot, recording.stamps, mask, np.ones(len(recording.stamps), bool))
    columns = whiten(jacobian)
    a = len(fit.active)
    old = fit.columns * [q.scale for q in fit.active]
    old_rival = d.at_best.signatures[rival]
    chosen = [i for i, q in enumerate(rival.quantities) if q.key in {x.key for x in rivals}]
    old_rival = old_rival[:, chosen] * [rival.quantities[i].scale for i in chosen]
    everything = np.vstack([old, columns[:, :a]])
    against = np.vstack([old_rival, columns[:, a:]])
    keys = {q.key for q in own.quantities}
    departure = np.array(
        [(v - q.off) / q.scale if q.key in keys else 0.0 for q, v in zip(fit.active, fit.values, strict=True)]
    )
    signature = everything @ departure
    wide = {q.key for q in fit.causes} - keys
    widths = np.array([math.sqrt(prior_variance(q, q.key in wide)) / q.scale for q in fit.active])
    return float(left_over(np.hstack([everything * widths, against]), signature[:, None])[0])
