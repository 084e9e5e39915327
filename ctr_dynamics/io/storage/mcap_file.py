"""One MCAP file: its channels and blocks of messages, also when it was cut off, not closed or damaged.

A closed file is read by its summary. Anything else is scanned record by record: what was written is found,
what is missing is said in `McapFile.notes`. Every length is checked against the file before it is believed,
so no content can make the reader allocate more than a block.
(MCAP specification 0: magic, records of opcode, uint64 length and content, footer, magic.)
"""

from __future__ import annotations

import heapq
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Header, Metadata, MetadataIndex, Schema, Statistics

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.storage.stored_file import HeldBytes, StoredTopic, TypedMessage, ros2_type

MAGIC = b"\x89MCAP0\r\n"
# Recorders write chunks of 1 to 8 MB; a larger one holds one large message. What a chunk claims is bounded before it is unpacked.
MAX_CHUNK_BYTES = 64 * 2**20
_PLAIN_BLOCK_BYTES = 2**20  # messages outside chunks are grouped to blocks of this size
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
_FOOTER = struct.Struct("<QQI")
_FOOTER_BYTES = _RECORD.size + _FOOTER.size
_PARSE_ERRORS = (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError, MemoryError)


class Block(NamedTuple):
    """A run of records with messages: one chunk, or consecutive messages outside chunks."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    chunk: bool


class StoredMessage(NamedTuple):
    """A message as stored: channel, log time and serialised bytes."""

    channel_id: int
    log_ns: int
    data: bytes


@dataclass
class McapFile:
    """What a file holds; see :class:`StoredFile`. `complete` is False when its closing summary is missing or unusable; `unchecked` is
    True once a chunk without a checksum was read. `read_path`: where its content lies, which is elsewhere where the file is compressed."""

    path: Path
    size: int
    read_path: Path
    complete: bool = True
    unchecked: bool = False
    library: str = ""
    profile: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    blocks: list[Block] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)

    def note(self, text: str) -> None:
        line = f"{self.path.name}: {text}"
        if line not in self.notes:
            self.notes.append(line)

    @property
    def topics(self) -> list[StoredTopic]:
        """See :attr:`StoredFile.topics`."""
        return [
            StoredTopic(
                channel.topic, self._type(channel), channel.message_encoding, self.counts.get(channel.id, 0)
            )
            for channel in self.channels.values()
        ]

    def _type(self, channel: Channel) -> str:
        schema = self.schemas.get(channel.schema_id)
        return ros2_type(schema.name) if schema else ""

    @property
    def span_ns(self) -> tuple[int, int]:
        """See :attr:`StoredFile.span_ns`."""
        starts, ends = [b.start_ns for b in self.blocks], [b.end_ns for b in self.blocks]
        return min(starts, default=0), max(ends, default=0)

    def messages(self, name_of: Callable[[str], str | None], held: HeldBytes) -> Iterator[TypedMessage]:
        """See :meth:`StoredFile.messages`. Only chunks that overlap in time are held in memory."""
        queue: list[tuple[int, str, int, int, int, bytes]] = []

        def first() -> TypedMessage:
            log_ns, topic, _, _, number, data = heapq.heappop(queue)
            held.release(data)
            channel = self.channels[number]
            return TypedMessage(topic, log_ns, data, self._type(channel), channel.message_encoding)

        try:
            stream = self.read_path.open("rb")
        except OSError as error:
            raise InputError(f"cannot be read ({error.strerror})", where=str(self.path)) from None
        with stream:
            for block in sorted(self.blocks, key=lambda b: (b.start_ns, b.offset)):
                # Everything before this block's first message can go; what is equal may tie with it.
                while queue and queue[0][0] < block.start_ns:
                    yield first()
                try:
                    for place, message in enumerate(self.load(stream, block)):
                        channel = self.channels.get(message.channel_id)
                        if channel is None:
                            self.note(f"messages of the unknown channel {message.channel_id} are left out")
                            continue
                        topic = name_of(channel.topic)
                        if topic is not None:
                            entry = (message.log_ns, topic, block.offset, place, channel.id, message.data)
                            heapq.heappush(queue, entry)
                            held.take(message.data, message.log_ns, len(queue), self.path)
                except OSError as error:
                    self.note(f"byte {block.offset} cannot be read ({error.strerror})")
            while queue:
                yield first()

    def load(self, stream: IO[bytes], block: Block) -> Iterator[StoredMessage]:
        """Messages of one block in the order of the file. What is damaged, or larger than ``MAX_CHUNK_BYTES``, is left out and noted."""
        if block.length > MAX_CHUNK_BYTES:
            self.note(
                f"chunk at byte {block.offset} has {block.length} bytes, at most {MAX_CHUNK_BYTES} are read"
            )
            return
        stream.seek(block.offset)
        data: bytes | bytearray = stream.read(block.length)
        if block.chunk:
            data = self._chunk_content(data, block.offset)
        for opcode, start, end in _records(data):
            if opcode == Opcode.MESSAGE and end - start >= _MESSAGE.size:
                channel_id, _, log_ns, _ = _MESSAGE.unpack_from(data, start)
                yield StoredMessage(channel_id, log_ns, bytes(data[start + _MESSAGE.size : end]))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._define(opcode, bytes(data[start:end]))

    def _define(self, opcode: int, content: bytes) -> None:
        """Take in a schema or channel; the first definition of an id stays."""
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(content)))
                self.schemas.setdefault(schema.id, schema)
            else:
                channel = Channel.read(ReadDataStream(BytesIO(content)))
                self.channels.setdefault(channel.id, channel)
        except _PARSE_ERRORS:
            self.note("holds a damaged schema or channel record, which is left out")

    def _chunk_content(self, record: bytes | bytearray, offset: int) -> bytes | bytearray:
        """Records inside a chunk; of a cut chunk, those before the cut."""
        where = f"chunk at byte {offset}"
        head = _RECORD.size + _CHUNK.size
        if len(record) < head + 8:
            return b""
        _, _, size, crc, name_length = _CHUNK.unpack_from(record, _RECORD.size)
        if name_length > 64:
            self.note(f"{where} is damaged and left out")
            return b""
        if len(record) < head + name_length + 8:
            return b""
        compression = record[head : head + name_length].decode("ascii", "replace")
        start = head + name_length + 8
        (length,) = struct.unpack_from("<Q", record, start - 8)
        cut = start + length > len(record)
        content = record[start : start + length]
        if size > MAX_CHUNK_BYTES:
            self.note(f"{where} claims {size} bytes, at most {MAX_CHUNK_BYTES} are read; it is left out")
            return b""
        if compression not in ("", "zstd", "lz4"):
            raise InputError(
                f"{where} has compression {compression!r}, readable are 'zstd', 'lz4' and none",
                where=str(self.path),
                do="convert it with `mcap convert` or `ros2 bag convert`",
            )
        data, whole = _decompress(content, compression, size)
        if cut:
            return data
        self.unchecked = self.unchecked or crc == 0
        if not whole or (crc != 0 and zlib.crc32(data) != crc):
            self.note(f"{where} is damaged ({len(record)} bytes) and left out")
            return b""
        return data


def _decompress(content: bytes | bytearray, compression: str, size: int) -> tuple[bytes | bytearray, bool]:
    """Content of a chunk, at most `size` bytes, as far as it can be had, and whether it is all there."""
    if compression == "":
        return content[:size], len(content) == size
    # In pieces: what lies before a cut or a damaged place is still delivered.
    data = bytearray()
    try:
        if compression == "zstd":
            reader = zstandard.ZstdDecompressor().stream_reader(BytesIO(content))
            while len(data) < size and (piece := reader.read(min(size - len(data), 2**17))):
                data += piece
        else:
            decompressor = lz4.frame.LZ4FrameDecompressor()
            piece = decompressor.decompress(content, max_length=size)
            data += piece
            while len(data) < size and not decompressor.eof and piece:
                piece = decompressor.decompress(b"", max_length=size - len(data))
                data += piece
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError, ValueError):
        return data, False
    return data, len(data) == size


def _records(data: bytes | bytearray) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the content of every whole record in `data`."""
    position = 0
    while position + _RECORD.size <= len(data):
        opcode, length = _RECORD.unpack_from(data, position)
        start = position + _RECORD.size
        if start + length > len(data):
            return
        yield opcode, start, start + length
        position = start + length


