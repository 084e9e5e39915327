"""Memory of the estimator over a long run: a bag again and again, its stamps running on, every step encoded as the node does.

Between two passes the joints move back to where the bag begins, and no tracker pose comes. One row a minute of robot time goes to standard
output as a Markdown table: resident memory, steps, invalid steps, and how much faster than real time the minute was. With --live a driver
plays the same to the estimator node over real DDS, which takes as long as it says; the table tells the node's resident memory, and behind it
stands what the node reports of its deadlines.

    python -m studies.long_memory [BAG] --minutes 60 [--live]
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from ctr_dynamics.estimation.estimator import Estimator
from ctr_dynamics.estimation.monitoring.statuses import all_statuses
from ctr_dynamics.io.bag_reader import InputMessage, open_bag
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import JointStateIn, PoseIn, WrenchIn
from ctr_dynamics.io.messages.encode import encode_input
from ctr_dynamics.io.messages.topics import STEP_NS
from ctr_dynamics.io.shipped_bags import shipped_bag
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.step_encoder import StepEncoder
from studies import live_punctuality

RETURN_NS, JOINTS_NS = 2_000_000_000, 10_000_000  # length of the way back, and between its joint states
MINUTE_NS = 60_000_000_000
LIMIT = 0.01  # of the memory after a sixth of the time: growth allowed from there to the end


def endless(bag: Path) -> Iterator[InputMessage]:
    """Messages of the bag in passes; stamps and log times are moved on by the same amount. Between them joints and load are led back."""
    items = [item for item in open_bag(bag).inputs() if item.message.stamp_ns > 0]
    joints = [item.message for item in items if isinstance(item.message, JointStateIn)]
    loads = [item.message for item in items if isinstance(item.message, WrenchIn)]
    first, last = joints[0], joints[-1]
    period = last.stamp_ns - first.stamp_ns + RETURN_NS
    target = dict(zip(first.names, first.positions, strict=True))
    moved = 0

    def between(a: Sequence[float], b: Sequence[float], share: float) -> tuple[float, ...]:
        return tuple((1.0 - share) * x + share * y for x, y in zip(a, b, strict=True))

    while True:
        for item in items:
            message = item.message._replace(stamp_ns=item.message.stamp_ns + moved)
            yield item._replace(log_ns=item.log_ns + moved, message=message)
        for since in range(JOINTS_NS, RETURN_NS, JOINTS_NS):
            share = since / RETURN_NS
            positions = between(last.positions, [target[name] for name in last.names], share)
            stamp = last.stamp_ns + moved + since
            message = last._replace(stamp_ns=stamp, positions=positions)
            yield InputMessage(topics.JOINT_STATES, stamp, message)
            if loads:
                a, b = loads[-1], loads[0]
                force, torque = between(a.force, b.force, share), between(a.torque, b.torque, share)
                yield InputMessage(
                    topics.TIP_LOAD, stamp, a._replace(stamp_ns=stamp, force=force, torque=torque)
                )
        moved += period


def resident_mb(process: int | str = "self") -> float:
    """Resident memory of a process in MB (Linux)."""
    pages = int(Path(f"/proc/{process}/statm").read_text(encoding="utf-8").split()[1])
    return pages * resource.getpagesize() / 1e6


def replayed(bag: Path, robot_name: str, minutes: int) -> list[float]:
    """Memory at the end of every minute of robot time, as fast as this process steps; prints the table."""
    robot, settings = load_robot(robot_name), Settings({"output.policy": "wait"})
    estimator = Estimator(robot, settings)
    encoder = StepEncoder(settings["output.frame_id"], robot.name, settings["output.backbone_every"])
    print("| minute | resident (MB) | steps | invalid | times real time |\n|---|---|---|---|---|", flush=True)
    memory: list[float] = []
    steps = invalid = 0
    begin, end_ns = time.perf_counter(), None
    for item in endless(bag):
        message = item.message
        end_ns = message.stamp_ns + MINUTE_NS if end_ns is None else end_ns
        if isinstance(message, JointStateIn):
            estimator.add_joint_state(message.stamp_ns, message.names, message.positions)
        elif isinstance(message, PoseIn):
            estimator.add_tracker_pose(
                message.stamp_ns, message.position, message.quaternion_xyzw, message.frame_id
            )
        else:
            estimator.add_tip_load(message.stamp_ns, message.force, message.torque, message.frame_id)
        for out in estimator.advance(message.stamp_ns):
            steps += 1
            invalid += not out.valid
            for _ in encoder.encode(out, all_statuses(estimator.health)):
                pass
        if message.stamp_ns >= end_ns:
            memory.append(resident_mb())
            now = time.perf_counter()
            print(
                f"| {len(memory)} | {memory[-1]:.1f} | {steps} | {invalid} | {steps * STEP_NS * 1e-9 / (now - begin):.1f} |",
                flush=True,
            )
            begin, end_ns, steps, invalid = now, end_ns + MINUTE_NS, 0, 0
            if len(memory) == minutes:
                break
    return memory


def live(bag: Path, robot_name: str, minutes: int) -> list[float]:
    """Memory of the estimator node at the end of every minute of a run over DDS; prints the table and the report of the deadlines."""
    print("| minute | resident (MB) |\n|---|---|", flush=True)
    memory: list[float] = []
    begin: float | None = None

    def watch(pid: int) -> None:
        nonlocal begin
        begin = time.monotonic() if begin is None else begin
        if time.monotonic() > begin + 60.0 * (len(memory) + 1):
            memory.append(resident_mb(pid))
            print(f"| {len(memory)} | {memory[-1]:.1f} |", flush=True)

    with tempfile.TemporaryDirectory() as folder:
        long = Path(folder) / "long.mcap"
        with write_bag(long, {}) as writer:
            end_ns = None
            for item in endless(bag):
                end_ns = item.log_ns + minutes * MINUTE_NS if end_ns is None else end_ns
                if item.log_ns > end_ns:
                    break
                writer.write(item.topic, item.log_ns, encode_input(item.message))
        report = live_punctuality.run(long, {"robot": robot_name}, 60.0 * minutes, listen=False, watch=watch)
    print(f"\n{json.dumps(report)}")
    return memory


def main() -> int:
    """Run the benchmark; returns 1 when memory grows by more than the limit."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("bag", nargs="?", type=Path, default=shipped_bag())
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--robot", default="till2020_tissue")
    parser.add_argument(
        "--live", action="store_true", help="the node over DDS, in real time, instead of the library"
    )
    options = parser.parse_args()
    memory = (live if options.live else replayed)(options.bag, options.robot, options.minutes)
    if not memory:
        raise SystemExit("the run ended before its first minute was over")
    settled = memory[len(memory) // 6]
    growth = memory[-1] - settled
    print(f"\ngrowth after minute {len(memory) // 6 + 1}: {growth:+.1f} MB", flush=True)
    return 1 if growth > LIMIT * settled else 0


if __name__ == "__main__":
    sys.exit(main())
