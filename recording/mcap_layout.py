"""Scans an MCAP file record by record, so that a truncated or damaged file can be read too."""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError, UnsupportedCompressionError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from recording.sample import RecordingError

_HEAD = struct.Struct("<BQ")  # opcode, length of the record's content
_CHUNK_HEAD = struct.Struct("<QQQ")  # first and last log time [ns], size before compression
_MESSAGE = struct.Struct("<HIQQ")  # the same, and publish time [ns]
_MESSAGE_HEAD = struct.Struct("<HIQ")  # channel, sequence number, log time [ns]
_PEEK = 64  # [bytes] of a record's content that show whether it is one
_DESCRIPTIONS = (Opcode.METADATA, Opcode.SCHEMA, Opcode.CHANNEL)
_HIGHEST, _PRIVATE = 0x0F, 0x80  # opcodes between these are undefined
_SHORTEST = {Opcode.MESSAGE: 22, Opcode.FOOTER: 20, Opcode.DATA_END: 4, Opcode.STATISTICS: 46}  # [bytes] of content
_RECORD = re.compile(rb"[\x01-\x0f](?=.{5}\0\0\0)", re.DOTALL)  # opcode and length of a record
_CHUNK = re.compile(rb"\x06(?=.{5}\0\0\0)", re.DOTALL)
DAMAGE = (McapError, zstandard.ZstdError, struct.error, ValueError, RuntimeError, MemoryError, OverflowError, EOFError)
LOOSE_BYTES = 512 * 1024  # of messages outside of chunks that are read at once
LONGEST_NAME = 16  # [characters] of a compression
LONGEST_RECORD = 2**40  # [bytes]

# The search for records after damage.
SERIES = 4  # records in a row that no other data forms by chance
WINDOW = 1024 * 1024  # [bytes] that are searched at once
MOST_SEARCHED = 2**27  # [bytes] other than zeros without a record: more than the longest record
MOST_PLACES, MOST_TRIED = 50_000, 2**28  # places with no record, and [bytes] of chunks with a wrong checksum

# No recording exceeds these limits; a file that does was made to exhaust its reader's time or memory.
MOST_CHUNK = 48 * 1024 * 1024  # [bytes] before compression: the largest message has 40 MB
MOST_WINDOW = 2**27  # [bytes] window of the decompressor
MOST_RECORDS = 50_000  # per chunk; the recorder writes 512 kB
MOST_CHANNELS = 5000  # channels and schemas per chunk
MOST_DESCRIBED = 32 * 1024 * 1024  # [bytes] of schemas, channels and metadata outside of chunks
MOST_DESCRIPTIONS = 20_000  # their number
MOST_SHORT, SHORT = 20_000, 24  # records, if their mean size is below 24 bytes: the index of one message has 31
LEAST_MESSAGE, MESSAGES_FREE = 8, 50_000  # [bytes] of the file for each message, and messages that take none
MOST_GROWTH, GROWTH_FREE = 5000, 2**30  # decompressed size over file size, above a decompressed size [bytes]


@dataclass(slots=True)
class ChunkPosition:
    """Where a chunk is, which log times it covers, and which channels have messages in it if the file is indexed.

    Consecutive messages outside of chunks count as a chunk, too.
    """

    offset: int  # [bytes] of its content
    length: int  # [bytes]
    start: int  # log time of its first message [ns]
    end: int  # of its last
    size: int  # before compression [bytes]
    channels: set[int] = field(default_factory=set)
    loose: bool = False  # messages outside of chunks, as rosbag2's `fastwrite` records them


@dataclass
class Layout:
    """Complete records of a file."""

    closed: bool = False  # whether the file has its footer
    complete: int = 0  # [bytes] up to the end of the last complete record
    size: int = 0  # of the file [bytes]
    chunks: list[ChunkPosition] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    holes: list[int] = field(default_factory=list)  # [bytes] of each part before `complete` that has no records

    @property
    def finished(self) -> bool:
        """Whether the file was closed and has no hole."""
        return self.closed and not self.holes

    @property
    def unread(self) -> int:
        """Bytes after the last record."""
        return self.size - self.complete - (len(MCAP0_MAGIC) if self.closed else 0)


def read_layout(file: BinaryIO, path: Path, on_progress: Callable[[float], None] = lambda part: None) -> Layout:
    """Return the layout of a file, which may end anywhere and have holes.

    Raises:
        RecordingError: it is no MCAP file, or exceeds the limits of recordings.
    """
    found = Layout(size=file.seek(0, 2))
    file.seek(0)
    start, limits, search = file.read(len(MCAP0_MAGIC)), _Limits(path, found.size), _Search(file, found)
    here = len(start) if start == MCAP0_MAGIC[: len(start)] else search.record_after(0)
    if here is None:
        raise RecordingError(f"{path}: is no MCAP file")
    if start != MCAP0_MAGIC[: len(start)]:
        found.holes.append(here)
    found.complete = here
    while not found.closed:
        try:
            opcode, length, first = _head(file, here, found.size)
            limits.count(opcode, length, here, first)
            _add_record(found, opcode, here, length, first, file)
            on_progress(here / found.size)
        except DAMAGE:
            after = search.record_after(here + 1)
            if after is None:
                return found
            found.holes.append(after - here)
            here = after
            continue
        here = found.complete = here + _HEAD.size + length
    return found


