"""The estimator live under faults: what it does meanwhile, how soon it is back, and what is lost.

    python -m studies.live_faults --output faults.json [--only NAME ...] [--table]

Each fault changes the messages of the shipped release bag between 2 s and 3 s (or all of them, or the machine) and plays them over
DDS to a fresh estimator node that records. Looked at are the node's outputs and its recording: numbers that are not finite, stamps
that repeat or go back, time without valid output, time from the end of the fault to the next valid output, tip error against the
truth in the last second, and what of the recording is readable. A last case runs the estimator for a long simulated time without
ROS. Exit code 1 when a promise was broken: the node must live, publish no NaN and no stamp twice, and be valid again after every
fault.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock

from ctr_dynamics.io.bag_reader import RawMessage, open_bag
from ctr_dynamics.io.messages import cdr, topics
from ctr_dynamics.io.shipped_bags import shipped_bag, shipped_truth
from ctr_dynamics.ros import qos
from ctr_dynamics.ros.listener import Listener
from ctr_dynamics.ros.node_processes import ESTIMATOR, NodeProcess, free_domain
from ctr_dynamics.ros.topic_names import message_class
from ctr_dynamics.runtime import live_report
from ctr_dynamics.runtime.playback import load, pace, shifted
from studies.fault_messages import END_S, FAULTS, NEEDS_RESET, WHOLE_RUN, Messages

SECONDS = 5.0
PATIENCE_S = 900.0


@dataclasses.dataclass
class Result:
    """What one fault did. Times in s, errors in m; None where it has no meaning."""

    fault: str
    steps: int
    invalid_s: float
    longest_wait_s: float
    back_after_s: float | None
    tip_rms_m: float | None
    not_finite: int
    repeated_stamps: int
    exit_code: int
    recorded: int | None = None
    not_recorded: int | None = None
    lost_s: float | None = None
    broken: list[str] = dataclasses.field(default_factory=list)


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    """Processes that take all the time they get."""
    spinning = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in spinning:
            process.kill()
            process.wait()


@dataclasses.dataclass(frozen=True)
class Played:
    """When and how fast messages were played: `start_ns` of the wall clock is the first log time, `shift_ns` went onto the stamps."""

    start_ns: int
    shift_ns: int
    speed: float

    def robot_s(self, arrival_ns: int) -> float:
        """Time since the first message on the robot's clock, s."""
        return (arrival_ns - self.start_ns) * 1e-9 * self.speed


def play(listener: Listener, messages: Messages, speed: float) -> Played:
    """Publish at `speed` times real time; below 1 with the recording's own clock on /clock."""
    profile = qos.profile("reliable", 100)
    node = listener.node
    outputs = {
        topic.name: node.create_publisher(message_class(topic.ros_type), topic.name, profile)
        for topic in topics.INPUTS
    }
    clock = node.create_publisher(Clock, "/clock", qos.profile("reliable", 10))
    listener.wait_for(lambda: all(p.get_subscription_count() for p in outputs.values()), 60.0)
    first = messages[0].log_ns
    items = list(messages)
    if speed < 1.0:
        listener.wait_for(lambda: clock.get_subscription_count() > 0, 60.0)
        end = messages[-1].log_ns + 200_000_000
        items += [
            RawMessage("", t, serialize_message(Clock(clock=stamp_of(t))))
            for t in range(first, end, 3_000_000)
        ]
        items.sort(key=lambda m: (m.log_ns, m.topic))
    start = time.time_ns() + 200_000_000
    shift = start - first if speed >= 1.0 else 0
    times = [first + round((m.log_ns - first) / min(speed, 1.0)) for m in items]
    for index, _ in pace(times, start, lambda: False, time.time_ns):
        m = items[index]
        if m.topic:
            outputs[m.topic].publish(shifted(m.data, shift) if len(m.data) >= 12 else m.data)
        else:
            clock.publish(m.data)
    time.sleep(0.3)
    for publisher in (*outputs.values(), clock):
        node.destroy_publisher(publisher)
    return Played(start, shift, min(speed, 1.0))


def stamp_of(t: int) -> Time:
    seconds, nanoseconds = cdr.split_stamp(t)
    return Time(sec=seconds, nanosec=nanoseconds)