def read_mcap(path: Path, read_path: Path | None = None) -> McapFile:
    """Index a file without holding its messages in memory.

    Args:
        path: of the file. read_path: of its content, if it lies elsewhere.

    Raises:
        InputError: the file is empty, not an MCAP file, or cannot be read.
    """
    try:
        content = read_path or path
        with content.open("rb") as stream:
            size = stream.seek(0, 2)
            stream.seek(0)
            _check_magic(path, stream.read(16), size)
            file = McapFile(path, size, content)
            if not _read_summary(file, stream):
                file = McapFile(path, size, content, complete=False)
                _scan(file, stream)
            return file
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path)) from None


def _check_magic(path: Path, start: bytes, size: int) -> None:
    if start.startswith(MAGIC):
        return
    do = "give an .mcap file or a bag folder"
    if size == 0:
        raise InputError("the file is empty (0 bytes)", where=str(path), do=do)
    if MAGIC.startswith(start):
        raise InputError(f"the file was cut after {size} bytes and holds nothing", where=str(path), do=do)
    raise InputError(
        f"is not an MCAP file, SQLite bag or ROS 1 bag (begins with bytes {start[:8].hex(' ')})",
        where=str(path),
        do=do,
    )


def _read_summary(file: McapFile, stream: IO[bytes]) -> bool:
    """Index the file by its summary. False when there is none that can be trusted."""
    end = file.size - len(MAGIC) - _FOOTER_BYTES
    if end < len(MAGIC):
        return False
    stream.seek(end)
    tail = stream.read()
    opcode, length = _RECORD.unpack_from(tail, 0)
    if not tail.endswith(MAGIC) or opcode != Opcode.FOOTER or length != _FOOTER.size:
        return False
    start, _, crc = _FOOTER.unpack_from(tail, _RECORD.size)
    if not len(MAGIC) <= start < end:
        return False
    stream.seek(start)
    summary = stream.read(end - start)
    if crc and zlib.crc32(tail[: _FOOTER_BYTES - 4], zlib.crc32(summary)) != crc:
        return False
    statistics: Statistics | None = None
    metadata: list[MetadataIndex] = []
    try:
        for opcode, first, last in _records(summary):
            content = ReadDataStream(BytesIO(summary[first:last]))
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                file._define(opcode, summary[first:last])
            elif opcode == Opcode.CHUNK_INDEX:
                index = ChunkIndex.read(content)
                if index.chunk_start_offset + index.chunk_length > start:
                    return False
                file.blocks.append(
                    Block(
                        index.message_start_time,
                        index.message_end_time,
                        index.chunk_start_offset,
                        index.chunk_length,
                        True,
                    )
                )
            elif opcode == Opcode.STATISTICS:
                statistics = Statistics.read(content)
            elif opcode == Opcode.METADATA_INDEX:
                metadata.append(MetadataIndex.read(content))
        if statistics is None or len(file.channels) < statistics.channel_count:
            return False
        if len(file.blocks) != statistics.chunk_count or (statistics.message_count and not file.blocks):
            return False
        file.counts = dict(statistics.channel_message_counts)
        if any(
            channel.schema_id and channel.schema_id not in file.schemas for channel in file.channels.values()
        ):
            return False
        _read_header(file, stream)
        for entry in metadata:
            if len(MAGIC) <= entry.offset and entry.offset + entry.length <= start:
                stream.seek(entry.offset)
                _read_metadata(file, stream.read(entry.length)[_RECORD.size :])
    except _PARSE_ERRORS:
        return False
    return not file.notes


