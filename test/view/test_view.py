"""Markers are what rosbags reads back, the server speaks Foxglove's protocol, and the node draws over DDS."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
import threading
import time
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctr_dynamics.cli import main as cli
from ctr_dynamics.estimation.estimator import Estimator
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import CdrError, decode_point_cloud
from ctr_dynamics.io.messages.schemas import typestore
from ctr_dynamics.kernels.rotations import matrix
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.replay import Player
from ctr_dynamics.runtime.step_encoder import StepEncoder
from ctr_dynamics.view.markers import CHI_95, MARKER_ARRAY, TUBES_TOPIC, ellipsoid, encode_tubes, tube_lines
from ctr_dynamics.view.scene import Scene

BAG = Path(__file__).parents[1] / "data" / "bags" / "clean_release.mcap"
ROBOT = load_robot("till2020_tissue")


@pytest.fixture(scope="module")
def step():
    """The serialised messages of one step, by topic, and the step."""
    estimator = Estimator(ROBOT, Settings({"output.policy": "wait"}))
    for out in Player(estimator).play(open_bag(BAG)):
        if out.k == 110:
            return out, {m.topic: m.data for m in StepEncoder().encode(out)}
    raise AssertionError("no step")


def test_point_clouds_come_back(step):
    out, messages = step
    cloud = decode_point_cloud(messages[topics.BACKBONE_STATE])
    assert cloud.names == topics.BACKBONE_FIELDS
    assert cloud.stamp_ns == out.stamp_ns
    np.testing.assert_array_equal(cloud.rows, out.backbone)


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_damaged_point_clouds_are_rejected_or_read(step, data):
    good = step[1][topics.BACKBONE_STATE]
    place = data.draw(st.integers(0, 400))
    bad = bytearray(good[: data.draw(st.integers(0, len(good)))] if data.draw(st.booleans()) else good)
    if place < len(bad):
        bad[place] = data.draw(st.integers(0, 255))
    try:
        cloud = decode_point_cloud(bytes(bad))
    except CdrError:
        return
    assert cloud.rows.shape[1] == len(cloud.names)


def test_markers_are_the_tubes(step):
    out, _ = step
    tip_there = (out.tip_position, out.tip_covariance[:3, :3])
    data = encode_tubes(
        ROBOT, out.stamp_ns, "ctr_base", out.backbone, ROBOT.rest.beta.value, tip_there, 2.0, 5.0
    )
    array = typestore().deserialize_cdr(data, MARKER_ARRAY)
    inner, outer, tip = array.markers
    assert bytes(typestore().serialize_cdr(array, MARKER_ARRAY)) == data
    for marker, tube, beta in zip((inner, outer), ROBOT.tubes, ROBOT.rest.beta.value, strict=True):
        assert (marker.type, marker.action, marker.header.frame_id) == (4, 0, "ctr_base")
        assert marker.scale.x == 2.0 * 2 * tube.outer_radius.value
        points = np.array([(p.x, p.y, p.z) for p in marker.points])
        assert np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1)) == pytest.approx(
            tube.length + beta, rel=5e-3
        )
    assert (inner.color.r, inner.color.g) != (outer.color.r, outer.color.g)
    end = inner.points[-1]
    np.testing.assert_allclose((end.x, end.y, end.z), out.backbone[-1, 1:4], atol=1e-7)
    assert tip.type == 2
    np.testing.assert_allclose(
        (tip.pose.position.x, tip.pose.position.y, tip.pose.position.z), out.tip_position, atol=1e-5
    )


@settings(max_examples=100, deadline=None)
@given(arrays(float, (3, 3), elements=st.floats(-1e-2, 1e-2)))
def test_ellipsoid_holds_the_covariance(root):
    covariance = root @ root.T
    diameters, q = ellipsoid(covariance, 1.0)
    assert np.linalg.norm(q) == pytest.approx(1.0)
    R = matrix(q[[3, 0, 1, 2]])
    np.testing.assert_allclose(R @ np.diag((diameters / 2 / CHI_95) ** 2) @ R.T, covariance, atol=1e-9)


def test_a_tube_pulled_behind_the_plate_is_a_point():
    s, points = np.linspace(0, 0.1, 9), np.linspace([0, 0, 0], [0, 0, 0.1], 9)
    lines = tube_lines(ROBOT, [-0.2521, -ROBOT.tubes[1].length], s, points)
    np.testing.assert_array_equal(lines[1], np.zeros((2, 3)))


def test_scene_keeps_its_rate_and_passes_over_junk(step):
    _, messages = step
    scene = Scene(ROBOT, rate_hz=30.0)
    assert scene.take(topics.TIP_POSE, messages[topics.TIP_POSE]) is None
    _, data = scene.take(topics.BACKBONE_STATE, messages[topics.BACKBONE_STATE])
    assert len(typestore().deserialize_cdr(data, MARKER_ARRAY).markers) == 3
    assert scene.take(topics.BACKBONE_STATE, messages[topics.BACKBONE_STATE]) is None  # the same stamp again
    for topic in (topics.TIP_POSE, topics.JOINT_STATES, topics.BACKBONE_STATE):
        for cut in (0, 3, 11, 60, 200):
            assert Scene(ROBOT).take(topic, messages.get(topic, b"")[:cut]) is None


class Client:
    """As much of a WebSocket client as the test needs (RFC 6455)."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=30)
        key = base64.b64encode(os.urandom(16)).decode()
        self.socket.sendall(
            (
                f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
            ).encode()
        )
        self.stream = self.socket.makefile("rb")
        assert b"101" in self.stream.readline()
        while self.stream.readline().strip():
            pass

    def send(self, message: dict) -> None:
        data, mask = json.dumps(message).encode(), os.urandom(4)
        masked = bytes(b ^ mask[i % 4] for i, b in enumerate(data))
        self.socket.sendall(bytes([0x81, 0xFE]) + struct.pack(">H", len(data)) + mask + masked)

    def receive(self) -> tuple[int, bytes]:
        opcode, length = self.stream.read(2)
        if length == 126:
            (length,) = struct.unpack(">H", self.stream.read(2))
        elif length == 127:
            (length,) = struct.unpack(">Q", self.stream.read(8))
        return opcode & 15, self.stream.read(length)


