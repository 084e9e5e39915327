"""Reading bags: messages in arrival order, inputs decoded, and what is missing said by name."""

from __future__ import annotations

import hashlib
import heapq
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_path import locate
from ctr_dynamics.io.inputs.input_decoder import InputDecoder
from ctr_dynamics.io.inputs.input_mapping import InputMapping, check_topic, cure, listed, topic_names
from ctr_dynamics.io.messages.cdr import CdrError, JointStateIn, PoseIn, decode_joint_state
from ctr_dynamics.io.messages.encode import encode_input
from ctr_dynamics.io.messages.input_types import TYPES, Decoded, names_child, own_type, rank
from ctr_dynamics.io.messages.topics import (
    INPUTS,
    JOINT_STATES,
    TF,
    TF_STATIC,
    TIP_LOAD,
    TRACKER_TIP,
    TRANSFORMS,
    accepts_frame,
)
from ctr_dynamics.io.storage.open_file import open_file, unpacked_message
from ctr_dynamics.io.storage.stored_file import (
    MAX_HELD_BYTES,
    HeldBytes,
    StoredFile,
    StoredTopic,
    TypedMessage,
)

__all__ = ["MAX_HELD_BYTES", "Bag", "BagTopic", "InputMessage", "RawMessage", "open_bag", "sha256_of"]
INPUT_TOPICS = frozenset(topic.name for topic in INPUTS)


class RawMessage(NamedTuple):
    """A message as recorded: topic, log time (arrival) and serialised bytes."""

    topic: str
    log_ns: int
    data: bytes


