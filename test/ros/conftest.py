"""A live estimator node in its own process, a driver in this one, and everything the node says."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.serialization import deserialize_message
from std_srvs.srv import SetBool, Trigger

from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import decode_pose_stamped, decode_stamp
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped, encode_wrench_stamped
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.ros import qos
from ctr_dynamics.ros.listener import Listener
from ctr_dynamics.ros.node_processes import ESTIMATOR, NodeProcess
from ctr_dynamics.ros.topic_names import message_class

PATIENCE_S = 120.0  # of every wait: nothing is asserted about how long anything takes
ASK_AGAIN_S = 20.0  # of an answer that was lost
BAGS = Path(__file__).parents[1] / "data" / "bags"


class RestingRobot(threading.Thread):
    """Publishes a robot at rest at 100 Hz, stamped now, and a tracker that agrees with the model but for its noise at 20 Hz."""

    def __init__(self, live: Live, shift_ns: int = 0) -> None:
        super().__init__(daemon=True)
        robot = load_robot("till2020_tissue")
        self.names = [f"tube{n}_{kind}" for n in (1, 2) for kind in ("rotation", "translation")]
        rest = zip(robot.rest.alpha.value, robot.rest.beta.value, strict=True)
        self.positions = [x for pair in rest for x in pair]
        self.live = live
        self.joints_on = self.tracker_on = True
        self.tracker_frozen = False  # on: the last pose again and again
        self.turning = 0.0  # rad/s of all tubes together
        self.noise = np.random.default_rng(0)
        self.shift_ns = shift_ns  # of the stamps
        self.joint_stamps: list[int] = []
        profile = qos.profile("best_effort", 50)
        node = live.listener.node
        self.publishers = {
            name: node.create_publisher(message_class(topics.TOPIC[name].ros_type), name, profile)
            for name in (topics.JOINT_STATES, topics.TRACKER_TIP, topics.TIP_LOAD)
        }
        self.stopped = threading.Event()

    def joints(self, stamp_ns: int, names=None, positions=None) -> None:
        data = encode_joint_state(stamp_ns, names or self.names, positions or self.positions)
        self.publishers[topics.JOINT_STATES].publish(data)

    def tracker(self, stamp_ns: int, position, quaternion, frame: str = "ctr_base") -> None:
        self.publishers[topics.TRACKER_TIP].publish(
            encode_pose_stamped(stamp_ns, frame, position, quaternion)
        )

    def load(self, stamp_ns: int, force) -> None:
        data = encode_wrench_stamped(stamp_ns, "ctr_base", force, (0.0, 0.0, 0.0))
        self.publishers[topics.TIP_LOAD].publish(data)

    def turn(self, seconds: float) -> None:
        """Turn all tubes on for that time."""
        for i, name in enumerate(self.names):
            self.positions[i] += self.turning * seconds * name.endswith("rotation")

    def agreeing_pose(self):
        """The model's last tip pose, None before there is one."""
        heard = self.live.listener.received[topics.TIP_POSE_PREDICTED]
        return decode_pose_stamped(heard[-1].data) if heard else None

    def run(self) -> None:
        tick, last = 0, time.time_ns() + self.shift_ns
        while not self.stopped.is_set():
            now = time.time_ns() + self.shift_ns
            self.turn((now - last) * 1e-9)
            last = now
            if self.joints_on:
                self.joint_stamps.append(now)
                self.joints(now)
            pose = self.agreeing_pose()
            if self.tracker_on and pose is not None and tick % 5 == 0:
                if not self.tracker_frozen:
                    noise = self.noise.normal(0.0, (1e-4,) * 3 + (1e-4,) * 4)
                    position = tuple((np.array(pose.position) + noise[:3]).tolist())
                    quaternion = tuple((np.array(pose.quaternion_xyzw) + noise[3:]).tolist())
                self.tracker(now, position, quaternion)
            tick += 1
            self.stopped.wait(0.01)

    def stop(self) -> None:
        self.stopped.set()
        self.join()