def test_view_serves_a_bag_to_foxglove(monkeypatch):
    pytest.importorskip("foxglove")
    from ctr_dynamics.view import server as module

    started = threading.Event()
    ports = []
    original = module.ViewServer.__init__

    def noted(self, *arguments, **options):
        original(self, *arguments, **options)
        ports.append(self.port)
        started.set()

    monkeypatch.setattr(module.ViewServer, "__init__", noted)
    codes = []
    command = ["view", str(BAG), "--port", "0", "--once", "--speed", "1"]
    thread = threading.Thread(target=lambda: codes.append(cli.main(command)), daemon=True)
    thread.start()
    assert started.wait(120)
    client = Client(ports[0])
    channels, seen = {}, {}
    wanted = {TUBES_TOPIC, topics.TIP_POSE, topics.JOINT_STATES}
    while not wanted <= set(seen):
        opcode, data = client.receive()
        if opcode == 1:
            message = json.loads(data)
            if message["op"] == "advertise":
                new = {c["id"]: c for c in message["channels"]}
                channels |= new
                client.send({"op": "subscribe", "subscriptions": [{"id": i, "channelId": i} for i in new]})
        elif opcode == 2 and data[0] == 1:
            number, _ = struct.unpack_from("<IQ", data, 1)
            seen[channels[number]["topic"]] = (channels[number], data[13:])
    client.stream.close()
    client.socket.close()
    channel, data = seen[TUBES_TOPIC]
    assert (channel["encoding"], channel["schemaName"], channel["schemaEncoding"]) == (
        "cdr",
        MARKER_ARRAY,
        "ros2msg",
    )
    assert len(typestore().deserialize_cdr(data, MARKER_ARRAY).markers) >= 2
    assert {c["topic"] for c in channels.values()} == {*topics.TOPIC, TUBES_TOPIC}
    thread.join(120)
    assert codes == [0]


