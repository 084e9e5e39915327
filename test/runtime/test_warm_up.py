"""The dry run before the first message meets every kind of step, so that none is compiled or loaded while steps are due."""

import pytest

from ctr_dynamics.model.collocation_pair import CollocationPair
from ctr_dynamics.model.collocation_steps import CollocationSteps
from ctr_dynamics.model.simulator import Simulator
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.warm_up import warm_up


@pytest.mark.parametrize("policy", ["predict", "wait"])
@pytest.mark.parametrize("name", ["till2020_tissue", "three_tube"])
def test_both_runs_step_together_and_each_by_itself(monkeypatch, name, policy):
    taken = {CollocationPair: [], Simulator: []}
    for kind in taken:
        step = kind.step

        def noted(self, *args, step=step, found=taken[kind], **kwargs):
            result = step(self, *args, **kwargs)
            found.append((self, result))
            return result

        monkeypatch.setattr(kind, "step", noted)
    rescued = []
    rescue = CollocationSteps.rescue
    monkeypatch.setattr(
        CollocationSteps, "rescue", lambda self, *args: rescued.append(rescue(self, *args)) or rescued[-1]
    )
    settings = Settings({"robot": name, "output.policy": policy})
    assert warm_up(load_robot(name), settings) > 100
    assert sum(result is not None for _, result in taken[CollocationPair]) > 100
    both_and_that_without_a_load_in_doubt = 3
    assert len({id(simulator) for simulator, _ in taken[Simulator]}) == both_and_that_without_a_load_in_doubt
    assert all(result.ok for _, result in taken[Simulator])
    assert [result.ok for result in rescued[-2:]] == [True, True]