def run(fault: str, folder: Path, speed: float) -> Result:
    """One fault on a fresh node."""
    bag = shipped_bag()
    messages = FAULTS[fault](load(bag, 0.0, SECONDS))
    recording = folder / "recorded.mcap"
    domain = free_domain()
    settings = {"record.path": str(recording), "use_sim_time": speed < 1.0}
    load_of = busy(2 * (os.cpu_count() or 2)) if fault.startswith("CPU") else contextlib.nullcontext()
    names = [topics.TIP_POSE, topics.VALID, topics.BACKBONE_STATE]
    with (
        NodeProcess(ESTIMATOR, settings, domain, folder / "estimator.log") as node,
        Listener(domain, names, depth=5000) as listener,
    ):
        ready = listener.wait_for(lambda: listener.matched() or node.code is not None, PATIENCE_S)
        if not ready or node.code is not None:
            raise RuntimeError(node.output())
        if fault == "disk full":
            resource.prlimit(node.pid, resource.RLIMIT_FSIZE, (300_000, 300_000))
        if fault.startswith("kill"):
            threading.Timer(3.0 / speed, lambda: node.send(signal.SIGKILL)).start()
        with load_of:
            played = play(listener, messages, speed)
        code = node.stop() if node.code is None else node.code
    return judge(fault, listener, messages, played, code, recording)


def judge(
    fault: str, listener: Listener, messages: Messages, played: Played, code: int, recording: Path
) -> Result:
    """Figures and broken promises."""
    poses = listener.received[topics.TIP_POSE]
    valid = [(played.robot_s(m.arrival_ns), bool(m.data[4])) for m in listener.received[topics.VALID]]
    marks = [cdr.decode_stamp(m.data) for m in poses]
    clouds = [cdr.decode_point_cloud(m.data).rows for m in listener.received[topics.BACKBONE_STATE]]
    finite = [np.isfinite(cdr.decode_numbers(m.data, 43)[2]).all() for m in poses] + [
        np.isfinite(c).all() for c in clouds
    ]
    within = [(t, ok) for t, ok in valid if t <= SECONDS]
    waits = np.diff([t for t, _ in within])
    after = [t for m in poses if (t := played.robot_s(m.arrival_ns)) >= END_S]
    result = Result(
        fault,
        steps=len(within),
        invalid_s=round(3e-3 * sum(not ok for _, ok in within), 3),
        longest_wait_s=round(float(waits.max()), 3) if len(waits) else math.inf,
        back_after_s=None if fault in WHOLE_RUN or not len(after) else round(after[0] - END_S, 3),
        tip_rms_m=error(poses, messages[0].log_ns + played.shift_ns, fault),
        not_finite=sum(not ok for ok in finite),
        repeated_stamps=int(np.sum(np.diff(marks) <= 0))
        if fault != "clock jumps 10 s back for good"
        else len(marks) - len(set(marks)),
        exit_code=code,
    )
    if recording.exists():
        recorded = [cdr.decode_stamp(m.data) for m in open_bag(recording).messages({topics.TIP_POSE})]
        result.recorded = len(recorded)
        result.not_recorded = len(set(marks) - set(recorded))
        if fault.startswith("kill") and marks and recorded:
            result.lost_s = round((marks[-1] - recorded[-1]) * 1e-9, 3)
    killed = fault.startswith("kill")
    if code != (-signal.SIGKILL if killed else 0):
        result.broken.append(f"exit code {code}")
    if result.not_finite:
        result.broken.append("numbers that are not finite")
    if result.repeated_stamps:
        result.broken.append("stamps repeated")
    if not len(poses) or (fault not in WHOLE_RUN | NEEDS_RESET and result.back_after_s is None):
        result.broken.append("not valid again")
    if killed and (result.lost_s is None or result.lost_s > 1.0):
        result.broken.append("more than 1 s of the recording lost")
    if result.not_recorded != 0 and not killed and fault != "disk full":
        result.broken.append("published and not recorded")
    return result


def error(poses: list[Any], start_ns: int, fault: str) -> float | None:
    """Tip error (rms, 3-D, m) against the truth in the last second."""
    if "for good" in fault or fault.startswith("kill"):
        return None
    truth_file = shipped_truth()
    if truth_file is None:
        return None
    fused = live_report.trace_of(poses, start_ns)
    best = math.inf
    for truth in live_report.truth_traces(truth_file):
        inside = (fused.t > SECONDS - 1.0) & (fused.t < SECONDS - 0.05)
        if inside.any():
            distance = np.linalg.norm(fused.p[inside] - truth.at(fused.t[inside]), axis=1)
            best = min(best, float(np.sqrt(np.mean(distance**2))))
    return best if math.isfinite(best) else None


