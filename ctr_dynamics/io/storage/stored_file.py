"""What every storage of recorded messages offers, whatever the format of its files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

from ctr_dynamics.errors import InputError

MAX_HELD_BYTES = 128 * 2**20  # two of the largest chunks
_ENTRY_BYTES = 256  # what a message takes beside its bytes while it waits for its turn


class TypedMessage(NamedTuple):
    """A message as recorded: topic, log time (arrival), serialised bytes, and what they are."""

    topic: str
    log_ns: int
    data: bytes
    ros_type: str = ""
    encoding: str = "cdr"


class StoredTopic(NamedTuple):
    """Messages of one topic and type in one file; ``ros_type`` as ROS 2 writes it, empty where the file does not say."""

    name: str
    ros_type: str
    encoding: str
    messages: int


class HeldBytes:
    """Memory of messages that wait for their turn, over all files of a bag that are read together."""

    def __init__(self) -> None:
        self.bytes = 0

    def take(self, data: bytes, log_ns: int, waiting: int, path: Path) -> None:
        """Count a message that waits.

        Raises:
            InputError: ``waiting`` messages that overlap in time at ``log_ns`` need more than ``MAX_HELD_BYTES``.
        """
        self.bytes += len(data) + _ENTRY_BYTES
        if self.bytes > MAX_HELD_BYTES:
            raise InputError(
                f"{waiting} messages overlap in time at {log_ns} ns, more than {MAX_HELD_BYTES} bytes",
                where=str(path),
                do="write them in the order of time: `mcap sort`",
            )

    def release(self, data: bytes) -> None:
        """Count it no more."""
        self.bytes -= len(data) + _ENTRY_BYTES


class StoredFile(Protocol):
    """One file of a bag. It holds the index; messages are read while iterating.

    Attributes:
        path: as it was given. size: bytes. complete: False where its end or its index is missing.
        unchecked: True once messages without a checksum were read from a format that has them.
        library, profile: what wrote it. metadata: records by name. notes: what is missing or damaged, one line each.
    """

    path: Path
    size: int
    complete: bool
    unchecked: bool
    library: str
    profile: str
    metadata: dict[str, dict[str, str]]
    notes: list[str]

    @property
    def topics(self) -> list[StoredTopic]:
        """What it holds; one topic may be there with several types."""
        ...

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time, (0, 0) where there are no messages."""
        ...

    def messages(self, name_of: Callable[[str], str | None], held: HeldBytes) -> Iterator[TypedMessage]:
        """Messages in the order of log time, ties by topic name, then in the order of the file.

        Args:
            name_of: the name that a topic of the file is given; None where its messages are not wanted.
            held: counts what waits in memory.
        """
        ...


@dataclass
class IndexedFile:
    """What the readers of formats that have an index of their own hold of a file; see :class:`StoredFile`. These formats have no checksums.

    ``read_path``: where its content lies, which is elsewhere where the file is compressed.
    """

    path: Path
    size: int
    read_path: Path
    complete: bool = True
    unchecked: bool = False
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    topics: list[StoredTopic] = field(default_factory=list)
    span_ns: tuple[int, int] = (0, 0)

    def damaged(self, reason: str) -> None:
        """Note that messages are missing from here on, once."""
        self.complete = False
        note = f"{self.path.name}: damaged, later messages are missing ({reason})"
        if note not in self.notes:
            self.notes.append(note)


def ros2_type(name: str) -> str:
    """The name of a message type as ROS 2 writes it: ``sensor_msgs/JointState`` is ``sensor_msgs/msg/JointState``."""
    package, slash, message = name.partition("/")
    return f"{package}/msg/{message}" if slash and "/" not in message else name
