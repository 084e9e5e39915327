"""The estimator as a ROS 2 node: topics in, topics out, services, parameters, diagnostics, recording."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.clock import JumpHandle, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.logging import get_logging_directory
from rclpy.parameter import Parameter as RosParameter
from std_srvs.srv import SetBool, Trigger

from ctr_dynamics import __version__
from ctr_dynamics.errors import InputError
from ctr_dynamics.estimation.estimator import Estimator
from ctr_dynamics.estimation.monitoring.statuses import all_statuses, snap_ahead
from ctr_dynamics.estimation.step_output import StepOutput
from ctr_dynamics.io.atomic_files import atomic_file, check_targets
from ctr_dynamics.io.bag_writer import LiveRecorder
from ctr_dynamics.io.inputs.input_decoder import InputDecoder
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import (
    CdrError,
    JointStateIn,
    PoseIn,
    WrenchIn,
)
from ctr_dynamics.parameters import Settings, input_mapping
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.ros import qos, transform_topics
from ctr_dynamics.ros.input_subscriptions import InputSubscriptions
from ctr_dynamics.ros.node_runner import Stopped, run_in_thread, run_node
from ctr_dynamics.ros.parameter_declaration import TableNode, declare, watch
from ctr_dynamics.ros.publishers import Outputs
from ctr_dynamics.ros.topic_names import NAME, NAMESPACE, hardware_id, message_class, node_topic
from ctr_dynamics.runtime import node_diagnostics
from ctr_dynamics.runtime.input_gate import InputGate
from ctr_dynamics.runtime.memory import keep_memory
from ctr_dynamics.runtime.recorder import Recorded, Recorder
from ctr_dynamics.runtime.ring_buffer_recording import RingBufferRecording
from ctr_dynamics.runtime.step_encoder import StepEncoder
from ctr_dynamics.runtime.step_loop import Clock, StepLoop
from ctr_dynamics.runtime.timing import StepTiming
from ctr_dynamics.runtime.transform_encoder import transform_encoder
from ctr_dynamics.runtime.warm_up import warm_up
from ctr_dynamics.sensing.tracker_parameters import with_robot_file

DIAGNOSTICS_NS = 500_000_000
DIAGNOSTICS_WAIT_NS = 100_000_000  # how long they wait for time between steps
# A thread that wants the interpreter gets it after this long; the default of 5 ms is longer than a step.
SWITCH_INTERVAL_S = 1e-4


class EstimatorNode(TableNode):
    """Node `/ctr/estimator`. The executor only queues what arrives; a thread of its own takes the steps.

    Raises:
        InputError: a parameter or the robot file cannot be used.
        Stopped: `stop` was set while the kernels were compiled.
    """

    def __init__(self, stop: threading.Event) -> None:
        super().__init__(NAME, NAMESPACE)
        self._stop = stop
        self.settings = declare(self)
        self.start_up()

    # Start, in the stages of a managed node.

    def start_up(self) -> None:
        """Everything that is to be done before callbacks are served."""
        try:
            self.set_up()
        except Stopped:
            self.destroy_node()  # so that others hear of the end
            raise
        self.begin()

    def set_up(self) -> None:
        """Make everything that `begin` starts; raises as the class says."""
        self._robot = load_robot(self.settings["robot"])
        written = ("timing_report", "record.rolling_path", "record.path")
        check_targets({name: self.settings[name] for name in written}, {"robot file": self._robot.source})
        transforms = transform_encoder(self.settings, self._robot)
        frames = transform_topics.publisher(self, transforms)
        self._estimator = run_in_thread(self._warm_estimator, self._stop)
        self._gate = InputGate(self._estimator)
        self._decoder = self._new_decoder(self.settings)
        self._prepared: tuple[Settings, set[str], Estimator | None] | None = None
        self._use_sim_time = bool(self.get_parameter("use_sim_time").value)

        self.timing = StepTiming(
            self.settings["output.policy"], round(self.settings["input_timeout_s"] * 1e9)
        )
        self.ring_buffer = self._open_ring_buffer()
        self.recorder = self._open_recorder()
        self._qos_faults = qos.QosFaults()
        self._undecodable: dict[str, tuple[int, str]] = {}
        self._next_diagnostics_ns = 0
        self._shown: tuple[bool | None, bool] | None = (
            None  # validity and warning of a snap as last published
        )
        self.outputs = Outputs(
            self,
            qos.profile(self.settings["qos.publisher_reliability"], self.settings["qos.publisher_depth"]),
            self._qos_faults,
            StepEncoder(
                self.settings["output.frame_id"],
                hardware_id(self._robot.name, self.get_fully_qualified_name()),
                self.settings["output.backbone_every"],
                transforms,
            ),
            self.recorder.put if self.recorder else None,
            frames,
        )
        self._jumps: JumpHandle | None = None  # of the clock
        self._now_ns = self._clock_source()
        self.loop = self._new_loop()
        self._unwatch = watch(self, lambda: self.settings, self._prepare, self._apply)

    def begin(self) -> None:
        """Start stepping, offer the services and listen to the inputs."""
        self._offered = [
            self.create_service(Trigger, "~/reset", self._on_reset),
            self.create_service(Trigger, "~/save_snapshot", self._on_save_snapshot),
            self.create_service(SetBool, "~/enable_fusion", self._on_enable_fusion),
        ]
        self._inputs = InputSubscriptions(self, self._subscribe)
        self._transforms = transform_topics.subscribe(self, self._taker)
        self.loop.start()
        self.get_logger().info(
            f"robot '{self._robot.name}', policy '{self.timing.policy}', waiting for {self._inputs.names[topics.JOINT_STATES]}"
        )

    def _new_loop(self) -> StepLoop:
        return StepLoop(
            self._estimator,
            self._publish,
            self._housekeeping,
            Clock(self._now_ns, wall=not self._use_sim_time),
            self.timing,
            self.get_logger().error,
            prefetch=self._prefetch,
            max_age_ns=round(self.settings["output.max_age_s"] * 1e9),
        )

    def _warm_estimator(self) -> Estimator:
        self.get_logger().info("compiling the kernels (seconds with a filled cache, minutes without)")
        begin = time.perf_counter()
        warm_up(self._robot, self.settings)
        self.get_logger().info(f"kernels ready after {time.perf_counter() - begin:.1f} s")
        return Estimator(self._robot, self.settings)

    def _open_recorder(self) -> Recorder | None:
        path = self.settings["record.path"]
        return Recorder(LiveRecorder(path, self._provenance()), self.get_logger().error) if path else None

    def _open_ring_buffer(self) -> RingBufferRecording | None:
        seconds = self.settings["record.rolling_s"]
        if not seconds:
            return None
        path = self.settings["record.rolling_path"]
        if not path:
            folder = Path(get_logging_directory())
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / "ctr_estimator_rolling.mcap"
        return RingBufferRecording(
            path, seconds, self.settings["robot"], self._provenance(), self.get_logger().warning
        )

    def _provenance(self) -> dict[str, str]:
        return {
            "version": __version__,
            "robot": self._robot.name,
            "robot_sha256": self._robot.sha256,
            "parameters": json.dumps(self.settings.as_dict()),
        }

    def _clock_source(self) -> Callable[[], int]:
        """Current time of the clock that stamps the messages."""
        if not self._use_sim_time:
            return time.time_ns  # what the node's clock reads, without the objects around it
        clock = self.get_clock()
        threshold = JumpThreshold(
            min_forward=Duration(nanoseconds=1), min_backward=Duration(nanoseconds=-1), on_clock_change=True
        )
        self._jumps = clock.create_jump_callback(threshold, post_callback=self._on_clock)
        return lambda: int(clock.now().nanoseconds)

    def _taker(self, topic: topics.Topic) -> Callable[[bytes], None]:
        """Callback of the subscription to a topic."""
        loop, now_ns, record, ring_buffer = self.loop, self._now_ns, self.recorder, self.ring_buffer

        def arrived(data: bytes) -> None:
            arrival_ns = now_ns()
            loop.offer(partial(self._take, topic, data, arrival_ns), len(data))
            message = Recorded(topic.name, arrival_ns, data, topic.ros_type)
            if record is not None:
                record.put(message)
            if ring_buffer is not None:
                ring_buffer.put(message)

        return arrived

    def _subscribe(self, topic: topics.Topic) -> Any:
        return self.create_subscription(
            message_class(topic.ros_type),
            node_topic(topic.name),
            self._taker(topic),
            qos.profile(
                self.settings["qos.subscription_reliability"], self.settings["qos.subscription_depth"]
            ),
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=self._qos_faults.subscription(topic.name)
            ),
        )

    # In the stepping thread.

    def _take(self, topic: topics.Topic, data: bytes, arrival_ns: int) -> None:
        try:
            values = self._decoder.decode(topic.name, topic.ros_type, "cdr", data, arrival_ns)
        except CdrError as error:
            self._note_undecodable(topic.name, error)
            return
        for value in values:
            if isinstance(value, JointStateIn):
                self._take_joints(value, arrival_ns)
            elif isinstance(value, PoseIn):
                self._take_tracker(value, arrival_ns)
            else:
                self._take_load(value, arrival_ns)

    def _take_joints(self, message: JointStateIn, arrival_ns: int) -> None:
        if surplus := self._decoder.joints.surplus:
            self._estimator.health.note("joints", "more tubes than the robot", surplus)
        given = self._gate.joint_state(message, arrival_ns)
        if given is None:
            return
        if arrival_ns <= 0:  # before the first /clock: the arrival tells nothing of the stamps' clock
            self._estimator.add_joint_state(given.stamp_ns, given.names, given.positions)
            return
        clock = self.loop.clock_offset
        if not clock.sample(given.stamp_ns, arrival_ns):
            rejection = clock.rejection(given.stamp_ns, arrival_ns)
            self._estimator.health.note("joints", "far ahead", rejection)
            return
        self.timing.arrived(given.stamp_ns, clock.at(arrival_ns))
        self._estimator.add_joint_state(given.stamp_ns, given.names, given.positions)

    def _take_tracker(self, message: PoseIn, arrival_ns: int) -> None:
        self._gate.give_pose(message, arrival_ns)

    def _take_load(self, message: WrenchIn, arrival_ns: int) -> None:
        load = self._gate.load(message, arrival_ns)
        if load is not None:
            self._estimator.add_tip_load(load.stamp_ns, load.force, load.torque, load.frame_id)

    def _note_undecodable(self, topic: str, error: CdrError) -> None:
        count, _ = self._undecodable.get(topic, (0, ""))
        self._undecodable[topic] = (count + 1, str(error))

    def _publish(self, out: StepOutput, by_now: Callable[[StepOutput], StepOutput]) -> bool:
        sent = self.outputs.step(out, by_now)
        if sent and not self.outputs.valid:
            self._estimator.health.problem = self.outputs.reason  # also where it has come too late
        return sent

    def _prefetch(self) -> None:
        self._estimator.prefetch()
        self.outputs.prefetch()

    def _housekeeping(self, now_ns: int, idle: bool) -> None:
        """Diagnostics, at once when validity or the warning of a snap has changed and else at 2 Hz of the wall clock."""
        monotonic_ns = time.monotonic_ns()
        if self.ring_buffer is not None:
            self.ring_buffer.alarm(self._estimator.health.inconsistent, monotonic_ns)
        before, now = self._shown, (self.outputs.valid, snap_ahead(self._estimator.health))
        due_ns = self._next_diagnostics_ns + (0 if idle else DIAGNOSTICS_WAIT_NS)
        if now == before and monotonic_ns < due_ns:
            return
        self._next_diagnostics_ns = monotonic_ns + DIAGNOSTICS_NS
        self._shown = now
        if before is None or self.outputs.valid != before[0]:
            if self.outputs.valid:
                self.get_logger().info("outputs are valid")
            else:
                self.get_logger().warning(f"outputs are invalid: {self.outputs.reason}")
        self.outputs.diagnostics(max(now_ns, 0), self._statuses(now_ns))

    def _statuses(self, now_ns: int) -> list[Any]:
        health = all_statuses(self._estimator.health)
        if self.ring_buffer is not None:
            health = [self.ring_buffer.describe(s) if s.name == "misfit" else s for s in health]
        return [
            *health,
            node_diagnostics.timing_status(
                self.timing, self.loop.faults, self.loop.last_fault, self.outputs.stamps.behind_ns
            ),
            node_diagnostics.clock_status(
                self.loop.clock_offset,
                now_ns,
                self._use_sim_time,
                self.timing.input_timeout_ns if self.timing.policy == "predict" else None,
            ),
            node_diagnostics.topics_status(self._qos_faults.by_topic, self._undecodable, self.loop.rejected),
            self._inputs.status,
        ]

    # In the executor.

    def _on_clock(self, jump: TimeJump) -> None:
        if jump.delta.nanoseconds < 0:
            self.loop.put(self._clock_went_back)
        else:
            self.loop.wake()

    def _reset(self) -> None:
        self.loop.reset()
        self.outputs.stamps.let_go_back()

    def _clock_went_back(self) -> None:
        self.loop.reset()
        self.outputs.stamps.forget()

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._answer(
            response,
            lambda: self.loop.call(self._reset),
            lambda _: "the estimator reinitialises at the next complete joint state",
        )

    def _on_save_snapshot(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._answer(response, self._save_snapshot, lambda path: f"saved {path}")

    def _on_enable_fusion(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        return self._answer(
            response,
            lambda: self._set_fusion(bool(request.data)),
            lambda _: f"fusion is {'on' if request.data else 'off'}",
        )

    @staticmethod
    def _answer(response: Any, action: Callable[[], Any], text: Callable[[Any], str]) -> Any:
        try:
            response.message = text(action())
            response.success = True
        except (OSError, TimeoutError, InputError) as error:
            response.message = str(error)
            response.success = False
        return response

    def _set_fusion(self, on: bool) -> None:
        result = self.set_parameters([RosParameter("filter.enabled", value=on)])[0]
        if not result.successful:
            raise InputError(result.reason)

    def _save_snapshot(self) -> Path:
        snapshot = self.loop.call(self._estimator.snapshot)
        if self.ring_buffer is not None:
            self.ring_buffer.save("snapshot saved")
        folder = Path(get_logging_directory())
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"ctr_estimator_{time.time_ns()}.json"
        content = {
            "version": __version__,
            "robot": self._robot.name,
            "robot_sha256": self._robot.sha256,
            "parameters": self.settings.as_dict(),
            "timing": self.timing.report(),
            "estimator": snapshot,
        }
        with path.open("w", encoding="utf-8") as file:
            json.dump(content, file)  # piece by piece: dumps() would hold up the stepping thread
        return path

    def _new_decoder(self, settings: Settings) -> InputDecoder:
        return InputDecoder(input_mapping(with_robot_file(settings, self._robot)), self._robot.n_tubes)

    def _prepare(self, settings: Settings, changes: set[str]) -> None:
        """Reject parameters that cannot be used; where a new estimator is needed, make it here."""
        self._new_decoder(settings)  # names and numbers of joints for so many tubes
        fresh = Estimator(self._robot, settings) if changes - {"filter.enabled"} else None
        self._prepared = (settings, changes, fresh)

    def _apply(self) -> None:
        if self._prepared is None:
            return
        settings, changes, fresh = self._prepared
        self._prepared = None
        self.settings = settings
        if fresh is not None:
            self.loop.put(partial(self._swap, fresh, settings))
            self.get_logger().info(f"{', '.join(sorted(changes))} changed: the estimator reinitialises")
        elif "filter.enabled" in changes:
            self.loop.put(lambda: self._estimator.set_fusion(settings["filter.enabled"]))

    def _swap(self, estimator: Estimator, settings: Settings) -> None:
        estimator.carry_load(self._estimator)
        self._estimator = estimator
        self._gate = InputGate(estimator)
        fresh = self._new_decoder(settings)
        fresh.frames.take_over(self._decoder.frames)
        self._decoder = fresh
        self.timing.policy = settings["output.policy"]
        self.loop.max_age_ns = round(settings["output.max_age_s"] * 1e9)
        self.timing.input_timeout_ns = round(settings["input_timeout_s"] * 1e9)
        self.loop.swap(estimator)

    # End.

    def end(self) -> None:
        """Stop what `begin` has started."""
        self.loop.stop()
        self.loop.join()
        self._inputs.close()
        for subscription in self._transforms:
            self.destroy_subscription(subscription)
        for service in self._offered:
            self.destroy_service(service)

    def take_down(self) -> None:
        """Finish the recording, write the timing report, take the outputs away."""
        self._unwatch()
        if self._jumps is not None:
            self._jumps.unregister()
        if self.recorder is not None:
            self.recorder.close()
        if self.ring_buffer is not None:
            self.ring_buffer.close(self._estimator.health.inconsistent)
        path = self.settings["timing_report"]
        try:
            if path:
                with atomic_file(Path(path)) as part:
                    part.write_text(json.dumps(self.timing.report(), indent=1), encoding="utf-8")
        except InputError as error:
            self.get_logger().error(f"the timing report could not be written: {error}")
        self.outputs.close()

    def close(self) -> None:
        """End everything and destroy the node."""
        self.end()
        self.take_down()
        self.destroy_node()


def main(args: list[str] | None = None, kind: type[EstimatorNode] = EstimatorNode) -> int:
    """Run a node of that ``kind``; returns 0 after SIGINT or SIGTERM, 2 when it cannot start with what it was given."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    keep_memory()
    return run_node("estimator", kind, kind.close, args)


if __name__ == "__main__":
    sys.exit(main())
