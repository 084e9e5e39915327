"""From a path to the reader of its format, by its first bytes; compressed files are unpacked on the way."""

from __future__ import annotations

import atexit
import tempfile
from pathlib import Path

import zstandard

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.storage.mcap_file import read_mcap
from ctr_dynamics.io.storage.ros1_file import read_ros1
from ctr_dynamics.io.storage.sqlite_file import read_sqlite
from ctr_dynamics.io.storage.stored_file import StoredFile

ZSTD = b"\x28\xb5\x2f\xfd"
SQLITE = b"SQLite format 3"
ROS1 = b"#ROSBAG V"
MAX_UNPACKED_BYTES = 16 * 2**30
MAX_MESSAGE_BYTES = 256 * 2**20


def open_file(path: Path) -> StoredFile:
    """The reader of one file of a bag: an ``.mcap``, ``.db3`` or ``.bag`` file, or one of them compressed with zstd.

    Raises:
        InputError: empty, of another format, damaged, or it cannot be read.
    """
    content = path
    head = _head(path)
    if head.startswith(ZSTD):
        content = _unpacked(path)
        head = _head(content)
    if head.startswith(SQLITE):
        return read_sqlite(path, content)
    if head.startswith(ROS1):
        return read_ros1(path, content)
    return read_mcap(path, content)


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            return stream.read(16)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path)) from None


def _unpacked(path: Path) -> Path:
    """A temporary file with the content of a compressed one, removed when the program ends."""
    folder = tempfile.TemporaryDirectory(prefix="ctr_dynamics_")
    atexit.register(folder.cleanup)
    target = Path(folder.name) / (path.name.removesuffix(".zstd").removesuffix(".zst") or "bag")
    written = 0
    try:
        with path.open("rb") as source, target.open("wb") as sink:
            reader = zstandard.ZstdDecompressor().stream_reader(source)
            while piece := reader.read(2**20):
                written += len(piece)
                if written > MAX_UNPACKED_BYTES:
                    raise InputError(
                        f"unpacks to more than {MAX_UNPACKED_BYTES} bytes",
                        where=str(path),
                        do="unpack it with `zstd -d`, and split it",
                    )
                sink.write(piece)
    except zstandard.ZstdError:
        pass  # what lies before the damage is read; the format's own reader says that its end is missing
    except OSError as error:
        raise InputError(f"cannot be unpacked ({error.strerror})", where=str(path)) from None
    if not written:
        raise InputError("is a damaged zstd file", where=str(path), do="copy it again")
    return target


def unpacked_message(data: bytes) -> bytes:
    """The content of a message that rosbag2 has compressed by itself (compression mode MESSAGE); any other as it is.

    No plain message of ROS begins as a zstd frame does. What cannot be unpacked stays as it is, and is counted by who decodes it.
    """
    if not data.startswith(ZSTD):
        return data
    try:
        return zstandard.ZstdDecompressor().stream_reader(data).read(MAX_MESSAGE_BYTES)
    except zstandard.ZstdError:
        return data
