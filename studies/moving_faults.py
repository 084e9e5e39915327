"""Whether ``valid`` keeps its promise while the robot moves: faults of tracker, joints, load and machine, in replay and live.

    python -m studies.moving_faults [--robot NAME_OR_FILE ...] [--only NAME ...] [--live] [--output faults.json]

Every robot runs a shipped scenario in the simulator. A fault changes the messages between 4 s and 6 s, or all of them, and the bag is
replayed under ``predict``, or played over DDS to a fresh node. Every valid pose is compared with the truth. The promise is broken where the error
exceeds both 3 mm and three of its own 3-D deviations. The robot's outputs are normal again where they are valid and within three times the
clean run's rms error, but 0.5 mm at least. Exit code 1 when a promise was broken.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.client import Client
from rclpy.serialization import deserialize_message
from std_srvs.srv import Trigger

from ctr_dynamics.io.bag_reader import RawMessage, open_bag
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages import cdr, topics
from ctr_dynamics.io.messages.encode import encode_wrench_stamped
from ctr_dynamics.kernels.rotations import from_vector, matrix, multiply
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.ros.listener import Listener
from ctr_dynamics.ros.node_processes import ESTIMATOR, NodeProcess, free_domain
from ctr_dynamics.runtime.playback import load, shifted
from ctr_dynamics.runtime.replay import replay
from ctr_dynamics.simulation import load_scenario, simulate, write_recording
from ctr_dynamics.simulation.scenario_run import truth_of
from studies.fault_messages import Messages, during, joints, pose
from studies.live_faults import PATIENCE_S, play

BEGIN_S, END_S = 4.0, 6.0
LEAST_MM, DEVIATIONS = 3.0, 3.0  # what the promise allows
NORMAL_MM, NORMAL_TIMES = 0.5, 3.0
J, T, L = topics.JOINT_STATES, topics.TRACKER_TIP, topics.TIP_LOAD
Floats = NDArray[np.float64]
Edit = Callable[[Messages], Messages]


def in_span(topic: str, change: Callable[[RawMessage], list[RawMessage]], end_s: float = END_S) -> Edit:
    return during(topic, change, BEGIN_S, end_s)


def last_before(topic: str, messages: Messages) -> RawMessage:
    """The last message of ``topic`` before the span."""
    begin = messages[0].log_ns + BEGIN_S * 1e9
    return next(m for m in reversed(messages) if m.topic == topic and m.log_ns < begin)


def frozen(messages: Messages) -> Messages:
    """The last pose before the span again and again."""
    held = cdr.decode_pose_stamped(last_before(T, messages).data)
    return in_span(T, pose(lambda p: held._replace(stamp_ns=p.stamp_ns)))(messages)


def beside(size_m: float, share: float) -> Edit:
    """A share of the poses ``size_m`` off in one direction."""

    def change(messages: Messages) -> Messages:
        rng = np.random.default_rng(7)
        shift = rng.normal(size=3)
        shift *= size_m / np.linalg.norm(shift)

        def off(p: cdr.PoseIn) -> cdr.PoseIn:
            if rng.random() >= share:
                return p
            x, y, z = (a + b for a, b in zip(p.position, shift.tolist(), strict=True))
            return p._replace(position=(x, y, z))

        return in_span(T, pose(off))(messages)

    return change


def moving_frame(speed: float, turn: float) -> Edit:
    """A frame that shifts by ``speed`` (m/s) and turns by ``turn`` (rad/s) from the begin of the span on, for good."""

    def change(messages: Messages) -> Messages:
        begin_ns = cdr.decode_stamp(messages[0].data) + round(BEGIN_S * 1e9)
        direction, axis = np.array([0.6, 0.0, 0.8]), np.array([0.0, 1.0, 0.0])

        def moved(p: cdr.PoseIn) -> cdr.PoseIn:
            since = (p.stamp_ns - begin_ns) * 1e-9
            turned = matrix(from_vector(turn * since * axis)) @ np.array(p.position)
            x, y, z = (turned + speed * since * direction).tolist()
            return p._replace(position=(x, y, z))

        return in_span(T, pose(moved), math.inf)(messages)

    return change


def knocked(p: cdr.PoseIn) -> cdr.PoseIn:
    """A sensor that sits 20 mm further and turned by 0.5 rad."""
    x, y, z, w = p.quaternion_xyzw
    w, x, y, z = multiply(np.array([w, x, y, z]), from_vector(np.array([0.0, 0.5, 0.0]))).tolist()
    return p._replace(position=(p.position[0] + 0.02, *p.position[1:]), quaternion_xyzw=(x, y, z, w))


def late(seconds: float, begin_s: float = 0.0, end_s: float = math.inf) -> Edit:
    """Poses stamped on arrival, which is late, from ``begin_s`` to ``end_s``."""
    ns = round(seconds * 1e9)
    return during(T, lambda m: [m._replace(log_ns=m.log_ns + ns, data=shifted(m.data, ns))], begin_s, end_s)


def in_bursts(size: int, begin_s: float = 0.0, end_s: float = math.inf, lost: float = 0.0) -> Edit:
    """Poses that a driver hands over and stamps ``size`` at a time, of which it loses a part ``lost``."""

    def change(messages: Messages) -> Messages:
        rng, first = np.random.default_rng(5), messages[0].log_ns
        here = [
            i for i, m in enumerate(messages) if m.topic == T and begin_s <= (m.log_ns - first) * 1e-9 < end_s
        ]
        moved: list[RawMessage | None] = list(messages)
        for burst in zip(*[iter(here)] * size, strict=False):
            last = messages[burst[-1]]
            stamp = cdr.decode_stamp(last.data)
            for place, i in enumerate(burst):
                after = 100_000 * place
                data = shifted(messages[i].data, stamp + after - cdr.decode_stamp(messages[i].data))
                handed_over = messages[i]._replace(log_ns=last.log_ns + after, data=data)
                moved[i] = None if rng.random() < lost else handed_over
        return sorted((m for m in moved if m is not None), key=lambda m: m.log_ns)

    return change


def scattered(deviation_s: float) -> Edit:
    """Stamps that are off at random, whatever the poses show."""

    def change(messages: Messages) -> Messages:
        rng = np.random.default_rng(3)
        off = [round(1e9 * deviation_s * rng.standard_normal()) for _ in messages]
        return [
            m._replace(data=shifted(m.data, ns)) if m.topic == T else m
            for m, ns in zip(messages, off, strict=True)
        ]

    return change


def smoothed(time_s: float) -> Edit:
    """Poses that a driver passes through a low-pass filter of that time constant."""

    def change(messages: Messages) -> Messages:
        state: list[tuple[int, Floats]] = []

        def slow(p: cdr.PoseIn) -> cdr.PoseIn:
            now = np.array([*p.position, *p.quaternion_xyzw])
            if state:
                before_ns, before = state[-1]
                now[3:] *= math.copysign(1.0, float(now[3:] @ before[3:]))
                now = before - math.expm1(-(p.stamp_ns - before_ns) * 1e-9 / time_s) * (now - before)
            state[:] = [(p.stamp_ns, now)]
            x, y, z = now[:3].tolist()
            i, j, k, w = (now[3:] / np.linalg.norm(now[3:])).tolist()
            return p._replace(position=(x, y, z), quaternion_xyzw=(i, j, k, w))

        edit = pose(slow)
        return [n for m in messages for n in (edit(m) if m.topic == T else [m])]

    return change


def one_joint_state(edit: Callable[[RawMessage], RawMessage]) -> Edit:
    """The joint state in the middle of the span changed."""

    def change(messages: Messages) -> Messages:
        middle = messages[0].log_ns + 5e8 * (BEGIN_S + END_S)
        at = next(i for i, m in enumerate(messages) if m.topic == J and m.log_ns >= middle)
        return [*messages[:at], edit(messages[at]), *messages[at + 1 :]]

    return change


def turned_on(angle: float) -> Callable[[RawMessage], list[RawMessage]]:
    """The first joint ``angle`` (rad) further."""
    return joints(lambda j: j._replace(positions=(j.positions[0] + angle, *j.positions[1:])))


def stopped(messages: Messages) -> Messages:
    """Encoders that report the same for a second, while the tubes move."""
    held = cdr.decode_joint_state(last_before(J, messages).data)
    return in_span(J, joints(lambda j: held._replace(stamp_ns=j.stamp_ns)), BEGIN_S + 1.0)(messages)


def two_drivers(messages: Messages) -> Messages:
    """A second driver that still reads the start."""
    start = cdr.decode_joint_state(next(m for m in messages if m.topic == J).data)

    def double(m: RawMessage) -> list[RawMessage]:
        stamp = cdr.decode_stamp(m.data) + 4_000_000
        second = joints(lambda j: start._replace(stamp_ns=stamp))(m)[0]
        return [m, second._replace(log_ns=m.log_ns + 4_000_000)]

    return in_span(J, double)(messages)


def beyond_reason(messages: Messages) -> Messages:
    """50 N on the load topic for half a second."""
    first = messages[0].log_ns
    begin, stamp = first + round(BEGIN_S * 1e9), cdr.decode_stamp(messages[0].data)
    added = []
    for after_s, force in ((0.0, 0.0), (0.01, 50.0), (0.5, 50.0), (0.51, 0.0)):
        at = begin - first + round(after_s * 1e9)
        data = encode_wrench_stamped(stamp + at, "ctr_base", (0.0, -force, 0.0), (0.0, 0.0, 0.0))
        added.append(RawMessage(L, first + at, data))
    return sorted([*messages, *added], key=lambda m: m.log_ns)


def huge(p: cdr.PoseIn) -> cdr.PoseIn:
    return p._replace(position=(1e160, -1e160, 1e160))


NAN = float("nan")
FAULTS: dict[str, tuple[Edit, float]] = {  # the change, and when it ends (s); inf where it lasts
    "none": (lambda messages: messages, 0.0),
    "tracker silent for 2 s": (in_span(T, lambda m: []), END_S),
    "tracker frozen for 2 s": (frozen, END_S),
    "all poses 5 mm off for 2 s": (beside(0.005, 1.0), END_S),
    "half the poses 3 mm off for 2 s": (beside(0.003, 0.5), END_S),
    "half the poses 50 mm off for 2 s": (beside(0.05, 0.5), END_S),
    "sensor 20 mm off and turned by 0.5 rad for 2 s": (in_span(T, pose(knocked)), END_S),
    "a frame that shifts by 2 mm/s": (moving_frame(0.002, 0.0), math.inf),
    "a frame that turns by 0.03 rad/s": (moving_frame(0.0, 0.03), math.inf),
    "poses of 1e160 for 2 s": (in_span(T, pose(huge)), END_S),
    "poses 80 ms late, not told": (late(0.08), math.inf),
    "poses 40 ms late for 2 s": (late(0.04, BEGIN_S, END_S), END_S),
    "poses in bursts of four": (in_bursts(4), math.inf),
    "poses in bursts of four for 2 s": (in_bursts(4, BEGIN_S, END_S), END_S),
    "poses in bursts of four, one in seven lost": (in_bursts(4, lost=1.0 / 7.0), math.inf),
    "stamps that scatter by 5 ms": (scattered(0.005), math.inf),
    "a low-pass filter of 60 ms on the poses": (smoothed(0.06), math.inf),
    "latency that jumps by 60 ms": (late(0.06, BEGIN_S), math.inf),
    "joints stopped for 1 s": (stopped, BEGIN_S + 1.0),
    "an encoder slips by 0.2 rad": (in_span(J, turned_on(0.2), math.inf), math.inf),
    "joints silent for 0.25 s": (in_span(J, lambda m: [], BEGIN_S + 0.25), BEGIN_S + 0.25),
    "joints NaN for 0.6 s": (
        in_span(J, joints(lambda j: j._replace(positions=(NAN, *j.positions[1:]))), BEGIN_S + 0.6),
        BEGIN_S + 0.6,
    ),
    "one joint state 1 rad off": (one_joint_state(lambda m: turned_on(1.0)(m)[0]), 5.1),
    "one joint state 0.9 s ahead": (
        one_joint_state(lambda m: m._replace(data=shifted(m.data, 900_000_000))),
        5.0,
    ),
    "two drivers for 2 s": (two_drivers, END_S),
    "50 N on the load topic for 0.5 s": (beyond_reason, 4.51),
    "start in motion": (
        lambda messages: [m for m in messages if m.log_ns - messages[0].log_ns >= BEGIN_S * 1e9],
        BEGIN_S,
    ),
}
LIVE = {"reset in motion": BEGIN_S, "process stopped for 2 s": END_S}


@dataclasses.dataclass
class Poses:
    """Valid poses of a run: `t` (n,) s from the bag's start, `p` (n, 3) m, `deviation` (n,) m in 3-D; what the diagnostics said above OK."""

    t: Floats
    p: Floats
    deviation: Floats
    said: list[str]

    @classmethod
    def of(cls, poses: Sequence[bytes], diagnostics: Sequence[bytes], start_ns: int) -> Poses:
        decoded = sorted(cdr.decode_numbers(data, 43)[::2] for data in poses)
        rows = np.array([numbers for _, numbers in decoded]).reshape(-1, 43)
        said: dict[str, None] = {}
        for data in diagnostics:
            for status in deserialize_message(data, DiagnosticArray).status:
                if ord(status.level) > 0:
                    said[f"{status.name}: {status.message}"] = None
        return cls(
            np.array([(stamp - start_ns) * 1e-9 for stamp, _ in decoded]),
            rows[:, :3],
            np.sqrt(rows[:, [7, 14, 21]].sum(axis=1)),
            list(said),
        )


