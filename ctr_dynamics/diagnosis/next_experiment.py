"""Next experiment: the motion that would tell a cause from its rivals, and by how much.

In: a diagnosis. Out: a scenario with the separation that it would give, or none where nothing is left to tell apart.

What blocks of motion tell of the parameters adds up (Fisher information). So each block is simulated once, and the experiment takes, one after
another, the block that adds most to the smallest separation: a greedy exact design (Fedorov 1972, for another criterion). The whole is then
simulated as it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from joblib import delayed
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.diagnosis_options import DesignOptions
from ctr_dynamics.diagnosis.diagnosis_result import Diagnosis
from ctr_dynamics.diagnosis.experiment_design import MotionBlock, motion_blocks, scenario_of
from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.inference.candidates import Candidate
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.diagnosis.inference.sensitivities import Sensitivities
from ctr_dynamics.diagnosis.inference.separation import departures, left_over_products, prior_scales
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.step_choice import with_chosen_steps
from ctr_dynamics.diagnosis.whitening import Whitener
from ctr_dynamics.effects import EffectQuantity
from ctr_dynamics.errors import InputError
from ctr_dynamics.model.model import Model
from ctr_dynamics.robot import Robot
from ctr_dynamics.simulation.scenario import Scenario
from ctr_dynamics.simulation.scenario_run import drives

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class NextExperiment:
    """A scenario and what it is worth; separations in whitened units, None where unknown."""

    description: str
    scenario: Scenario
    before: float | None
    after: float | None


def next_experiment(diagnosis: Diagnosis, context: RunContext | None = None) -> NextExperiment | None:
    """The most informative experiment; None where nothing is left to tell apart."""
    d, options = diagnosis, diagnosis.options.design
    if d.verdict == "not_excited":
        scenario = scenario_of(d.robot, motion_blocks(d.robot, options)[:2], options)
        text = "A weight that is cut, and a motion of all tubes: bending and torsion, which these bags do not show"
        return NextExperiment(text, _described(scenario, text), None, None)
    contrast = contrast_of(d)
    if contrast is None:
        return None
    before = contrast.smallest(contrast.nothing)
    designed = _designed(contrast, options, context or RunContext())
    if designed is None:
        return None
    scenario, after = designed
    text = f"{_kinds(scenario)}, {scenario.duration_s:.0f} s; tells {contrast.effect} from {', '.join(contrast.rivals)}"
    return NextExperiment(text, _described(scenario, text), before, after)


def contrast_of(diagnosis: Diagnosis) -> Contrast | None:
    """The first cause that has rivals, against the likeliest of these; None where none has."""
    d = diagnosis
    if d.problem is None or d.extended is None or d.sensitivities is None:
        return None
    cause = next((c for c in d.causes if c.candidate is not None and c.rivals), None)
    if cause is None or cause.candidate is None or cause.separation is None:
        return None
    likeliest = cause.rivals[: d.options.design.rivals]
    rivals = [c for c in d.sensitivities.by_candidate if c.effect in likeliest]
    return Contrast(d.problem, d.extended, d.sensitivities, cause.candidate, rivals) if rivals else None


def _kinds(scenario: Scenario) -> str:
    """What happens, in words."""
    said = ["a weight that is cut"] if scenario.loads else []
    said += ["turning tubes"] if any(t.rotation for t in scenario.tubes) else []
    said += ["tubes that slide"] if any(t.translation for t in scenario.tubes) else []
    text = ", ".join(said)
    return text[:1].upper() + text[1:]


def _described(scenario: Scenario, text: str) -> Scenario:
    return scenario.model_copy(update={"description": text})


def _designed(
    contrast: Contrast, options: DesignOptions, context: RunContext
) -> tuple[Scenario, float] | None:
    """The blocks that tell most together, as a scenario, and its smallest separation; None where none can be simulated."""
    robot = contrast.problem.robot
    blocks = motion_blocks(robot, options)
    told = context.run(delayed(contrast.told)(scenario_of(robot, [b], options)) for b in blocks)
    known = [(b, products) for b, products in zip(blocks, told, strict=True) if products is not None]
    chosen: list[MotionBlock] = []
    total, size = contrast.nothing, contrast.smallest(contrast.nothing)
    for _ in range(int(options.longest_s / (options.block_s + options.pause_s))):
        sizes = [contrast.smallest(total + products) for _, products in known]
        if not sizes or max(sizes) < (1.0 + options.least_gain) * size:
            break
        block, products = known[int(np.argmax(sizes))]
        chosen.append(block)
        total, size = total + products, max(sizes)
    while chosen:
        scenario = scenario_of(robot, chosen, options)
        whole = contrast.told(scenario, exact=True)
        if whole is not None:
            return scenario, contrast.smallest(whole)
        chosen.pop()
    return None


class Contrast:
    """A cause against its rivals, each alone.

    Args:
        problem, fit, sensitivities: of the bags at hand. own: the cause, which ``fit`` holds. rivals: what could do the same.

    Attributes:
        effect, rivals: IDs of the cause and of its rivals.
    """

    def __init__(
        self,
        problem: Problem,
        fit: Fit,
        sensitivities: Sensitivities,
        own: Candidate,
        rivals: Sequence[Candidate],
    ) -> None:
        self.problem, self._fit = problem, fit
        self.effect, self.rivals = own.effect, tuple(dict.fromkeys(rival.effect for rival in rivals))
        active = {q.key for q in fit.active}
        others: dict[tuple[str, str], EffectQuantity] = {
            q.key: q for rival in rivals for q in rival.quantities if q.key not in active
        }
        self._others = tuple(others.values())
        self._point = {**fit.point, **{key: value for rival in rivals for key, value in rival.start}}
        a, places = len(fit.active), list(others)
        self._departure = departures(fit, (own,))
        # of each rival: prior deviations beside it, its columns among all, and the products of those of these bags with the errors of the solver
        self._rivals: list[tuple[Floats, list[int], Floats]] = []
        for rival in rivals:
            free = [i for i, q in enumerate(rival.quantities) if q.key not in active]
            against = sensitivities.by_candidate[rival][:, free] * [rival.quantities[i].scale for i in free]
            columns = np.hstack([fit.columns, against, problem.numerics])
            own_columns = [*range(a), *(a + places.index(rival.quantities[i].key) for i in free)]
            self._rivals.append((prior_scales(fit, (own,), rival), own_columns, columns.T @ columns))
        self.nothing = np.zeros((a + len(others), a + len(others)))

    def smallest(self, told: Floats) -> float:
        """The separation from the nearest rival by the bags at hand and what else is ``told``: products of columns, of :meth:`told` or sums."""
        return min(self._separation(*rival, told) for rival in self._rivals)

    def _separation(self, prior: Floats, columns: list[int], products: Floats, told: Floats) -> float:
        a, n = len(prior), len(columns)
        total = products.copy()
        total[:n, :n] += told[np.ix_(columns, columns)]
        scales = np.concatenate([prior, np.ones(len(total) - a)])
        cause = total[:, :a] @ self._departure
        square = self._departure @ cause[:a]
        found = left_over_products(
            total * np.multiply.outer(scales, scales), (scales * cause)[:, None], np.array([[square]])
        )
        return float(found[0])

    def told(self, scenario: Scenario, exact: bool = False) -> Floats | None:
        """Products of the whitened columns that a bag of ``scenario`` would have, of all active values and of the rivals' by their scales; None
        where it cannot be simulated. ``exact``: with steps that are chosen for it, not with the shortest throughout."""
        problem, fit = self.problem, self._fit
        try:
            recording = recording_of(scenario, problem.robot, problem.options.forward_model.fine_nodes)
            mask = problem.whiteners[0].mask
            whiten = Whitener(problem.robot, recording.stamps, mask, np.ones(len(recording.stamps), bool))
            model = ForwardModel(recording, problem.robot, problem.forward_models[0].options)
            if exact:
                model = with_chosen_steps(model, whiten, fit.point, problem.options.steps)
            prediction, jacobian = model.jacobian(self._point, (*fit.active, *self._others))
        except InputError:
            return None
        if prediction.failure:
            return None
        scales = np.array([*(q.scale for q in fit.active), *(1.0 for _ in self._others)])
        columns = whiten(jacobian) / scales
        products: Floats = columns.T @ columns
        return products if np.isfinite(products).all() else None


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