def _read_metadata(file: McapFile, content: bytes) -> None:
    record = Metadata.read(ReadDataStream(BytesIO(content)))
    file.metadata.setdefault(record.name, record.metadata)


def _read_header(file: McapFile, stream: IO[bytes]) -> None:
    stream.seek(len(MAGIC))
    head = stream.read(_RECORD.size)
    if len(head) < _RECORD.size:
        return
    opcode, length = _RECORD.unpack(head)
    if opcode == Opcode.HEADER and length < min(2**16, file.size - stream.tell()):
        header = Header.read(ReadDataStream(BytesIO(stream.read(length))))
        file.library, file.profile = header.library, header.profile


class _PlainRun:
    """Collects consecutive messages outside chunks into blocks."""

    def __init__(self, file: McapFile) -> None:
        self.file = file
        self.start_ns = self.end_ns = self.offset = self.length = 0

    def add(self, offset: int, length: int, log_ns: int) -> None:
        if self.length and (offset != self.offset + self.length or self.length > _PLAIN_BLOCK_BYTES):
            self.close()
        if not self.length:
            self.start_ns = self.end_ns = log_ns
            self.offset = offset
        self.start_ns = min(self.start_ns, log_ns)
        self.end_ns = max(self.end_ns, log_ns)
        self.length += length

    def close(self) -> None:
        if self.length:
            self.file.blocks.append(Block(self.start_ns, self.end_ns, self.offset, self.length, False))
        self.length = 0


