"""The release test: a weight of 60 g hangs beyond the tip and is cut at 1 s while the tubes stand still; simulated in two ways."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.model import trajectory
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.time_scheme import make_scheme, scheme_of
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.simulation import load_scenario
from ctr_dynamics.simulation import simulate as run_scenario

Floats = NDArray[np.float64]
DT = 0.003
ROUNDS = 3  # runs of which the fastest counts


@cache
def release_robot() -> Robot:
    """The robot of the test."""
    return load_robot("till2020_tissue")


@cache
def _at_rest() -> tuple[Floats, Floats, Floats]:
    """Angles (2,) rad and translations (2,) m of the tubes, and their rates."""
    rest = release_robot().rest
    return np.array(rest.alpha.value), np.array(rest.beta.value), np.zeros(2)


@dataclass(frozen=True)
class Release:
    """Robot and load of the test: the weight's wrench (6,), and how much earlier than at 1 s it is cut (s)."""

    wrench: Floats
    early: float

    @property
    def events(self) -> tuple[float, float]:
        """Times in s at which the load begins to fall and is gone."""
        return 1.0 - self.early, 1.01 - self.early

    @classmethod
    def make(cls, cut: float) -> Release:
        """The shipped scenario's weight on `till2020_tissue`, cut at `cut` s within 10 ms."""
        scenario = load_scenario("release")
        short = scenario.model_copy(update={"duration_s": 0.002})
        return cls(run_scenario(short, release_robot()).wrench(0.0), 1.0 - cut)

    def at(self, t: float) -> Inputs:
        """Inputs at `t` s."""
        wrench = min(max((1.01 - self.early - t) / 0.01, 0.0), 1.0) * self.wrench
        alpha, beta, still = _at_rest()
        return Inputs(alpha, still, beta, still, wrench[:3], wrench[3:])


@dataclass(frozen=True)
class Path:
    """A simulated release: tips (steps + 1, 3) m, wall time in s, work of all steps; `failure` is empty when it went well."""

    dt: float
    tips: Floats
    wall: float
    solves: int
    sweeps: int
    jacobians: int
    failure: str = ""

    @property
    def steps(self) -> int:
        """Steps taken."""
        return len(self.tips) - 1

    @property
    def realtime(self) -> float:
        """Time simulated over time spent."""
        return self.steps * self.dt / self.wall


def compiled(test: Release, nodes: int, duration: float, tolerance: float) -> tuple[float, float]:
    """The release at the default scheme in the compiled loop of :mod:`ctr_dynamics.model.trajectory`: real-time ratio and sweeps a step.

    Inputs are sampled before the clock starts, as they are those of a bag or a scenario.
    """
    scheme = make_scheme("sdirk3", DT)
    steps = round(duration / DT)
    rows = sampled(test, DT, duration)
    wall = np.inf
    for _ in range(ROUNDS):
        model = Model(release_robot(), nodes=nodes)
        begin = time.perf_counter()
        done = trajectory.run(model, scheme, model.parameters, rows, duration, tolerance=tolerance)
        wall = min(wall, time.perf_counter() - begin)
    return steps * DT / wall, done.sweeps / steps


def sampled(test: Release, dt: float, duration: float, turn: Floats | None = None) -> trajectory.InputRows:
    """Inputs of the release as :func:`trajectory.run <ctr_dynamics.model.trajectory.run>` asks for them with the default scheme, ``dt`` and
    ``duration`` in s, both tubes turned by ``turn`` (2,) rad. They are sampled here, before a clock starts, as those of a bag are."""
    known: dict[tuple[float, int], Floats] = {}
    more = np.zeros(2) if turn is None else turn

    def rows(times: Floats) -> Floats:
        key = float(times[0]), len(times)
        if key not in known:
            found = [test.at(float(t)) for t in times]
            known[key] = np.array(
                [np.r_[x.alpha + more, x.alpha_rate, x.beta, x.force, x.torque] for x in found]
            )
        return known[key]

    # as many as a run takes, or it would sample the last ones again
    count = int(np.floor(duration / dt + 1e-9))
    for first in range(0, count, trajectory.CHUNK):
        steps = np.arange(first, min(first + trajectory.CHUNK, count))
        rows(((steps[:, None] + make_scheme("sdirk3", dt).times) * dt).ravel())
    return rows


def divided(test: Release, dt: float, nodes: int, duration: float, tolerance: float = 1e-7) -> Path:
    """The release at the default scheme, the steps around the cut divided there."""
    model = Model(release_robot(), nodes=nodes)
    rows = sampled(test, dt, duration)
    begin = time.perf_counter()
    done = trajectory.run(
        model, make_scheme("sdirk3", dt), model.parameters, rows, duration, tolerance=tolerance, events=test.events
    )  # fmt: skip
    wall = time.perf_counter() - begin
    return Path(dt, done.tip[:, :3], wall, 3 * (len(done.t) - 1), done.sweeps, 0, done.failure)


def run(test: Release, scheme: str, dt: float, nodes: int, duration: float, tolerance: float = 1e-7) -> Path:
    """Simulate the release at a fixed step, from Python one step at a time."""
    simulator = Simulator(Model(release_robot(), nodes=nodes), scheme_of(scheme, dt), tolerance=tolerance)
    state = simulator.rest(test.at(0.0))
    tips = [state.nodes[-1, :3].copy()]
    sweeps = jacobians = 0
    failure = ""
    steps = round(duration / dt)
    begin = time.perf_counter()
    for k in range(steps):
        result = simulator.step(state, k * dt, test.at)
        if not result.ok:
            failure = f"step at {k * dt:.4f} s: {result.reason}"
            break
        sweeps += result.sweeps
        jacobians += result.jacobians
        tips.append(state.nodes[-1, :3].copy())
    wall = time.perf_counter() - begin
    return Path(
        dt, np.array(tips), wall, simulator.scheme.stages * (len(tips) - 1), sweeps, jacobians, failure
    )


def rms_difference(path: Path, reference: Path, since: float) -> float | None:
    """3-D rms (m) between two runs from `since` s on, at the coarser steps; None if one of them failed."""
    if path.failure or reference.failure:
        return None
    ratio = round(path.dt / reference.dt)
    other = reference.tips[::ratio]
    count = min(len(path.tips), len(other))
    first = round(since / path.dt)
    return rms(path.tips[first:count] - other[first:count])


def rms(differences: Floats) -> float:
    """3-D rms of (K, 3)."""
    return float(np.sqrt(np.mean(np.sum(differences**2, axis=1))))


def tip_length() -> float:
    """Length of the robot beyond the plate in m."""
    return release_robot().exposed_length
