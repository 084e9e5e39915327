"""`ctr-dynamics view`: a bag through the estimator, or the live topics, shown in Foxglove."""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from ctr_dynamics.cli.recording_options import Assignments, Params, Remap, open_with
from ctr_dynamics.cli.replay_command import settings_for_replay
from ctr_dynamics.errors import InputError
from ctr_dynamics.estimation.monitoring.statuses import all_statuses, snap_ahead
from ctr_dynamics.io.bag_reader import Bag
from ctr_dynamics.parameters import Settings, input_mapping
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.joint_rate import with_joint_rate
from ctr_dynamics.runtime.step_encoder import StepEncoder
from ctr_dynamics.runtime.transform_encoder import transform_encoder
from ctr_dynamics.sensing.tracker_parameters import with_robot_file
from ctr_dynamics.view.server import Pace, ViewServer

LAYOUT = "ctr_dynamics/config/view/foxglove.json"


def view(
    bag: Annotated[
        Path | None,
        typer.Argument(metavar="[BAG]", help="A bag to replay; without it the live topics are shown."),
    ] = None,
    robot: Annotated[
        str, typer.Option("--robot", metavar="NAME_OR_FILE", help="A shipped robot or a robot file.")
    ] = "till2020_tissue",
    remap: Remap = None,
    params: Params = None,
    assignments: Assignments = None,
    speed: Annotated[
        float, typer.Option("--speed", metavar="X", help="Times real time; 0: as fast as it goes.")
    ] = 1.0,
    host: Annotated[
        str,
        typer.Option("--host", metavar="ADDRESS", help="Address to listen at; only this machine by default."),
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", metavar="N", help="Port to listen at; 0: a free one.")
    ] = 8765,
    once: Annotated[
        bool, typer.Option("--once", help="End with the bag instead of playing it again.")
    ] = False,
) -> int:
    """Serve a bag or the live topics to Foxglove.

    Open Foxglove, "Open connection", ws://127.0.0.1:8765, and import the layout that the command names.
    Ends with Ctrl-C.
    """
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port} is outside 0 to 65535", do="8765 is Foxglove's own")
    if not 0.0 <= speed < math.inf:
        raise InputError(f"--speed is {speed:g}", do="write a number above 0, or 0 for as fast as it goes")
    loaded = load_robot(robot)
    settings = settings_for_replay(params, assignments or [], True)
    if bag is not None:
        open_with(bag, settings, remap).check_inputs()
    server = ViewServer(loaded, host, port)
    print(f"serving ws://{host}:{server.port}; layout: {LAYOUT}", flush=True)
    try:
        if bag is None:
            _live(server)
        else:
            while True:
                _replay(server, open_with(bag, settings, remap), loaded, settings, speed)
                if once:
                    break
    except KeyboardInterrupt:
        print(f"{server.messages} messages were served", file=sys.stderr)
    finally:
        server.close()
    return 0


def _replay(server: ViewServer, opened: Bag, robot: Robot, settings: Settings, speed: float) -> None:
    """Inputs and the estimator's outputs of a bag, at the pace of their stamps."""
    from ctr_dynamics.estimation.estimator import Estimator
    from ctr_dynamics.runtime.replay import Player, no_step

    settings = with_robot_file(settings, robot)
    opened.read_for(robot.n_tubes, input_mapping(settings).mount_xyzw)
    settings, _ = with_joint_rate(opened, settings)
    estimator = Estimator(robot, settings)
    encoder = StepEncoder(
        settings["output.frame_id"],
        robot.name,
        settings["output.backbone_every"],
        transform_encoder(settings, robot),
    )
    inputs = opened.standard_messages()
    pending = next(inputs, None)
    pace = Pace(speed)
    player = Player(estimator)
    for out in player.play(opened):
        pace.wait(out.stamp_ns)
        while pending is not None and pending.log_ns <= out.stamp_ns:
            server.put(pending.topic, pending.log_ns, pending.data)
            pending = next(inputs, None)
        for message in encoder.encode(
            out, lambda: all_statuses(estimator.health), snap_ahead(estimator.health)
        ):
            server.put(message.topic, message.stamp_ns, message.data)
    if not estimator.health.steps:
        raise no_step(opened, robot, player.joint_names, estimator.summary()["input_problems"]["joints"])


def _live(server: ViewServer) -> None:
    """Every topic of the table as it comes over DDS."""
    try:
        from ctr_dynamics.ros.live_view import LiveTopics
    except ImportError as error:
        raise InputError(
            f"the live view needs rclpy ({error})",
            do="source ROS 2, pip install 'ctr_dynamics[ros]', or give a bag",
        ) from None
    with LiveTopics(server.put):
        while True:
            time.sleep(0.5)
