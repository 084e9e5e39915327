"""How a lab's own topics, names, frames and units are those of the estimator: what commands and node are told, and what follows from it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.inputs.joint_readings import JointReadings
from ctr_dynamics.io.messages.input_types import TF_MESSAGE, TYPES, accepts_type, own_type
from ctr_dynamics.io.messages.topics import JOINT_STATES, TF, TRACKER_TIP
from ctr_dynamics.io.storage.stored_file import StoredTopic

ENCODINGS = ("cdr", "ros1")


@dataclass(frozen=True)
class InputMapping:
    """What turns recorded or received messages into the estimator's inputs.

    Attributes:
        remap: topic of the bag to the product's.
        joints: names, scales and offsets of the joint readings.
        child_frame: child frame of the sensor, in messages that name one; empty: the only one there is.
        mount_xyzw: orientation of the sensor in the tip frame, unit quaternion in ROS order.
        arrival_stamps: whether a pose counts as measured when it came, whatever its header says.
        frame_id: the frame that poses are brought into by the recorded transforms; empty: they are left as they are.
    """

    remap: Mapping[str, str] = field(default_factory=dict)
    joints: JointReadings = field(default_factory=JointReadings)
    child_frame: str = ""
    mount_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    arrival_stamps: bool = False
    frame_id: str = ""


def parse_remap(texts: Iterable[str]) -> dict[str, str]:
    """``FROM:=TO`` texts of a command line: topic of the bag to the product's.

    Raises:
        InputError: no ``:=``, TO is no input, or one of them is given twice.
    """
    found: dict[str, str] = {}
    for text in texts:
        source, sign, target = (part.strip() for part in text.partition(":="))
        source, target = _absolute(source), _absolute(target)
        if not sign or source == "/" or target == "/":
            raise InputError(
                f"'{text}' is not FROM:=TO", do=f"write for example --remap /aurora/pose:={TRACKER_TIP}"
            )
        if target not in TYPES:
            raise InputError(
                f"'{target}' is not a topic of the estimator's inputs", do=f"write one of {', '.join(TYPES)}"
            )
        if source in found or target in found.values():
            raise InputError(
                f"'{source if source in found else target}' is remapped twice", do="give it once"
            )
        found[source] = target
    return found


def _absolute(topic: str) -> str:
    return topic if topic.startswith("/") else f"/{topic}"


def topic_names(topics: Sequence[StoredTopic], mapping: InputMapping, where: str) -> dict[str, str]:
    """The name that every topic of a bag is given; those are missing that give way to a remapped one.

    A tracker that is only in ``/tf`` is found by the name of its child frame.

    Raises:
        InputError: a remapped topic is not in the bag.
    """
    own = {topic.name for topic in topics}
    remap = dict(mapping.remap)
    for source in remap:
        if source not in own:
            raise InputError(
                f"no topic {source} to remap; the bag holds {listed(topics)}",
                where=where,
                do="check its name",
            )
    if mapping.child_frame and TRACKER_TIP not in own and TRACKER_TIP not in remap.values() and TF in own:
        remap[TF] = TRACKER_TIP
    taken = set(remap.values())
    return {name: remap.get(name, name) for name in own if name in remap or name not in taken}


def listed(topics: Sequence[StoredTopic]) -> str:
    """Topics and their types in words."""
    kinds: dict[str, str] = {}
    for topic in topics:
        kinds.setdefault(topic.name, f"{topic.name} ({topic.ros_type or 'no type'})")
    return ", ".join([kinds[name] for name in sorted(kinds)][:8]) or "no topics at all"


def cure(topic: str, topics: Sequence[StoredTopic]) -> str:
    """What to do where ``topic`` is not in a bag: the topics of its types that may be it, as options."""
    fitting = sorted(
        {t.name for t in topics if accepts_type(topic, t.ros_type) and t.messages and t.name not in TYPES}
    )
    if not fitting:
        return f"record it as one of {', '.join(TYPES[topic])}"
    options = [f"--remap {name}:={topic}" for name in fitting[:4] if name != TF]
    text = f"if {topic.removeprefix('/ctr/')} has another name: {' or '.join(options)}" if options else ""
    if topic == TRACKER_TIP and any(t.name in fitting and own_type(t.ros_type) == TF_MESSAGE for t in topics):
        text += f"{'; ' if options else ''}if it is a transform: --set tracker.child_frame_id=NAME, of a child frame that `info` lists"
    if topic == JOINT_STATES and any("MultiArray" in t.ros_type for t in topics if t.name in fitting):
        text += ", with joints.rotation_names and joints.translation_names for an array"
    return text


def check_topic(path: Path, name: str, found: Sequence[StoredTopic], stored: Sequence[StoredTopic]) -> None:
    """Check that messages of the input ``name`` can be read; of several types one is enough.

    Args:
        path: of the bag. found: channels of that topic. stored: all channels.

    Raises:
        InputError: none has a type and an encoding that are read.
    """
    usable = [t for t in found if not t.ros_type or accepts_type(name, t.ros_type)]
    if found and not usable:
        first = found[0]
        title = f"topic {first.name}" + (f" (for {name})" if first.name != name else "")
        others = cure(name, [t for t in stored if t.name != first.name])
        raise InputError(
            f"{title} has type {first.ros_type!r}, {' or '.join(TYPES[name])} is expected",
            where=str(path),
            do=others if others.startswith("if") else "publish and record it as one of these",
        )
    wrong = next((t for t in usable if t.encoding not in ENCODINGS), None)
    if wrong is not None:
        raise InputError(
            f"topic {wrong.name} has encoding {wrong.encoding!r}, 'cdr' of ROS 2 and 'ros1' are read",
            where=str(path),
            do="record it from ROS 2 with `ros2 bag record`",
        )