class InputMessage(NamedTuple):
    """A decoded message of an input topic with its log time (arrival)."""

    topic: str
    log_ns: int
    message: Decoded


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag: its name as it is used here, message type, encoding, number of messages, and its name in the bag."""

    name: str
    ros_type: str
    encoding: str
    messages: int
    recorded_name: str = ""


@dataclass
class Bag:
    """An opened bag. It holds the index only; messages are read while iterating.

    `notes` says what is missing or damaged; damage inside a chunk is found, and added, while iterating.
    `mapping` says what its topics, names, frames and units mean; `names` gives each topic the name that it has here.
    `tubes`: number of the robot's, which tells when a joint state is whole; 0 where it is not known.
    """

    path: Path
    files: Sequence[StoredFile]
    location_notes: list[str] = field(default_factory=list)
    malformed: dict[str, int] = field(default_factory=dict)
    mapping: InputMapping = field(default_factory=InputMapping)
    names: dict[str, str] = field(default_factory=dict)
    tubes: int = 0
    _first_fault: dict[str, str] = field(default_factory=dict)
    _input_notes: list[str] = field(default_factory=list)

    @property
    def notes(self) -> list[str]:
        notes = [*self.location_notes, *(note for file in self.files for note in file.notes)]
        for topic, count in self.malformed.items():
            notes.append(f"{topic}: {count} messages cannot be decoded ({self._first_fault[topic]})")
        return [*notes, *self._input_notes]

    def read_for(self, tubes: int, mount_xyzw: tuple[float, float, float, float]) -> None:
        """Read the inputs for a robot with so many tubes, whose sensor has the orientation ``mount_xyzw`` in the tip frame."""
        self.tubes = tubes
        self.mapping = replace(self.mapping, mount_xyzw=mount_xyzw)

    @property
    def stored_topics(self) -> list[StoredTopic]:
        """Topics as they are in the files."""
        return [topic for file in self.files for topic in file.topics]

    @property
    def topics(self) -> dict[str, BagTopic]:
        """Topics by name. Several channels of one topic are counted together; of several types the one that is used is given."""
        found: dict[str, BagTopic] = {}
        for topic in self.stored_topics:
            name = self.names.get(topic.name)
            if name is None:
                continue
            before = found.get(name)
            count = topic.messages + (before.messages if before else 0)
            if before is None or (name in TYPES and rank(name, topic.ros_type) < rank(name, before.ros_type)):
                found[name] = BagTopic(name, topic.ros_type, topic.encoding, count, topic.name)
            else:
                found[name] = replace(before, messages=count)
        return dict(sorted(found.items()))

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time of its files; (0, 0) where there is no message."""
        spans = [file.span_ns for file in self.files if file.span_ns != (0, 0)]
        return min((s for s, _ in spans), default=0), max((e for _, e in spans), default=0)

    @property
    def unchecked(self) -> list[str]:
        """A note for every file that was read and holds no checksums."""
        return [
            f"{file.path.name}: written without checksums (CRC 0), a damaged value would not be noticed"
            for file in self.files
            if file.unchecked
        ]

    def metadata(self, name: str) -> dict[str, str]:
        """The metadata record of that name, empty when there is none."""
        return next((file.metadata[name] for file in self.files if name in file.metadata), {})

    def check_inputs(self, required: Collection[str] = (JOINT_STATES,)) -> None:
        """Check types and encodings of the input topics, and that the required ones hold messages.

        Raises:
            InputError: a topic is missing, empty, or has another type or encoding, or one child frame has to be named.
        """
        stored = self.stored_topics
        for name in required:
            here = self.topics.get(name)
            if here is None or (here.messages == 0 and all(file.complete for file in self.files)):
                state = "no topic" if here is None else "no message on"
                damage = "".join(f"; {note}" for note in self.notes[:2])
                missing = [name, *(n for n in (TRACKER_TIP, TIP_LOAD) if n not in self.topics and n != name)]
                cures = [cure(n, stored) for n in missing]
                raise InputError(
                    f"{state} {name}; the bag holds {listed(stored)}{damage}",
                    where=str(self.path),
                    do=" ".join([cures[0], *(f"and {c}" for c in cures[1:] if c.startswith("if "))]),
                )
        for name in TYPES:
            check_topic(self.path, name, [t for t in stored if self.names.get(t.name) == name], stored)
        self._check_child()

    def _check_child(self) -> None:
        """Of several child frames one has to be named.

        Raises:
            InputError: none is, or another one.
        """
        here = self.topics.get(TRACKER_TIP)
        if here is None or not names_child(here.ros_type):
            return
        decoder = InputDecoder(self.mapping)
        for _ in self.as_recorded(decoder, {TRACKER_TIP}):
            pass
        wanted, seen = self.mapping.child_frame.lstrip("/"), sorted(decoder.children)
        if not seen or wanted in seen or (not wanted and len(seen) == 1):
            return
        frames = ", ".join(seen[:12])
        raise InputError(
            f"topic {here.recorded_name} has no child frame '{wanted}', but {frames}"
            if wanted
            else f"topic {here.recorded_name} has the child frames {frames}, and any may be the sensor",
            where=str(self.path),
            do="name that of the sensor: --set tracker.child_frame_id=NAME",
        )

    def messages(self, only: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Messages in the order of log time, ties by topic name, then in the order of the files.

        Only chunks that overlap in time are held in memory.

        Args:
            only: topics wanted, by the names that they have here; None for all.

        Raises:
            InputError: so many chunks overlap that their messages would not fit into ``MAX_HELD_BYTES``, or a file cannot be read.
        """
        for message in self.typed_messages(only):
            yield RawMessage(*message[:3])

    def typed_messages(self, only: Collection[str] | None = None) -> Iterator[TypedMessage]:
        """:meth:`messages` with type and encoding of each.

        Args:
            only: topics wanted, by the names that they have here; None for all.

        Raises:
            InputError: as :meth:`messages`.
        """

        def name_of(recorded: str) -> str | None:
            # a topic that only the damaged part of a file tells of is not in the index
            name = self.names.get(recorded, recorded)
            if recorded not in self.names and recorded in self.names.values():
                return None
            return name if only is None or name in only else None

        held = HeldBytes()
        waiting = sorted(range(len(self.files)), key=lambda i: (self.files[i].span_ns[0], i), reverse=True)
        heads: list[tuple[int, str, int, TypedMessage, Iterator[TypedMessage]]] = []
        while waiting or heads:
            # a file is opened when its time has come: of a split bag, one after the other
            while waiting and (not heads or heads[0][0] >= self.files[waiting[-1]].span_ns[0]):
                number = waiting.pop()
                stream = self.files[number].messages(name_of, held)
                _push(heads, number, stream)
            if heads:
                _, _, number, message, stream = heapq.heappop(heads)
                yield message._replace(data=unpacked_message(message.data))
                _push(heads, number, stream)

    def inputs(self, only: Collection[str] = INPUT_TOPICS) -> Iterator[InputMessage]:
        """Decoded messages of the estimator's input topics, in arrival order.

        What cannot be decoded is counted in `malformed` and left out.

        Args:
            only: topics wanted.

        Raises:
            InputError: an input topic has another type or encoding.
        """
        self.check_inputs(required=())
        decoder = InputDecoder(self.mapping, self.tubes)
        self.malformed.clear()
        log_ns = 0
        for item in self._decoded(decoder, only):
            log_ns = item.log_ns
            yield item
        for rest in decoder.joints.rest():
            yield InputMessage(JOINT_STATES, log_ns, rest)
        for pose in decoder.frames.rest():
            yield InputMessage(TRACKER_TIP, log_ns, pose)
        for note in (*decoder.joints.notes, *decoder.frames.notes):
            if note not in self._input_notes:
                self._input_notes.append(note)

    def standard_messages(self, only: Collection[str] = INPUT_TOPICS) -> Iterator[RawMessage]:
        """Messages of the inputs in the types of the topics themselves, as the node subscribes to them.

        Those that are recorded so come byte by byte as they are.

        Args:
            only: topics wanted, by the names that they have here.

        Raises:
            InputError: an input topic has another type or encoding.
        """
        self.check_inputs(required=())
        decoder = InputDecoder(self.mapping)
        transforms = self.take_transforms(decoder) if TRACKER_TIP in only else frozenset()
        alike = not transforms and self.mapping == InputMapping(
            self.mapping.remap, frame_id=self.mapping.frame_id
        )
        for message in self.typed_messages({*only, *transforms}):
            if message.topic in transforms:
                for value in self.values(decoder, *message):
                    yield RawMessage(TRACKER_TIP, message.log_ns, encode_input(value))
                continue
            plain = message.ros_type in ("", TYPES[message.topic][0]) and message.encoding == "cdr"
            if plain and alike and message.topic != JOINT_STATES:
                yield RawMessage(*message[:3])
                continue
            try:
                values = decoder.decode(
                    message.topic, message.ros_type, message.encoding, message.data, message.log_ns
                )
                names = [value.names for value in values if isinstance(value, JointStateIn)]
                if plain and alike and names == [decode_joint_state(message.data).names]:
                    yield RawMessage(*message[:3])
                    continue
            except CdrError:
                if plain:
                    yield RawMessage(*message[:3])  # whoever takes it counts it
                continue
            for value in values:
                yield RawMessage(message.topic, message.log_ns, encode_input(value))

    def _decoded(self, decoder: InputDecoder, only: Collection[str]) -> Iterator[InputMessage]:
        """Messages of the inputs ``only``, poses in the frame that is wanted where the transforms say how."""
        transforms = self.take_transforms(decoder) if TRACKER_TIP in only else frozenset()
        return self.as_recorded(decoder, only, transforms)

    def as_recorded(
        self, decoder: InputDecoder, only: Collection[str], transforms: Collection[str] = ()
    ) -> Iterator[InputMessage]:
        """Messages of the inputs, poses in the frames in which they were recorded.

        Of a topic with several types, those of the type that comes first in ``TYPES``. What cannot be decoded is counted in `malformed`.

        Args:
            decoder: decodes them. only: topics wanted. transforms: topics with poses of frames, which the decoder wants as well.
        """
        kinds = {name: own_type(topic.ros_type) for name, topic in self.topics.items()}
        for message in self.typed_messages({*only, *transforms}):
            topic, ros_type = message.topic, message.ros_type
            if ros_type and own_type(ros_type) != kinds.get(topic, own_type(ros_type)):
                note = f"{topic}: messages of type {ros_type} are left out"
                if note not in self._input_notes:
                    self._input_notes.append(note)
                continue
            name = TRACKER_TIP if topic in transforms else topic  # poses that waited for a transform
            for value in self.values(decoder, *message):
                yield InputMessage(name, message.log_ns, value)

    def take_transforms(self, decoder: InputDecoder) -> frozenset[str]:
        """Give a ``decoder`` the static transforms, which hold at all times; returns the topics whose messages it needs beside the inputs.

        None where the poses are in the frame that is wanted.
        """
        recorded = self.topics.keys() & set(TRANSFORMS)
        if not self.mapping.frame_id or not recorded or not self._frame_differs():
            return frozenset()
        for message in self.typed_messages({TF_STATIC}):
            self.values(decoder, *message)
        return frozenset(recorded & {TF})

    def _frame_differs(self) -> bool:
        """Whether the first pose names another frame than that which is wanted."""
        counted = dict(self.malformed)
        decoder = InputDecoder(replace(self.mapping, frame_id=""))
        first = next(self.as_recorded(decoder, {TRACKER_TIP}), None)
        self.malformed = counted  # whoever reads on counts these messages
        return (
            first is not None
            and isinstance(first.message, PoseIn)
            and not accepts_frame(first.message.frame_id, self.mapping.frame_id)
        )

    def values(
        self, decoder: InputDecoder, topic: str, log_ns: int, data: bytes, ros_type: str, encoding: str
    ) -> list[Decoded]:
        """What a message holds; nothing where it cannot be decoded, which is counted in `malformed`.

        Args:
            decoder: decodes it. topic: of the inputs or of transforms. log_ns: arrival. data: as recorded. ros_type, encoding: its schema's.
        """
        try:
            return decoder.decode(topic, ros_type, encoding, data, log_ns)
        except CdrError as error:
            self.malformed[topic] = self.malformed.get(topic, 0) + 1
            self._first_fault.setdefault(topic, str(error))
            return []

    def sha256(self) -> dict[str, str]:
        """SHA-256 of every file of the bag, by file name."""
        return {file.path.name: sha256_of(file.path) for file in self.files}


def _push(
    heads: list[tuple[int, str, int, TypedMessage, Iterator[TypedMessage]]],
    number: int,
    stream: Iterator[TypedMessage],
) -> None:
    """The next message of a file, among those of the others."""
    message = next(stream, None)
    if message is not None:
        heapq.heappush(heads, (message.log_ns, message.topic, number, message, stream))


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal.

    Raises:
        InputError: the file cannot be read.
    """
    digest = hashlib.sha256()
    try:
        with path.open("rb") as stream:
            while block := stream.read(2**20):
                digest.update(block)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path)) from None
    return digest.hexdigest()