@dataclasses.dataclass
class Result:
    """What one fault did to one robot. Times in s, errors in mm; None where it has no meaning."""

    robot: str
    fault: str
    where: str
    published: float  # share of the steps
    broken: int  # steps
    broken_for_s: float | None  # from the beginning of the fault to the last broken step
    worst_mm: float | None
    worst_deviations: float | None
    rms_mm: float | None
    normal_after_s: float | None
    said: list[str]


def judge(
    robot: str,
    fault: str,
    where: str,
    run: Poses,
    truth: tuple[Floats, Floats],
    end_s: float,
    clean_mm: float,
) -> Result:
    """Compare a run with the ``truth`` (s, m); ``clean_mm``: rms error of the run without fault."""
    t, p = truth
    first = BEGIN_S if fault == "start in motion" else 0.0
    steps = (t[-1] - first) / (1e-9 * topics.STEP_NS)
    if not len(run.t):
        return Result(robot, fault, where, 0.0, 0, None, None, None, None, None, run.said)
    at = np.column_stack([np.interp(run.t, t, column) for column in p.T])
    error = 1e3 * np.linalg.norm(run.p - at, axis=1)
    share = error / (1e3 * run.deviation)
    broken = (error > LEAST_MM) & (share > DEVIATIONS)
    normal = None
    if math.isfinite(end_s) and fault != "none":
        # normal from the step on after which no gap, and no error beyond the clean run's, follows
        limit = max(NORMAL_MM, NORMAL_TIMES * clean_mm)
        late_steps = np.flatnonzero((error > limit) & (run.t > end_s))
        gaps = np.flatnonzero(np.diff(run.t) > 2e-9 * topics.STEP_NS)
        last = max([end_s, *run.t[late_steps].tolist(), *[x for x in run.t[gaps + 1].tolist() if x > end_s]])
        normal = max(last, run.t[0]) - end_s
    return Result(
        robot, fault, where, round(min(len(run.t) / steps, 1.0), 3), int(broken.sum()),
        round(float(run.t[broken][-1]) - BEGIN_S, 3) if broken.any() else None,
        round(float(error.max()), 2), round(float(share.max()), 1), round(float(np.sqrt(np.mean(error**2))), 3),
        None if normal is None else round(normal, 3), run.said,
    )  # fmt: skip