class _Limits:
    """Rejects files with more or larger records than any real recording has."""

    def __init__(self, path: Path, size: int) -> None:
        self._path, self._size = path, size
        self._count = self._described = self._descriptions = self._grown = 0

    def count(self, opcode: int, length: int, offset: int, first: bytes) -> None:
        self._count += 1
        if opcode in _DESCRIPTIONS:
            self._described, self._descriptions = self._described + length, self._descriptions + 1
        if self._described > MOST_DESCRIBED or self._descriptions > MOST_DESCRIPTIONS:
            raise RecordingError(f"{self._path}: has {self._descriptions:,} descriptions in {self._described:,} B, "
                                 "more than a real recording has")
        if self._count > MOST_SHORT and offset < self._count * SHORT:
            raise RecordingError(f"{self._path}: has {self._count:,} records in its first {offset:,} B, "
                                 "more than a real recording has")
        if opcode == Opcode.CHUNK:
            self._grown += int.from_bytes(first[16:24], "little")  # size before compression
        if self._grown > GROWTH_FREE + MOST_GROWTH * self._size:
            raise RecordingError(f"{self._path}: would have {self._grown:,} B or more without its compression, "
                                 f"from {self._size:,} B")


def _head(file: BinaryIO, offset: int, size: int) -> tuple[int, int, bytes]:
    """Return opcode, length and first bytes of the content of a record.

    Raises:
        DAMAGE: one of these, if there is no record, or its length does not agree with its content or with what follows.
    """
    file.seek(offset)
    data = file.read(_HEAD.size + _PEEK)
    opcode, length = _HEAD.unpack_from(data)
    first, end = data[_HEAD.size :], offset + _HEAD.size + length
    if opcode == 0 or _HIGHEST < opcode < _PRIVATE or end > size:
        raise ValueError
    if opcode == Opcode.CHUNK:  # a wrong length would hide what follows
        compression = int.from_bytes(first[28:32], "little")
        data_length = int.from_bytes(first[32 + compression : 40 + compression], "little")
        if compression > LONGEST_NAME or length != 40 + compression + data_length:
            raise ValueError
    elif opcode == Opcode.MESSAGE_INDEX:
        if length != 6 + int.from_bytes(first[2:6], "little"):
            raise ValueError
    elif length < _SHORTEST.get(opcode, 0) or not _begins_record(file, end):
        raise ValueError
    return opcode, length, first


def _begins_record(file: BinaryIO, offset: int) -> bool:
    """Whether a record could begin at an offset: it does, the file ends, or a hole of zeros begins."""
    file.seek(offset)
    data = file.read(_HEAD.size)
    if len(data) < _HEAD.size or data == bytes(_HEAD.size) or data.startswith(MCAP0_MAGIC):
        return True
    opcode, length = _HEAD.unpack(data)
    return bool(0 < opcode <= _HIGHEST or opcode >= _PRIVATE) and bool(length < LONGEST_RECORD)


def _add_record(found: Layout, opcode: int, offset: int, length: int, first: bytes, file: BinaryIO) -> None:
    content = offset + _HEAD.size
    if opcode == Opcode.CHUNK:
        start, end, size = _CHUNK_HEAD.unpack_from(first)
        found.chunks.append(ChunkPosition(content, length, start, end, size))
    elif opcode == Opcode.MESSAGE_INDEX and found.chunks:
        found.chunks[-1].channels.add(int.from_bytes(first[:2], "little"))
    elif opcode == Opcode.MESSAGE:
        channel, _, log_time = _MESSAGE_HEAD.unpack_from(first)
        last = found.chunks[-1] if found.chunks else None
        if last is None or not last.loose or last.offset + last.length != offset or last.length > LOOSE_BYTES:
            last = ChunkPosition(offset, 0, log_time, log_time, 0, loose=True)
            found.chunks.append(last)
        last.length = last.size = last.length + _HEAD.size + length
        last.start, last.end = min(last.start, log_time), max(last.end, log_time)
        last.channels.add(channel)
    elif opcode in _DESCRIPTIONS:
        file.seek(content)
        stream = ReadDataStream(BytesIO(file.read(length)))
        if opcode == Opcode.METADATA:
            found.metadata.append(Metadata.read(stream))
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            found.schemas[schema.id] = schema
        else:
            channel_ = Channel.read(stream)
            found.channels[channel_.id] = channel_
    elif opcode == Opcode.FOOTER:
        file.seek(content + length)
        found.closed = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC


