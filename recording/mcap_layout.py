"""Scans an MCAP file record by record, so that a truncated or damaged file can be read too."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
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
_DESCRIPTIONS = (Opcode.METADATA, Opcode.SCHEMA, Opcode.CHANNEL)
_HIGHEST, _PRIVATE = 0x0F, 0x80  # opcodes between these are undefined
DAMAGE = (McapError, zstandard.ZstdError, struct.error, ValueError, RuntimeError, MemoryError, OverflowError, EOFError)

# No recording exceeds these limits; a file that does was made to exhaust its reader's time or memory.
MOST_CHUNK = 48 * 1024 * 1024  # [bytes] before compression: the largest message has 40 MB
MOST_WINDOW = 2**27  # [bytes] window of the decompressor
MOST_RECORDS = 50_000  # per chunk; the recorder writes 512 kB
MOST_CHANNELS = 5000  # channels and schemas per chunk
MOST_DESCRIBED = 32 * 1024 * 1024  # [bytes] of schemas, channels and metadata outside of chunks
MOST_DESCRIPTIONS = 20_000  # their number
MOST_SHORT, SHORT = 20_000, 24  # records, if their mean size is below 24 bytes: the index of one message has 31
MOST_GROWTH, GROWTH_FREE = 5000, 2**30  # decompressed size over file size, above a decompressed size [bytes]


@dataclass
class ChunkPosition:
    """Where a chunk is, which log times it covers, and which channels have messages in it if the file is indexed."""

    offset: int  # [bytes] of its content
    length: int  # [bytes]
    start: int  # log time of its first message [ns]
    end: int  # of its last
    size: int  # before compression [bytes]
    channels: set[int] = field(default_factory=set)


@dataclass
class Layout:
    """Complete records of a file."""

    finished: bool = False  # whether the file has its footer
    complete: int = 0  # [bytes] from the start that are complete records
    size: int = 0  # of the file [bytes]
    chunks: list[ChunkPosition] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    loose_messages: int = 0  # outside of chunks, as other programs may write them


def read_layout(file: BinaryIO, path: Path) -> Layout:
    """Return the layout of a file, which may end anywhere.

    Raises:
        RecordingError: it is no MCAP file, or exceeds the limits of recordings.
    """
    count = described = descriptions = grown = 0
    found = Layout(size=file.seek(0, 2))
    file.seek(0)
    start = file.read(len(MCAP0_MAGIC))
    if start != MCAP0_MAGIC[: len(start)]:
        raise RecordingError(f"{path}: is no MCAP file")
    found.complete = len(start)
    if len(start) < len(MCAP0_MAGIC):
        return found
    while True:
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            return found
        opcode, length = _HEAD.unpack(head)
        content = found.complete + _HEAD.size
        if content + length > found.size or opcode == 0 or _HIGHEST < opcode < _PRIVATE:
            return found
        count += 1
        if opcode in _DESCRIPTIONS:
            described, descriptions = described + length, descriptions + 1
        if described > MOST_DESCRIBED or descriptions > MOST_DESCRIPTIONS:
            raise RecordingError(f"{path}: has {descriptions:,} descriptions in {described:,} B, "
                                 "more than a real recording has")
        if count > MOST_SHORT and content < count * SHORT:
            raise RecordingError(f"{path}: has {count:,} records in its first {content:,} B, "
                                 "more than a real recording has")
        try:
            _add_record(found, opcode, content, length, file)
        except DAMAGE:
            return found
        if opcode == Opcode.CHUNK:
            grown += found.chunks[-1].size
            if grown > GROWTH_FREE + MOST_GROWTH * found.size:
                raise RecordingError(f"{path}: would have {grown:,} B or more without its compression, "
                                     f"from {found.size:,} B")
        found.complete = content + length
        if opcode == Opcode.FOOTER:
            file.seek(found.complete)
            found.finished = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
            return found
        file.seek(found.complete)


def _add_record(found: Layout, opcode: int, content: int, length: int, file: BinaryIO) -> None:
    if opcode == Opcode.CHUNK:
        start, end, size = _CHUNK_HEAD.unpack(file.read(_CHUNK_HEAD.size))
        found.chunks.append(ChunkPosition(content, length, start, end, size))
    elif opcode == Opcode.MESSAGE_INDEX and found.chunks:
        found.chunks[-1].channels.add(int.from_bytes(file.read(2), "little"))
    elif opcode == Opcode.MESSAGE:
        found.loose_messages += 1
    elif opcode in _DESCRIPTIONS:
        stream = ReadDataStream(BytesIO(file.read(length)))
        if opcode == Opcode.METADATA:
            found.metadata.append(Metadata.read(stream))
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            found.schemas[schema.id] = schema
        else:
            channel = Channel.read(stream)
            found.channels[channel.id] = channel


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
    stream = ReadDataStream(BytesIO(contents))
    described = 0
    for _ in range(MOST_RECORDS):
        if stream.count >= len(contents):
            return
        opcode, length = stream.read1(), stream.read8()
        if length > len(contents) - stream.count:
            raise EOFError
        described += opcode in _DESCRIPTIONS
        if described > MOST_CHANNELS:
            raise ValueError
        if opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
        elif opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        else:
            stream.read(length)
    raise ValueError