class Live:
    """An estimator process with a listener on all its outputs."""

    def __init__(
        self,
        folder: Path,
        parameters: dict,
        ros_arguments=(),
        heard=None,
        reliability="reliable",
        module=ESTIMATOR,
    ) -> None:
        self.managed = module != ESTIMATOR
        self.domain = int(os.environ["ROS_DOMAIN_ID"])
        self.process = NodeProcess(module, parameters, self.domain, folder / "estimator.log", ros_arguments)
        names = heard or [topic.name for topic in topics.OUTPUTS]
        self.listener = Listener(self.domain, names, reliability, depth=5000)
        self.robots: list[RestingRobot] = []

    def __enter__(self) -> Live:
        self.listener.__enter__()
        ready = self.listener.wait_for(
            lambda: self.managed or self.listener.matched() or self.process.code is not None, PATIENCE_S
        )
        if not ready or self.process.code is not None:
            self.process.stop(PATIENCE_S)
            self.listener.__exit__(None, None, None)
            pytest.fail(f"the node did not start\n{self.process.output()}")
        return self

    def __exit__(self, *reason) -> None:
        for robot in self.robots:
            robot.stop()
        code = self.process.stop(PATIENCE_S)
        self.listener.__exit__(None, None, None)
        assert code == 0, self.process.output()

    def resting_robot(
        self, matched: bool = True, shift_ns: int = 0, turning: float = 0.0, joints_on: bool = True
    ) -> RestingRobot:
        robot = RestingRobot(self, shift_ns)
        robot.turning, robot.joints_on = turning, joints_on
        self.robots.append(robot)
        if matched:
            self.wait(lambda: all(p.get_subscription_count() for p in robot.publishers.values()), "a match")
        robot.start()
        return robot

    def wait(self, condition, what: str) -> None:
        ok = self.listener.wait_for(lambda: condition() or self.process.code is not None, PATIENCE_S)
        assert self.process.code is None, f"the node has ended\n{self.process.output()}"
        assert ok, f"waited in vain for {what}\n{self.process.output()}"

    def count(self, topic: str) -> int:
        return self.listener.count(topic)

    def wait_for_more(self, topic: str, number: int = 1) -> None:
        target = self.count(topic) + number
        self.wait(lambda: self.count(topic) >= target, f"{number} more messages on {topic}")

    def stamps(self, topic: str) -> list[int]:
        return [decode_stamp(message.data) for message in list(self.listener.received[topic])]

    def messages(self, topic: str) -> list:
        kind = message_class(topics.TOPIC[topic].ros_type)
        return [deserialize_message(message.data, kind) for message in list(self.listener.received[topic])]

    def valid(self) -> list[bool]:
        return [message.data for message in self.messages(topics.VALID)]

    def status(self, name: str, at: int = -1):
        """The diagnostics status of that name in the message ``at``, by default the last; None before the first."""
        heard = self.listener.received[topics.DIAGNOSTICS]
        if not heard:
            return None
        array = deserialize_message(heard[at].data, message_class(topics.TOPIC[topics.DIAGNOSTICS].ros_type))
        found = [status for status in array.status if status.name == f"ctr_estimator: {name}"]
        assert len(found) == 1, [status.name for status in array.status]
        return found[0]

    def wait_for_status(self, name: str, level: int | None = None, text: str = ""):
        """Wait for the present status of that name, or a later one, to be of that level and to contain the text: none is missed."""
        at = max(0, self.count(topics.DIAGNOSTICS) - 1)

        def there() -> bool:
            nonlocal at
            while at < self.count(topics.DIAGNOSTICS):
                status = self.status(name, at)
                said = status.message + str([(v.key, v.value) for v in status.values])
                if text in said and (level is None or status.level == bytes([level])):
                    return True
                at += 1
            return False

        self.wait(there, f"status {name} at level {level} with '{text}'; it is {self.status(name)}")
        return self.status(name, at)

    def answer(self, ask):
        """The result of the future that `ask` returns. A server whose side has not found the client's reader yet drops its answer
        (rmw_fastrtps: "client will not receive response"), so where none comes, the client asks again."""
        futures = [ask()]
        for _ in range(round(PATIENCE_S / ASK_AGAIN_S)):
            self.listener.wait_for(lambda: futures[-1].done() or self.process.code is not None, ASK_AGAIN_S)
            assert self.process.code is None, f"the node has ended\n{self.process.output()}"
            if futures[-1].done():
                return futures[-1].result()
            futures.append(ask())
        pytest.fail(f"waited in vain for an answer\n{self.process.output()}")

    def call(self, name: str, request):
        kind = SetBool if isinstance(request, SetBool.Request) else Trigger
        client = self.listener.node.create_client(kind, f"/ctr/estimator/{name}")
        self.wait(client.service_is_ready, f"service {name}")
        return self.answer(lambda: client.call_async(request))

    def trigger(self, name: str):
        return self.call(name, Trigger.Request())

    def set_parameter(self, name: str, value):
        client = AsyncParameterClient(self.listener.node, "/ctr/estimator")
        self.wait(client.services_are_ready, "parameter services")
        return self.answer(lambda: client.set_parameters([Parameter(name, value=value)])).results[0]

    def get_parameters(self, names: list[str]):
        client = AsyncParameterClient(self.listener.node, "/ctr/estimator")
        self.wait(client.services_are_ready, "parameter services")
        return self.answer(lambda: client.get_parameters(names)).values


@pytest.fixture
def start(tmp_path):
    """Makes a `Live` with parameters of the node. Outputs may be old: a busy machine holds up what is tested here."""

    def make(parameters: dict | None = None, **options) -> Live:
        return Live(tmp_path, {"output.max_age_s": 30.0, **(parameters or {})}, **options)

    return make


@pytest.fixture
def bags() -> Path:
    return BAGS


@pytest.fixture
def on_grid():
    """Asserts that stamps lie on one grid of 3 ms, rise, and come once."""

    def check(stamps: list[int], t0: int) -> None:
        assert stamps
        steps = np.array(stamps) - t0
        assert not np.any(steps % topics.STEP_NS)
        assert np.all(np.diff(steps) > 0)

    return check