def replayed(messages: Messages, robot: str, folder: Path, start_ns: int) -> Poses:
    bag, output = folder / "in.mcap", folder / "out.mcap"
    with write_bag(bag, {}) as writer:
        for m in messages:
            writer.write(m.topic, m.log_ns, m.data)
    replay(bag, robot, {"output.policy": "predict"}, output=output)
    found: dict[str, list[bytes]] = {topics.TIP_POSE: [], topics.DIAGNOSTICS: []}
    for m in open_bag(output).messages(set(found)):
        found[m.topic].append(m.data)
    return Poses.of(found[topics.TIP_POSE], found[topics.DIAGNOSTICS], start_ns)


def live(messages: Messages, robot: str, fault: str, folder: Path, start_ns: int) -> Poses:
    domain, names = free_domain(), [topics.TIP_POSE, topics.DIAGNOSTICS]
    with (
        NodeProcess(ESTIMATOR, {"robot": robot}, domain, folder / "estimator.log") as node,
        Listener(domain, names, depth=10000) as listener,
    ):
        ready = listener.wait_for(lambda: listener.matched() or node.code is not None, PATIENCE_S)
        if not ready or node.code is not None:
            raise RuntimeError(node.output())
        timers = []
        if fault == "reset in motion":
            client: Client = listener.node.create_client(Trigger, "estimator/reset")
            client.wait_for_service(PATIENCE_S)
            timers = [threading.Timer(BEGIN_S, lambda: client.call_async(Trigger.Request()))]
        elif fault in LIVE:
            timers = [
                threading.Timer(BEGIN_S, lambda: node.send(signal.SIGSTOP)),
                threading.Timer(END_S, lambda: node.send(signal.SIGCONT)),
            ]
        for timer in timers:
            timer.start()
        played = play(listener, messages, 1.0)
        node.stop()
        found = {name: [m.data for m in listener.received[name]] for name in names}
    return Poses.of(found[topics.TIP_POSE], found[topics.DIAGNOSTICS], start_ns + played.shift_ns)


