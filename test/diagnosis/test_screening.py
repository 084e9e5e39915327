"""Candidates and their screening, at small and at large sizes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.inference.candidates import Candidate, candidates
from ctr_dynamics.diagnosis.inference.fit_problem import make_problem
from ctr_dynamics.diagnosis.inference.map_fit import fit
from ctr_dynamics.diagnosis.inference.screening import screen
from ctr_dynamics.diagnosis.inference.sensitivities import (
    Series,
    off_nominal,
    sensitivities_at,
    with_large_sizes,
)
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.effects import EFFECTS, effect_quantities
from ctr_dynamics.robot_files import load_robot

SILENT = RunContext(workers=1)


def test_every_effect_of_the_catalogue_is_a_candidate():
    robot = load_robot("till2020_tissue")
    positions = np.random.default_rng(4).normal(size=(100, 3)) * 0.02
    found = {c.effect for c in candidates(effect_quantities(robot), positions)}
    assert found == {name for name, effect in EFFECTS.items() if effect.searched and not effect.nuisance}


def test_large_sizes_are_looked_at_where_the_misfit_is_large(recording, robot, known):
    heavy = ("payload_inertia", "scale")
    seen = ForwardModel(recording, robot).predict({heavy: 0.5})
    there = replace(recording, position=seen.position, quaternion=seen.quaternion)
    problem = make_problem(robot, [there], [known["encoder_offset", "tube1.offset_rad"]], np.ones(6, bool))
    pool = [
        c
        for c in candidates(list(known.values()), there.position)
        if c.effect in ("payload_inertia", "density")
    ]
    clean = fit(problem, (), {})
    near = sensitivities_at(problem, {}, pool, SILENT)
    assert clean is not None
    assert near is not None
    far = with_large_sizes(problem, near, pool, SILENT)
    assert not near.trials
    (inertia,) = [c for c in pool if c.effect == "payload_inertia"]
    # the last of each sign that leaves least is followed by one 1.5 times as large
    assert [p.shift[heavy] for p in far.trials[inertia]] == pytest.approx(
        [1.25, 1.45, 1.7, 0.75, 0.55, 0.325]
    )
    np.testing.assert_array_equal(near.by_candidate[inertia], far.by_candidate[inertia])
    best = screen(problem, far, clean, (), pool)[0]
    assert best.candidate is inertia


def test_a_series_of_sizes_goes_on_as_long_as_the_last_leaves_least(known):
    c = Candidate("clearance", (known["clearance", "play_rad"],))

    def goes_on(*squares):
        return Series(c, {}, [0.6, 1.2], [100.0, *squares]).goes_on(1.5, least=3.0)

    assert goes_on(90.0, 80.0)
    assert not goes_on(70.0, 80.0)
    assert not goes_on(90.0, 88.0)  # by less than the noise of the squares
    assert not goes_on(110.0, 105.0)
    assert not goes_on(90.0, math.inf)  # it could not be simulated
    series = Series(c, {}, [0.6, 1.2], [100.0, 90.0, 80.0])
    assert series.goes_on(1.5, least=3.0)
    assert series.sizes == [0.6, 1.2, pytest.approx(1.8)]


def test_nuisances_imitate_a_cause_alone_or_together(recording, robot, known):
    """Twenty of them at 1.3 tolerances are as improbable as one at three."""
    nuisances = [q for q in known.values() if q.tolerance > 0.0][:20]
    problem = make_problem(robot, [recording], nuisances, np.ones(6, bool))

    def at(*tolerances):
        return {q.key: q.off + t * q.tolerance for q, t in zip(nuisances, tolerances, strict=False)}

    assert not off_nominal(problem, {})
    assert not off_nominal(problem, at(2.8))
    assert off_nominal(problem, at(-3.0))
    assert not off_nominal(problem, at(*20 * [1.2]))
    assert off_nominal(problem, at(*20 * [-1.3]))