class _Search:
    """Finds the next record after damage, until it tried more places than any real file needs."""

    def __init__(self, file: BinaryIO, found: Layout) -> None:
        self._file, self._found = file, found
        self._places, self._bytes = MOST_PLACES, MOST_TRIED
        self._loose: bool | None = None  # whether messages are outside of chunks; unknown before the first damage

    def record_after(self, offset: int) -> int | None:
        """Return the offset of the next chunk with the right checksum, or of the next series of other records.

        Messages of a destroyed chunk do not count: no checksum shows whether they are complete.
        """
        if self._loose is None:
            has_chunk = any(not chunk.loose for chunk in self._found.chunks)
            self._loose = not has_chunk and self._next(offset, _CHUNK, self._is_chunk) is None
        return self._next(offset, _RECORD, self._is_record)

    def _next(self, offset: int, pattern: re.Pattern[bytes], accepts: Callable[[int], bool]) -> int | None:
        for place in self._candidates(offset, pattern):
            if self._places < 0 or self._bytes < 0:
                return None
            self._places -= 1
            try:
                if accepts(place):
                    return place
            except DAMAGE:
                pass
        return None

    def _candidates(self, offset: int, pattern: re.Pattern[bytes]) -> Iterator[int]:
        """Yield places where an opcode and a small length may be."""
        searched = 0
        while (offset := self._data_after(offset)) < self._found.size and searched < MOST_SEARCHED:
            self._file.seek(offset)
            window = self._file.read(WINDOW + _HEAD.size - 1)
            if window != bytes(len(window)):  # zeros may be many
                searched += len(window)
                for match in pattern.finditer(window):
                    yield offset + match.start()
            offset += WINDOW

    def _data_after(self, offset: int) -> int:
        """Return the offset of the next bytes that the file system stores: a sparse file has terabytes of others."""
        file = self._file.fileno()
        before = os.lseek(file, 0, os.SEEK_CUR)  # the buffered file relies on it
        try:
            return os.lseek(file, offset, os.SEEK_DATA)
        except OSError:
            return self._found.size
        finally:
            os.lseek(file, before, os.SEEK_SET)

    def _is_chunk(self, offset: int) -> bool:
        opcode, length, first = _head(self._file, offset, self._found.size)
        if opcode != Opcode.CHUNK:
            return False
        start, end, size = _CHUNK_HEAD.unpack_from(first)
        cost = length + min(size, MOST_CHUNK)
        self._bytes -= cost
        records_of(self._file, ChunkPosition(offset + _HEAD.size, length, start, end, size))
        self._bytes += cost
        return True

    def _is_record(self, offset: int) -> bool:
        if self._is_chunk(offset):
            return True
        known = self._found.channels
        for _ in range(SERIES):
            opcode, length, first = _head(self._file, offset, self._found.size)
            if opcode == Opcode.MESSAGE and (
                not self._loose or (known and int.from_bytes(first[:2], "little") not in known)
            ):
                return False
            offset += _HEAD.size + length
            if offset == self._found.size or opcode == Opcode.FOOTER:
                return True
        return True


def records_of(file: BinaryIO, position: ChunkPosition) -> list[McapRecord]:
    """Return the schemas, channels and messages of a chunk.

    Raises:
        DAMAGE: one of these, if the chunk is damaged or too large.
    """
    if position.size > MOST_CHUNK or position.length > position.size + MOST_CHUNK:
        raise ValueError
    file.seek(position.offset)
    data = file.read(position.length)
    if len(data) < position.length:
        raise EOFError
    if position.loose:
        return list(_records(data))
    chunk = Chunk.read(ReadDataStream(BytesIO(data)))
    contents = _decompressed(chunk)
    if chunk.uncompressed_crc and zlib.crc32(contents) != chunk.uncompressed_crc:
        raise ValueError
    return list(_records(contents))


def _decompressed(chunk: Chunk) -> bytes:
    """Return the contents of a chunk, decompressing no more than its declared size."""
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor(max_window_size=MOST_WINDOW).stream_reader(chunk.data) as stream:
            data = stream.read(size + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression:
        raise UnsupportedCompressionError(chunk.compression)
    else:
        data = chunk.data
    if len(data) != size:
        raise ValueError
    return bytes(data)


def _records(contents: bytes) -> Iterator[McapRecord]:
    """Yield schemas, channels and messages; by hand, since mcap takes ten times as long for a message."""
    at = described = 0
    for _ in range(MOST_RECORDS):
        if at >= len(contents):
            return
        opcode, length = _HEAD.unpack_from(contents, at)
        at, end = at + _HEAD.size, at + _HEAD.size + length
        if end > len(contents):
            raise EOFError
        described += opcode in _DESCRIPTIONS
        if described > MOST_CHANNELS:
            raise ValueError
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(contents, at)
            if length < _MESSAGE.size:
                raise ValueError
            yield Message(channel, log_time, contents[at + _MESSAGE.size : end], publish_time, sequence)
        elif opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
            stream = ReadDataStream(BytesIO(contents[at:end]))
            yield Channel.read(stream) if opcode == Opcode.CHANNEL else Schema.read(stream)
        at = end
    raise ValueError
