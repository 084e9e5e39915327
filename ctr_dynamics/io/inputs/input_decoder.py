"""Messages of the inputs, as they come, to what the estimator takes: one decoder for bags and node."""

from __future__ import annotations

from ctr_dynamics.io.inputs.frame_tree import FrameTree, Quaternion, product
from ctr_dynamics.io.inputs.input_mapping import InputMapping
from ctr_dynamics.io.inputs.joint_readings import JointConverter
from ctr_dynamics.io.messages.cdr import JointStateIn, PoseIn
from ctr_dynamics.io.messages.input_types import (
    TF_MESSAGE,
    TYPES,
    Decoded,
    child_frames,
    decode_input,
    has_stamp,
    names_child,
    own_type,
)
from ctr_dynamics.io.messages.topics import TF_STATIC, TRACKER_TIP, TRANSFORMS

_MOST_FRAMES = 20


class InputDecoder:
    """Decodes the messages of all inputs, in the order of arrival.

    Args:
        mapping: what the lab's messages mean.
        n: number of tubes; 0 where it is not known.

    Attributes:
        joints: the joint states. children: child frames seen on the tracker's topic. frames: transforms that have come.
    """

    def __init__(self, mapping: InputMapping, n: int = 0) -> None:
        self.mapping = mapping
        self.joints = JointConverter(mapping.joints, n)
        self.children: set[str] = set()
        self.frames = FrameTree(mapping.frame_id)
        x, y, z, w = mapping.mount_xyzw
        self._mounted = (x, y, z) != (0.0, 0.0, 0.0)
        self._from_mount: Quaternion = (-x, -y, -z, w)

    def decode(self, topic: str, ros_type: str, encoding: str, data: bytes, log_ns: int) -> list[Decoded]:
        """Values of one message of an input; none where it waits for others, or is about another frame.

        Poses come in the frame of the mapping where the transforms say how. Those that waited for transforms come with them.

        Args:
            topic: of the inputs or the transforms. ros_type: as ROS 2 writes it; empty: the topic's own. encoding: "cdr" or "ros1". log_ns: arrival.

        Raises:
            CdrError: the bytes are not that message.
        """
        if topic in TRANSFORMS:
            self.frames.add(child_frames(ros_type or TF_MESSAGE, encoding, data), topic == TF_STATIC)
            return [*self.frames.released()]
        kind = ros_type or TYPES[topic][0]
        if topic == TRACKER_TIP and names_child(kind):
            values = self._of_child(kind, encoding, data)
        else:
            values = decode_input(kind, encoding, data)
        given: list[Decoded] = [*self.frames.released()]
        for value in values:
            if not has_stamp(kind) or (self.mapping.arrival_stamps and topic == TRACKER_TIP):
                value = value._replace(stamp_ns=log_ns)
            if isinstance(value, JointStateIn):
                given += self.joints.convert(value)
            elif isinstance(value, PoseIn):
                if self._mounted:
                    value = value._replace(quaternion_xyzw=product(value.quaternion_xyzw, self._from_mount))
                given += self.frames.place(value)
            else:
                given.append(value)
        return given

    def _of_child(self, kind: str, encoding: str, data: bytes) -> list[Decoded]:
        """Poses of the sensor's child frame; without its name those of the first that is seen."""
        found = child_frames(kind, encoding, data)
        if own_type(kind) == TF_MESSAGE:  # other frames are in there as well
            self.frames.add(found, static=False)
        for name, _ in found:
            if len(self.children) < _MOST_FRAMES:
                self.children.add(name)
        wanted = self.mapping.child_frame.lstrip("/")
        return [pose for name, pose in found if not wanted or name == wanted]