def test_view_of_a_bag_that_gives_no_step_says_so(capsys):
    pytest.importorskip("foxglove")
    assert cli.main(["view", str(BAG), "--robot", "three_tube", "--port", "0"]) == 2
    assert "no step was possible" in capsys.readouterr().err


@pytest.mark.parametrize("speed", ["-1", "nan", "inf"])
def test_view_at_a_speed_that_is_none_is_rejected(capsys, speed):
    assert cli.main(["view", str(BAG), f"--speed={speed}", "--port", "0"]) == 2
    assert f"--speed is {speed}" in capsys.readouterr().err


def test_view_listens_on_this_machine_only(capsys):
    pytest.importorskip("foxglove")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert cli.main(["view", str(BAG), "--port", str(port), "--once"]) == 2
    assert f"cannot listen at 127.0.0.1:{port}" in capsys.readouterr().err


def test_layouts_show_topics_that_exist():
    folder = resources.files("ctr_dynamics") / "config" / "view"
    layout = json.loads((folder / "foxglove.json").read_text())
    known = {*topics.TOPIC, TUBES_TOPIC}
    panels = layout["configById"]
    assert set(panels["3D!robot"]["topics"]) <= known
    for panel in panels.values():
        for path in [p["value"] for p in panel.get("paths", [])] + (
            [panel["path"]] if "path" in panel else []
        ):
            assert any(path.startswith(f"{topic}.") for topic in known), path

    def names(node):
        return {node} if isinstance(node, str) else names(node["first"]) | names(node["second"])

    assert names(layout["layout"]) == set(panels)
    rviz = yaml.safe_load((folder / "robot.rviz").read_text())
    shown = [d["Topic"]["Value"] for d in rviz["Visualization Manager"]["Displays"] if "Topic" in d]
    assert set(shown) <= known
    assert TUBES_TOPIC in shown


@pytest.mark.ros
def test_node_draws_what_the_estimator_says(step, tmp_path):
    pytest.importorskip("rclpy")
    from ctr_dynamics.ros import qos
    from ctr_dynamics.ros.listener import Listener
    from ctr_dynamics.ros.node_processes import NodeProcess
    from ctr_dynamics.ros.topic_names import message_class

    out, _ = step
    domain = int(os.environ["ROS_DOMAIN_ID"])
    names = (topics.TIP_POSE, topics.BACKBONE_STATE)
    with (
        NodeProcess("ctr_dynamics.ros.view_node", {"rate_hz": 1000.0}, domain, tmp_path / "view.log") as view,
        Listener(domain, [], name="test_view") as listener,
    ):
        pictures = []
        node = listener.node
        node.create_subscription(
            message_class(MARKER_ARRAY), TUBES_TOPIC, pictures.append, qos.profile("reliable", 50), raw=True
        )
        outputs = {
            n: node.create_publisher(message_class(topics.TOPIC[n].ros_type), n, qos.profile("reliable", 10))
            for n in names
        }
        assert listener.wait_for(
            lambda: all(p.get_subscription_count() for p in outputs.values()) or view.code is not None, 60
        )
        deadline = time.monotonic() + 60
        sent, encoder = 0, StepEncoder()
        while not pictures and time.monotonic() < deadline:
            # of a stamp of its own each time: one stamp is drawn once, and the first picture may find nobody who listens yet
            sent += 1
            messages = {
                m.topic: m.data for m in encoder.encode(out._replace(stamp_ns=out.stamp_ns + sent * 10**8))
            }
            for name in names:
                outputs[name].publish(messages[name])
            time.sleep(0.1)
        assert pictures, view.output()
        assert len(typestore().deserialize_cdr(pictures[0], MARKER_ARRAY).markers) in (2, 3)
    assert view.code == 0
