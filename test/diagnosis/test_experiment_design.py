"""Motions that experiments are put together from: within what drives can do, away from snaps, and such that the simulator takes them."""

import numpy as np
import pytest

from ctr_dynamics.diagnosis.diagnosis_options import DesignOptions
from ctr_dynamics.diagnosis.experiment_design import SPACING_S, hung_mass, motion_blocks, scenario_of
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.stability import StabilityWatch
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.simulation.scenario_run import drives

OPTIONS = DesignOptions(blocks=8)
ROBOTS = ("till2020_tissue", "three_tube")


@pytest.fixture(scope="module", params=ROBOTS)
def robot(request):
    return load_robot(request.param)


@pytest.fixture(scope="module")
def blocks(robot):
    return motion_blocks(robot, OPTIONS)


def test_there_are_motions_of_every_kind_with_and_without_a_weight(blocks):
    assert len(blocks) == 1 + OPTIONS.blocks
    assert {b.kind for b in blocks} == {"rest", "turns", "together", "translations"}
    assert {b.loaded for b in blocks[1:]} == {False, True}
    assert all(b.rotations.any() or b.translations.any() for b in blocks[1:])


def test_motions_begin_and_end_at_rest_and_are_no_faster_than_allowed(robot, blocks):
    for block in blocks:
        for path, fastest, farthest in (
            (block.rotations, OPTIONS.fastest_rad_s, OPTIONS.farthest_rad),
            (block.translations, OPTIONS.fastest_m_s, OPTIONS.farthest_translation * robot.exposed_length),
        ):
            rates = np.diff(path, axis=0) / SPACING_S
            assert not path[[0, -1]].any()
            assert np.abs(rates).max() <= 1.001 * fastest
            assert np.abs(path).max() <= 1.001 * farthest
            assert np.abs(rates[[0, -1]]).max() < 0.1 * fastest  # without a jerk


def test_the_same_options_give_the_same_motions(robot, blocks):
    for one, again in zip(blocks, motion_blocks(robot, OPTIONS), strict=True):
        np.testing.assert_array_equal(one.rotations, again.rotations)


def test_no_motion_comes_near_a_snap(robot, blocks):
    """Looked at more closely than when they were chosen, on the scenario itself."""
    scenario = scenario_of(robot, blocks, OPTIONS)
    model = Model(robot, nodes=16)
    real, _ = drives(scenario, robot, model)
    watch = StabilityWatch(model)
    measures = []
    for t in np.arange(0.0, scenario.duration_s, 0.02):
        now = real(t)
        found = watch.update(t, now.beta, now.alpha, now.force, now.torque)
        assert not found.lost
        measures.append(found.measure)
    assert min(measures) > 0.8 * OPTIONS.least_stability * measures[-1]


def test_the_weight_bends_the_robot_as_far_as_said_and_is_cut_behind_its_motions(robot, blocks):
    scenario = scenario_of(robot, [blocks[1], blocks[2], blocks[0]], OPTIONS)
    loaded = sum(b.loaded for b in (blocks[1], blocks[2], blocks[0]))
    (load,) = scenario.loads
    each_s = OPTIONS.block_s + OPTIONS.pause_s
    assert load.end_s == pytest.approx(loaded * each_s - 0.5 * OPTIONS.pause_s)
    statics, beta, alpha = Statics(Model(robot)), robot.rest.beta.value, robot.rest.alpha.value
    free, hung = (
        statics.solve(np.array(beta), np.array(alpha), mass * np.array(robot.gravity.value)).tip_position
        for mass in (0.0, hung_mass(robot, OPTIONS))
    )
    deflection = np.linalg.norm(hung - free) / robot.exposed_length
    assert deflection == pytest.approx(OPTIONS.deflection, rel=0.05)