def long_run(hours: float) -> dict[str, Any]:
    """The estimator alone on the bag's last second again and again, stamps running on: memory, failures, drift of the step's time."""
    from ctr_dynamics.estimation.estimator import Estimator
    from ctr_dynamics.parameters import Settings
    from ctr_dynamics.robot_files import load_robot

    inputs = [item for item in open_bag(shipped_bag()).inputs() if item.topic != topics.TIP_LOAD]
    first = inputs[0].log_ns
    part = [item for item in inputs if 4_000_000_000 <= item.log_ns - first < 5_000_000_000]
    estimator = Estimator(load_robot("till2020_tissue"), Settings({"output.policy": "wait"}))
    rounds = round(3600 * hours)
    invalid = steps = 0
    memory, spent = [], []
    for k in range(rounds):
        begin = time.perf_counter()
        for item in part:
            m, stamp = item.message, item.message.stamp_ns + k * 1_000_000_000
            if isinstance(m, cdr.JointStateIn):
                estimator.add_joint_state(stamp, m.names, m.positions)
            elif isinstance(m, cdr.PoseIn):
                estimator.add_tracker_pose(stamp, m.position, m.quaternion_xyzw, m.frame_id)
            for out in estimator.advance(stamp):
                steps += 1
                invalid += not out.valid
        spent.append(time.perf_counter() - begin)
        memory.append(int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize())
    tenth = max(1, rounds // 10)
    return {
        "hours": hours,
        "steps": steps,
        "invalid": invalid,
        "memory_after_tenth_MB": round(memory[tenth - 1] / 1e6, 1),
        "memory_at_end_MB": round(memory[-1] / 1e6, 1),
        "second_median_s": round(float(np.median(spent)), 4),
        "second_median_last_tenth_s": round(float(np.median(spent[-tenth:])), 4),
    }


def table(results: list[dict[str, Any]]) -> str:
    """Markdown table of the faults."""
    lines = [
        "| fault | steps | invalid, s | longest wait for a step, s | valid again after, s | tip error at the end, mm | kept of the recording |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in results:
        tip = "-" if r["tip_rms_m"] is None else f"{1e3 * r['tip_rms_m']:.2f}"
        back = "-" if r["back_after_s"] is None else f"{max(r['back_after_s'], 0):.3f}"
        kept = f"all but {r['not_recorded']}" if r["not_recorded"] else "all"
        if r["lost_s"] is not None:
            kept = f"all but the last {r['lost_s']} s"
        if r["fault"] == "disk full":
            kept = f"{r['recorded']} poses, to the limit"
        lines.append(
            f"| {r['fault']} | {r['steps']} | {r['invalid_s']:.2f} | {r['longest_wait_s']:.2f} | {back} | {tip} | {kept} |"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--only", nargs="+", choices=FAULTS, help="these faults alone")
    parser.add_argument("--output", type=Path, help="JSON file for the figures")
    parser.add_argument("--table", action="store_true", help="print the Markdown table")
    parser.add_argument(
        "--speed",
        type=float,
        default=1.0,
        help="share of real time; below 1 by /clock, for machines with other work to do",
    )
    parser.add_argument("--hours", type=float, default=3.0, help="simulated time of the long run; 0: none")
    options = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    results: list[dict[str, Any]] = []
    for fault in options.only or FAULTS:
        with tempfile.TemporaryDirectory() as name:
            result = run(fault, Path(name), options.speed)
        print(json.dumps(dataclasses.asdict(result)), file=sys.stderr, flush=True)
        results.append(dataclasses.asdict(result))
    figures: dict[str, Any] = {"faults": results}
    if options.hours > 0:
        figures["long"] = long_run(options.hours)
    text = table(results) if options.table else json.dumps(figures, indent=1)
    print(text)
    if options.output:
        options.output.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    return 1 if any(r["broken"] for r in results) or figures.get("long", {}).get("invalid") else 0


if __name__ == "__main__":
    sys.exit(main())
