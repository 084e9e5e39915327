"""Bags and loose messages through the estimator, and comparison with the truth of the bags."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from ctr_dynamics.estimation.estimator import Estimator
from ctr_dynamics.estimation.step_output import StepOutput
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.messages.cdr import JointStateIn, PoseIn
from ctr_dynamics.io.messages.topics import STEP_NS
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.replay import Player

BAGS = Path(__file__).parents[1] / "data" / "bags"
START_NS = 1_700_000_000_000_000_000
JOINTS = ("tube1_rotation", "tube2_rotation", "tube1_translation", "tube2_translation")


def estimator(settings: Mapping[str, Any] | None = None, robot: Any = "till2020_tissue") -> Estimator:
    """An estimator with the policy `wait` unless `settings` say otherwise."""
    loaded = load_robot(robot) if isinstance(robot, str) else robot
    return Estimator(loaded, Settings({"output.policy": "wait", **(settings or {})}))


@dataclass
class Run:
    """Steps of one run, with the estimator as it stood at the end."""

    outputs: list[StepOutput]
    estimator: Estimator

    def column(self, name: str) -> np.ndarray:
        """One output of every step, stacked."""
        return np.array([getattr(out, name) for out in self.outputs])

    @property
    def t(self) -> np.ndarray:
        """(steps,) s since the bags' begin."""
        return (self.column("stamp_ns") - START_NS) * 1e-9

    @property
    def last(self) -> StepOutput:
        """The newest step."""
        return self.outputs[-1]


def replay_bag(name: str, settings: Mapping[str, Any] | None = None) -> Run:
    """A shipped bag in the order of its log times, as the command `replay` does it."""
    made = estimator(settings)
    return Run(list(Player(made).play(open_bag(BAGS / f"{name}.mcap"))), made)


@dataclass(frozen=True)
class Message:
    """A message to the estimator: `kind` is joints, pose or load, `stamp` and `arrival` are in ns from the bags' begin."""

    kind: str
    stamp: int
    arrival: int
    content: tuple

    def late(self, seconds: float) -> Message:
        """The same, arriving later."""
        return replace(self, arrival=self.arrival + round(seconds * 1e9))

    def shifted(self, seconds: float) -> Message:
        """The same at another time."""
        ns = round(seconds * 1e9)
        return replace(self, stamp=self.stamp + ns, arrival=self.arrival + ns)

    def give(self, to: Estimator) -> None:
        """Hand it to the estimator."""
        add = {"joints": to.add_joint_state, "pose": to.add_tracker_pose, "load": to.add_tip_load}[self.kind]
        add(START_NS + self.stamp, *self.content)


def joints(t: float, values: Iterable[float], names: tuple[str, ...] = JOINTS) -> Message:
    """A joint state of `t` s: alpha of both tubes, then beta."""
    ns = round(t * 1e9)
    return Message("joints", ns, ns, (names, [float(v) for v in values]))


def bag_messages(name: str, until: float) -> list[Message]:
    """Messages of the first `until` s of a shipped bag."""
    found = []
    for item in open_bag(BAGS / f"{name}.mcap").inputs():
        m = item.message
        if item.log_ns - START_NS > until * 1e9:
            break
        if isinstance(m, JointStateIn):
            kind, content = "joints", (m.names, m.positions)
        elif isinstance(m, PoseIn):
            kind, content = "pose", (m.position, m.quaternion_xyzw, m.frame_id)
        else:
            kind, content = "load", (m.force, m.torque, m.frame_id)
        found.append(Message(kind, m.stamp_ns - START_NS, item.log_ns - START_NS, content))
    return found


def play(
    messages: Iterable[Message],
    settings: Mapping[str, Any] | None = None,
    *,
    tick: float = 0.0,
    robot: Any = "till2020_tissue",
    spare: Callable[[Estimator], float] | None = None,
    prepare: Callable[[Estimator], object] = lambda made: None,
) -> Run:
    """Messages in the order of their arrival; the clock is that of the stamps.

    Args:
        tick: s between further calls of `advance`, as a live node makes them; 0 calls it at arrivals only.
        spare: of the estimator, the time (s) until the next step, as `advance` asks for it.
        prepare: is given the estimator before the first message.
    """
    made, outputs = estimator(settings, robot), []
    prepare(made)
    spare_s = None if spare is None else partial(spare, made)
    now = None
    for arrival, group in groupby(sorted(messages, key=lambda m: m.arrival), key=lambda m: m.arrival):
        while tick and now is not None and now + round(tick * 1e9) < arrival:
            now += round(tick * 1e9)
            outputs += made.advance(START_NS + now, spare_s)
        for message in group:
            message.give(made)
        now = arrival
        outputs += made.advance(START_NS + now, spare_s)
    return Run(outputs + made.finish(), made)


def check_outputs(run: Run) -> None:
    """What holds for every run: stamps t0 + k 3 ms, none twice, and no valid step with a number that is not finite."""
    stamps = run.column("stamp_ns")
    assert np.all(np.diff(stamps) > 0)
    for out in run.outputs:
        assert (out.stamp_ns - run.outputs[0].stamp_ns) % STEP_NS == 0
        if out.valid:
            assert out.reason == ""
            for name, value in out._asdict().items():
                if isinstance(value, np.ndarray):
                    assert np.isfinite(value).all(), (out.k, name)
        else:
            assert out.reason


def truth_error(run: Run, name: str, key: str, since: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Fused tip minus truth `key` of the bag `name` (steps, 3) m at every step from `since` s on, and these steps."""
    truth = np.load(BAGS / "truth" / f"{name}.npz")
    t = run.t
    steps = np.flatnonzero(t >= since)
    expected = np.array([np.interp(t[steps], truth["t"], truth[key][:, i]) for i in range(3)]).T
    value = run.column("tip_velocity")[:, :3] if key == "v" else run.column("tip_position")
    return value[steps] - expected, steps


def rms(errors: np.ndarray) -> float:
    """Root mean square of the lengths of vectors (k, 3)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def nearer(run: Run, name: str) -> tuple[float, float]:
    """(rms in m, mean NEES per degree of freedom of the position) against `p_trk` or `p`, whichever is nearer."""
    results = []
    for key in ("p_trk", "p"):
        error, steps = truth_error(run, name, key)
        covariance = run.column("tip_covariance")[steps, :3, :3]
        nees = np.einsum("ki,ki->k", error, np.linalg.solve(covariance, error[..., None])[..., 0]) / 3.0
        results.append((rms(error), float(nees.mean())))
    return min(results)
