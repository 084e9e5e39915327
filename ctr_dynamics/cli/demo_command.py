"""`ctr-dynamics demo`: estimator node and driver as two processes over real DDS on this machine; without ROS 2 a replay of the same bag."""

from __future__ import annotations

import json
import math
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.atomic_files import atomic_file, output_folder
from ctr_dynamics.io.bag_reader import RawMessage, open_bag
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import decode_stamp
from ctr_dynamics.io.shipped_bags import shipped_bag, shipped_truth
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime import live_report
from ctr_dynamics.runtime.playback import load

if TYPE_CHECKING:
    from ctr_dynamics.ros.listener import Listener
    from ctr_dynamics.ros.node_processes import NodeProcess

SHORTEST_S = 2.0
"""Of a run, below which its errors say nothing: the start is left out."""
MOST_TOO_OLD = 0.1
"""Share of outputs that were invalid for their age, above which a live run shows the machine and not the robot."""
START_S = 900.0
"""Longest wait for the estimator: the first start compiles every kernel."""


def demo(
    bag: Annotated[Path | None, typer.Option(help="Bag to play; default: the shipped one.")] = None,
    truth: Annotated[Path | None, typer.Option(help="Truth of that bag (.npz), if there is one.")] = None,
    output: Annotated[Path, typer.Option(help="Folder for picture, figures and recorded outputs.")] = Path(
        "demo_output"
    ),
    robot: Annotated[str, typer.Option(help="Robot name or file.")] = "till2020_tissue",
    policy: Annotated[str, typer.Option(help="output.policy: predict or wait.")] = "predict",
    duration: Annotated[float, typer.Option(help="Seconds of the bag to play; 0: all.")] = 0.0,
) -> int:
    """Play a bag as live topics to the estimator node and show how well and how punctually it follows; replay it where there is no ROS 2."""
    console = Console()
    nominal = live_report.nominal_tracker(load_robot(robot))
    Settings({"output.policy": policy})
    if not (duration == 0.0 or SHORTEST_S <= duration < math.inf):
        raise InputError(f"--duration is {duration:g} s", do=f"write {SHORTEST_S:g} s or more, or 0 for all")
    if bag is None:
        bag, truth = shipped_bag(), truth or shipped_truth()
    candidates = live_report.truth_traces(truth) if truth is not None else []
    messages = load(bag, 0.0, duration)
    span_s = (messages[-1].log_ns - messages[0].log_ns) * 1e-9
    if span_s < 0.9 * SHORTEST_S:
        raise InputError(
            f"holds {span_s:.2f} s, {SHORTEST_S:g} s are needed", do="give a longer bag", where=str(bag)
        )
    output_folder(output)
    try:
        import ctr_dynamics.ros.listener  # noqa: F401
    except ImportError as error:
        console.print(f"no ROS 2 here ({error}): the live part is skipped, and {bag} is replayed")
        run = replayed(messages, robot, policy, output / "outputs.mcap")
    else:
        try:
            run = live_run(console, bag, messages, robot, policy, duration)
        except Failed as failure:
            what, log = failure.args
            console.print(f"demo failed: {what}", style="bold red", highlight=False)
            console.print(log, markup=False, highlight=False)
            return 1
        record(output / "outputs.mcap", run.heard)
        show_timing(console, run.timing, len(run.heard[topics.TIP_POSE]))
        if run.timing["too_old"] > MOST_TOO_OLD * run.timing["steps"]:
            console.print(
                f"this machine takes {run.timing['step_ms']['p50']:.1f} ms for a step of 3 ms, so that outputs came too late to be valid: "
                "what follows is a replay of the same bag, which waits for every step",
                style="yellow",
            )
            run = replayed(messages, robot, policy, output / "outputs.mcap")._replace(timing=run.timing)
    bag_start_ns = min(decode_stamp(m.data) for m in messages if m.topic == topics.JOINT_STATES)
    start_ns = bag_start_ns + run.driver.get("shift_ns", 0)
    open_loop = live_report.trace_of(run.heard[topics.TIP_POSE_PREDICTED], start_ns)
    fused = live_report.trace_of(run.heard[topics.TIP_POSE], start_ns)
    tracker = live_report.tracker_trace(bag, bag_start_ns, nominal)
    comparisons = live_report.comparisons(tracker, candidates, open_loop, fused)
    if not comparisons:
        console.print("neither tracker poses nor a truth fall into the run: nothing to compare it with")
    show_errors(console, comparisons)
    shapes = live_report.backbones(run.heard[topics.BACKBONE_STATE], start_ns, 8)
    title = f"{bag.name}, robot {robot}, {'live' if run.driver else 'replayed'}"
    live_report.draw(output / "demo.png", shapes, open_loop, fused, tracker, title)
    figures = {
        "comparisons": [c.as_json() for c in comparisons],
        "timing": run.timing,
        "driver": run.driver,
    }
    with atomic_file(output / "demo.json") as part:
        part.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    console.print(f"picture, figures and recorded outputs are in {output}")
    return 0


class Failed(Exception):
    """What went wrong in a live run, and the end of the log."""


class Run(NamedTuple):
    """What a run gave: messages by topic, the account of its steps, and that of the driver, which is empty for a replay."""

    heard: Mapping[str, list[live_report.Received]]
    timing: dict[str, Any]
    driver: dict[str, Any]


