"""What lies where in an MCAP file, found by walking over its records; so that a file that was cut can be read too."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

from common.recording.sample import RecordingError

_HEAD = struct.Struct("<BQ")  # opcode, length of what follows
_CHUNK_HEAD = struct.Struct("<QQQ")  # first and last log time [ns], size before compression
_HIGHEST, _PRIVATE = 0x0F, 0x80  # opcodes beyond and below these are nobody's
DAMAGE = (McapError, zstandard.ZstdError, struct.error, ValueError, MemoryError, OverflowError, EOFError)


@dataclass
class ChunkPlace:
    """Where a chunk lies, which time it covers and which channels have messages in it, where the file says so."""

    offset: int  # [bytes] of its contents
    length: int  # [bytes]
    start: int  # log time of its first message [ns]
    end: int  # of its last
    size: int  # before compression [bytes]
    channels: set[int] = field(default_factory=set)


@dataclass
class Layout:
    """The records of a file as far as they are whole."""

    finished: bool = False  # down to the footer: nobody was interrupted
    whole: int = 0  # bytes from the front that are whole records
    size: int = 0  # of the file [bytes]
    chunks: list[ChunkPlace] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    loose_messages: int = 0  # outside of chunks, as other programs may write them


def layout_of(file: BinaryIO, path: Path) -> Layout:
    """What lies where in a file, which may end anywhere.

    Raises:
        RecordingError: it is no MCAP file.
    """
    found = Layout(size=file.seek(0, 2))
    file.seek(0)
    front = file.read(len(MCAP0_MAGIC))
    if front != MCAP0_MAGIC[: len(front)]:
        raise RecordingError(f"{path}: is no MCAP file")
    found.whole = len(front)
    if len(front) < len(MCAP0_MAGIC):
        return found
    while True:
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            return found
        opcode, length = _HEAD.unpack(head)
        begin = found.whole + _HEAD.size
        if begin + length > found.size or opcode == 0 or _HIGHEST < opcode < _PRIVATE:
            return found
        try:
            _note(found, opcode, begin, length, file)
        except DAMAGE:
            return found
        found.whole = begin + length
        if opcode == Opcode.FOOTER:
            file.seek(found.whole)
            found.finished = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
            return found
        file.seek(found.whole)


def _note(found: Layout, opcode: int, begin: int, length: int, file: BinaryIO) -> None:
    if opcode == Opcode.CHUNK:
        start, end, size = _CHUNK_HEAD.unpack(file.read(_CHUNK_HEAD.size))
        found.chunks.append(ChunkPlace(begin, length, start, end, size))
    elif opcode == Opcode.MESSAGE_INDEX and found.chunks:
        found.chunks[-1].channels.add(int.from_bytes(file.read(2), "little"))
    elif opcode == Opcode.MESSAGE:
        found.loose_messages += 1
    elif opcode in (Opcode.METADATA, Opcode.SCHEMA, Opcode.CHANNEL):
        stream = ReadDataStream(BytesIO(file.read(length)))
        if opcode == Opcode.METADATA:
            found.metadata.append(Metadata.read(stream))
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            found.schemas[schema.id] = schema
        else:
            channel = Channel.read(stream)
            found.channels[channel.id] = channel


def records_of(file: BinaryIO, place: ChunkPlace) -> list[McapRecord]:
    """The schemas, channels and messages of a chunk.

    Raises:
        DAMAGE: any of these, when the chunk is damaged.
    """
    file.seek(place.offset)
    data = file.read(place.length)
    if len(data) < place.length:
        raise EOFError
    chunk = Chunk.read(ReadDataStream(BytesIO(data)))
    return breakup_chunk(chunk, validate_crc=True)


