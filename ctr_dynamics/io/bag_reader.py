"""Reading bags: messages in arrival order, inputs decoded, and what is missing said by name."""

from __future__ import annotations

import hashlib
import heapq
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_path import locate
from ctr_dynamics.io.mcap_file import McapFile, read_mcap
from ctr_dynamics.io.messages import cdr
from ctr_dynamics.io.messages.topics import JOINT_STATES, TIP_LOAD, TOPIC, TRACKER_TIP

Decoded = cdr.JointStateIn | cdr.PoseIn | cdr.WrenchIn
DECODERS: dict[str, Callable[[bytes], Decoded]] = {
    JOINT_STATES: cdr.decode_joint_state,
    TRACKER_TIP: cdr.decode_pose_stamped,
    TIP_LOAD: cdr.decode_wrench_stamped,
}


MAX_HELD_BYTES = 128 * 2**20  # two of the largest chunks
_ENTRY_BYTES = 256  # what a message takes beside its bytes while it waits for its turn


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
    """A topic of a bag: its message type, encoding and number of messages."""

    name: str
    ros_type: str
    encoding: str
    messages: int


@dataclass
class Bag:
    """An opened bag. It holds the index only; messages are read while iterating.

    `notes` says what is missing or damaged; damage inside a chunk is found, and added, while iterating.
    """

    path: Path
    files: list[McapFile]
    location_notes: list[str] = field(default_factory=list)
    malformed: dict[str, int] = field(default_factory=dict)
    _first_fault: dict[str, str] = field(default_factory=dict)

    @property
    def notes(self) -> list[str]:
        notes = [*self.location_notes, *(note for file in self.files for note in file.notes)]
        for topic, count in self.malformed.items():
            notes.append(f"{topic}: {count} messages cannot be decoded ({self._first_fault[topic]})")
        return notes

    @property
    def topics(self) -> dict[str, BagTopic]:
        """Topics by name. Several channels of one topic are counted together."""
        found: dict[str, BagTopic] = {}
        for file in self.files:
            for channel in file.channels.values():
                schema = file.schemas.get(channel.schema_id)
                before = found.get(channel.topic)
                found[channel.topic] = BagTopic(
                    channel.topic,
                    before.ros_type if before else (schema.name if schema else ""),
                    before.encoding if before else channel.message_encoding,
                    file.counts.get(channel.id, 0) + (before.messages if before else 0),
                )
        return dict(sorted(found.items()))

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
            InputError: a topic is missing, empty, or has another type or encoding.
        """
        for name in required:
            here = self.topics.get(name)
            if here is None or (here.messages == 0 and all(file.complete for file in self.files)):
                known = ", ".join(
                    f"{topic.name} ({topic.ros_type})" for topic in list(self.topics.values())[:6]
                )
                state = "no topic" if here is None else "no message on"
                damage = "".join(f"; {note}" for note in self.notes[:2])
                raise InputError(
                    f"{state} {name}; the bag holds {known or 'no topics at all'}{damage}",
                    where=str(self.path),
                    do="record that topic, or rename it with `ros2 bag convert`",
                )
        for file in self.files:
            for channel in file.channels.values():
                if channel.topic in DECODERS:
                    schema = file.schemas.get(channel.schema_id)
                    _check_channel(
                        file.path, channel.topic, channel.message_encoding, schema.name if schema else ""
                    )

    def messages(self, only: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Messages in the order of log time, ties by topic name, then in the order of the file.

        Only chunks that overlap in time are held in memory.

        Args:
            only: topics wanted; None for all.

        Raises:
            InputError: so many chunks overlap that their messages would not fit into ``MAX_HELD_BYTES``, or a file cannot be read.
        """
        with ExitStack() as stack:
            streams: list[IO[bytes]] = []
            blocks = []
            for number, file in enumerate(self.files):
                try:
                    streams.append(stack.enter_context(file.path.open("rb")))
                except OSError as error:
                    raise InputError(f"cannot be read ({error.strerror})", where=str(file.path)) from None
                blocks += [(block.start_ns, number, block.offset, block) for block in file.blocks]
            blocks.sort()
            queue: list[tuple[int, str, int, int, int, bytes]] = []
            held = 0
            for _, number, offset, block in blocks:
                # Everything before this block's first message can go; what is equal may tie with it.
                while queue and queue[0][0] < block.start_ns:
                    log_ns, topic, *_, data = heapq.heappop(queue)
                    held -= len(data) + _ENTRY_BYTES
                    yield RawMessage(topic, log_ns, data)
                file = self.files[number]
                try:
                    for place, message in enumerate(file.load(streams[number], block)):
                        channel = file.channels.get(message.channel_id)
                        if channel is None:
                            file.note(f"messages of the unknown channel {message.channel_id} are left out")
                        elif only is None or channel.topic in only:
                            entry = (message.log_ns, channel.topic, number, offset, place, message.data)
                            heapq.heappush(queue, entry)
                            held += len(message.data) + _ENTRY_BYTES
                            if held > MAX_HELD_BYTES:
                                raise InputError(
                                    f"{len(queue)} messages overlap in time at {message.log_ns} ns, more than {MAX_HELD_BYTES} bytes",
                                    where=str(file.path),
                                    do="write them in the order of time: `mcap sort`",
                                )
                except OSError as error:
                    file.note(f"byte {block.offset} cannot be read ({error.strerror})")
            while queue:
                log_ns, topic, *_, data = heapq.heappop(queue)
                yield RawMessage(topic, log_ns, data)

    def inputs(self) -> Iterator[InputMessage]:
        """Decoded messages of the estimator's input topics, in arrival order.

        What cannot be decoded is counted in `malformed` and left out.

        Raises:
            InputError: an input topic has another type or encoding.
        """
        self.check_inputs(required=())
        self.malformed.clear()
        for topic, log_ns, data in self.messages(DECODERS):
            try:
                message = DECODERS[topic](data)
            except cdr.CdrError as error:
                self.malformed[topic] = self.malformed.get(topic, 0) + 1
                self._first_fault.setdefault(topic, str(error))
                continue
            yield InputMessage(topic, log_ns, message)

    def sha256(self) -> dict[str, str]:
        """SHA-256 of every file of the bag, by file name."""
        return {file.path.name: sha256_of(file.path) for file in self.files}


def _check_channel(path: Path, topic: str, encoding: str, ros_type: str) -> None:
    expected = TOPIC[topic].ros_type
    if encoding != "cdr":
        raise InputError(
            f"topic {topic} has encoding {encoding!r}, only 'cdr' is read",
            where=str(path),
            do="record it from ROS 2, or convert the bag",
        )
    if ros_type not in (expected, expected.replace("/msg/", "/")):
        raise InputError(
            f"topic {topic} has type {ros_type or 'unknown'!r}, {expected!r} is expected", where=str(path)
        )


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


def open_bag(path: str | Path) -> Bag:
    """Open a bag for reading. A file that was cut off or not closed is opened too; `Bag.notes` says what is missing.

    Args:
        path: an ``.mcap`` file, a rosbag2 folder, or a folder that holds exactly one ``.mcap``.

    Returns:
        The bag: `inputs()` yields the decoded messages of the estimator's inputs in the order of their arrival, `messages()` all of them as bytes.

    Raises:
        InputError: nothing there, or not a bag.

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
    return Bag(located.path, [read_mcap(file) for file in located.files], located.notes)