def replayed(messages: Sequence[RawMessage], robot: str, policy: str, output: Path) -> Run:
    """The messages through the estimator without ROS; its outputs are recorded in a file.

    Raises:
        InputError: as :func:`ctr_dynamics.runtime.replay.replay`, or no step is valid.
    """
    from ctr_dynamics.runtime.replay import replay

    with tempfile.TemporaryDirectory(prefix="ctr_demo_") as name:
        part = Path(name) / "played.mcap"
        with write_bag(part, {}) as writer:
            for message in messages:
                writer.write(*message)
        summary = replay(part, robot, {"output.policy": policy}, output).summary
    heard: dict[str, list[live_report.Received]] = defaultdict(list)
    for message in open_bag(output).messages():
        heard[message.topic].append(live_report.Received(message.log_ns, message.data))
    if not heard[topics.TIP_POSE]:
        raise InputError("no step of the replay is valid", do="look at the bag with `ctr-dynamics info`")
    return Run(heard, {key: summary[key] for key in ("steps", "realtime_ratio", "step_ms")}, {})


def live_run(
    console: Console, bag: Path, messages: Sequence[RawMessage], robot: str, policy: str, duration: float
) -> Run:
    """The bag played to a node.

    Raises:
        Failed: a process has ended early, or no tip pose came, and none was too old to be valid.
    """
    from ctr_dynamics.ros.listener import Listener
    from ctr_dynamics.ros.node_processes import DRIVER, ESTIMATOR, NodeProcess, free_domain

    span_s = (messages[-1].log_ns - messages[0].log_ns) * 1e-9
    domain = free_domain()
    with tempfile.TemporaryDirectory(prefix="ctr_demo_") as name:
        folder = Path(name)
        settings = {"robot": robot, "output.policy": policy, "timing_report": str(folder / "timing.json")}
        heard_topics = [topic.name for topic in topics.OUTPUTS]
        with (
            NodeProcess(ESTIMATOR, settings, domain, folder / "estimator.log") as estimator,
            Listener(domain, heard_topics, depth=5000) as listener,
        ):
            with console.status("starting the estimator (its first start compiles for some minutes)"):
                ready = listener.wait_for(lambda: listener.matched() or estimator.code is not None, START_S)
            if not ready or estimator.code is not None:
                raise Failed("the estimator did not start", estimator.output())
            console.print(f"estimator is up on ROS domain {domain}; playing {bag} for {span_s:.1f} s")
            played = {"bag": str(bag), "duration_s": duration, "report": str(folder / "driver.json")}
            with NodeProcess(DRIVER, played, domain, folder / "driver.log") as driver:
                follow(console, driver, listener, span_s)
                if driver.code != 0:
                    raise Failed("the driver failed", driver.output())
            time.sleep(0.3)
            code, log = estimator.stop(), estimator.output()
        if code != 0:
            raise Failed(f"the estimator ended with code {code}", log)
        timing = json.loads((folder / "timing.json").read_text(encoding="utf-8"))
        shift = json.loads((folder / "driver.json").read_text(encoding="utf-8"))
    heard = listener.received
    if not heard[topics.TIP_POSE] and not timing["too_old"]:
        raise Failed(
            f"no tip pose came in {span_s:.1f} s ({len(heard[topics.VALID])} messages on {topics.VALID})",
            log,
        )
    return Run(heard, timing, shift)


def follow(console: Console, driver: NodeProcess, listener: Listener, span_s: float) -> None:
    """Show the progress until the driver has ended."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f}%"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[state]}"),
    )
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("playing", total=span_s, state="waiting for the first step")
        while driver.code is None:
            steps = listener.count(topics.VALID)
            valid = listener.count(topics.TIP_POSE)
            state = f"{steps} steps, {valid} valid" if steps else "waiting for the first step"
            progress.update(task, completed=min(steps * topics.STEP_NS * 1e-9, span_s), state=state)
            time.sleep(0.1)


def record(file: Path, received: Mapping[str, list[live_report.Received]]) -> None:
    """Write what was heard as a bag; log time is the moment of arrival."""
    messages = [(m.arrival_ns, topic, m.data) for topic, heard in received.items() for m in heard]
    with write_bag(file, {"source": "ctr-dynamics demo"}) as writer:
        for arrival_ns, topic, data in sorted(messages):
            writer.write(topic, arrival_ns, data)


def show_errors(console: Console, comparisons: Sequence[live_report.LiveErrors]) -> None:
    """The table of tip errors in mm."""
    if not comparisons:
        return
    errors = Table(title="tip error, 3-D (mm)")
    errors.add_column("run")
    for c in comparisons:
        errors.add_column(f"{c.reference}: rms", justify="right")
        errors.add_column("max", justify="right")
    for run in ("open_loop", "fused"):
        values = [getattr(c, f"{run}_{kind}") for c in comparisons for kind in ("rms", "max")]
        errors.add_row("open loop" if run == "open_loop" else "fused", *(f"{1e3 * v:.2f}" for v in values))
    console.print(errors)


def show_timing(console: Console, timing: dict[str, Any], published: int) -> None:
    """The table of punctuality."""
    steps = Table(title=f"steps of 3 ms, policy {timing['policy']}")
    for name in ("", "p50 (ms)", "p99 (ms)", "max (ms)"):
        steps.add_column(name, justify="right" if name else "left")
    for label, key in (("computing a step", "step_ms"), ("published after it was due", "lateness_ms")):
        steps.add_row(label, *(f"{timing[key][part]:.2f}" for part in ("p50", "p99", "max")))
    console.print(steps)
    console.print(
        f"{published} valid steps heard. Of {timing['steps']} published, {timing['late_over_3ms']} were more "
        f"than 3 ms late, {timing['late_over_20ms']} more than 20 ms; {timing['skipped']} were skipped; "
        f"{timing['start']['steps']} fell into the start."
    )