def study(robot: str, scenario_name: str, faults: Sequence[str], over_dds: bool) -> list[Result]:
    scenario, of = load_scenario(scenario_name), load_robot(robot)
    recording = simulate(scenario, of)
    true = truth_of(scenario, of, recording)
    assert true.start_ns is not None
    results: list[Result] = []
    where, clean_mm = "live" if over_dds else "replay", 0.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_recording(folder / "bag.mcap", scenario, of, recording)
        messages = load(folder / "bag.mcap")
        for fault in dict.fromkeys(["none", *faults]):
            edit, end_s = FAULTS[fault] if fault in FAULTS else (FAULTS["none"][0], LIVE[fault])
            changed = edit(messages)
            if over_dds:
                run = live(changed, robot, fault, folder, true.start_ns)
            else:
                run = replayed(changed, robot, folder, true.start_ns)
            result = judge(of.name, fault, where, run, (true.t, true.position), end_s, clean_mm)
            if fault == "none":
                clean_mm = result.rms_mm or 0.0
            print(json.dumps(dataclasses.asdict(result)), file=sys.stderr, flush=True)
            results.append(result)
    return results


def table(results: Sequence[Result]) -> str:
    """Markdown: a row for each fault, with every robot's figures."""
    robots = list(dict.fromkeys(r.robot for r in results))
    lines = [
        "| fault | " + " | ".join(robots) + " |",
        "|---|" + "---|" * len(robots),
    ]
    for fault in dict.fromkeys(r.fault for r in results):
        cells = []
        for robot in robots:
            r = next((r for r in results if (r.robot, r.fault) == (robot, fault)), None)
            if r is None or r.worst_mm is None:
                cells.append("-" if r is None else "nothing valid")
                continue
            back = "" if r.normal_after_s is None else f", {r.normal_after_s:.2f} s"
            cells.append(
                f"{r.broken}, {r.worst_mm:.1f} mm, {r.worst_deviations:.1f}, {100 * r.published:.0f} %{back}"
            )
        lines.append(f"| {fault} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--robot", nargs="+", default=["till2020_tissue", "three_tube"], help="robots")
    parser.add_argument("--scenario", default="sweep", help="scenario file or a shipped one")
    parser.add_argument("--only", nargs="+", choices=[*FAULTS, *LIVE], help="these faults alone")
    parser.add_argument("--live", action="store_true", help="over DDS in real time, not in replay")
    parser.add_argument("--output", type=Path, help="JSON file for the figures")
    options = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    faults = options.only or [*FAULTS, *(LIVE if options.live else ())]
    results = [
        result for robot in options.robot for result in study(robot, options.scenario, faults, options.live)
    ]
    print(table(results))
    if options.output:
        rows = [dataclasses.asdict(result) for result in results]
        options.output.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    return 1 if any(result.broken for result in results) else 0


if __name__ == "__main__":
    sys.exit(main())