def _scan(file: McapFile, stream: IO[bytes]) -> None:
    """Index the file record by record, as far as it goes."""
    position = len(MAGIC)
    run = _PlainRun(file)
    closed = False
    try:
        _read_header(file, stream)
    except _PARSE_ERRORS:
        file.note("holds a damaged header record")
    while position + _RECORD.size <= file.size:
        stream.seek(position)
        head = stream.read(_RECORD.size + _MESSAGE.size)
        opcode, length = _RECORD.unpack_from(head, 0)
        end = position + _RECORD.size + length
        if opcode == 0:
            break
        if end > file.size:
            if opcode == Opcode.CHUNK:
                _index_chunk(file, stream, position, file.size - position)
            break
        if opcode == Opcode.CHUNK:
            _index_chunk(file, stream, position, end - position)
        elif opcode == Opcode.MESSAGE and length >= _MESSAGE.size:
            channel_id, _, log_ns, _ = _MESSAGE.unpack_from(head, _RECORD.size)
            file.counts[channel_id] = file.counts.get(channel_id, 0) + 1
            run.add(position, end - position, log_ns)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and length < MAX_CHUNK_BYTES:
            stream.seek(position + _RECORD.size)
            file._define(opcode, stream.read(length))
        elif opcode == Opcode.METADATA and length < MAX_CHUNK_BYTES:
            stream.seek(position + _RECORD.size)
            try:
                _read_metadata(file, stream.read(length))
            except _PARSE_ERRORS:
                file.note("holds a damaged metadata record, which is left out")
        elif opcode == Opcode.DATA_END:
            closed = True
            break
        position = end
    run.close()
    if closed:
        file.note(
            "the summary at the end is missing or damaged; the messages were found by reading the whole file"
        )
    else:
        file.note(
            f"cut off, not closed or damaged: the record at byte {min(position, file.size)} of {file.size} "
            f"is not whole; {sum(file.counts.values())} messages were found, anything later is missing"
        )


def _index_chunk(file: McapFile, stream: IO[bytes], offset: int, length: int) -> None:
    """Index one chunk by its content: the times in its head may belong to messages that are cut off."""
    times: list[int] = []
    for message in file.load(stream, Block(0, 0, offset, length, True)):
        times.append(message.log_ns)
        file.counts[message.channel_id] = file.counts.get(message.channel_id, 0) + 1
    if times:
        file.blocks.append(Block(min(times), max(times), offset, length, True))