def open_bag(path: str | Path, mapping: InputMapping | None = None) -> Bag:
    """Open a bag for reading. A file that was cut off or not closed is opened too; `Bag.notes` says what is missing.

    Args:
        path: a file (``.mcap``, ``.db3``, ``.bag``, also compressed with zstd), a rosbag2 folder, or a folder that holds one bag.
        mapping: what its topics, names, frames and units mean, where they are not the product's.

    Returns:
        The bag: `inputs()` yields the decoded messages of the estimator's inputs in the order of their arrival, `messages()` all of them as bytes.

    Raises:
        InputError: nothing there, not a bag, or a topic of ``mapping`` that is not in it.

    Example:
        >>> from ctr_dynamics import open_bag
        >>> from ctr_dynamics.io.shipped_bags import shipped_bag
        >>> bag = open_bag(shipped_bag())
        >>> list(bag.topics)
        ['/ctr/joint_states', '/ctr/tip_load', '/ctr/tracker/tip']
        >>> next(bag.inputs()).message.names
        ('tube1_rotation', 'tube1_translation', 'tube2_rotation', 'tube2_translation')
    """
    located = locate(path)
    mapping = mapping or InputMapping()
    bag = Bag(located.path, [open_file(file) for file in located.files], located.notes, mapping=mapping)
    bag.names = topic_names(bag.stored_topics, mapping, str(located.path))
    return bag
