"""Index of the chunks of an MCAP file, read from the file itself when it is closed.

mcap's writer holds an entry for each chunk until then: 640 bytes, with cameras 30 times a second, so that the memory of
a recorder would grow by 140 MB in two hours.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from typing import Any

from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from mcap.writer import Writer

_RECORD = struct.Struct("<BQ")  # opcode, length of the content
_CHUNK = struct.Struct("<QQQII")  # first and last log time, size before compression, checksum, length of a name
_MAGIC = 8  # [bytes] at the start of a file


class ChunkIndexes:
    """Replaces the list of a `Writer`: what is appended is forgotten, and read back by an iteration."""

    def __init__(self, file: int, size: Callable[[], int]) -> None:
        """Read an open file.

        Args:
            file: descriptor with read access.
            size: returns how many bytes have been written.
        """
        self._file, self._size = file, size

    def install(self, writer: Writer) -> None:
        """Replace the list of a writer that has not started, by the private name that mcap 1 gives it.

        Raises:
            AttributeError: this version of mcap has another one.
        """
        name = "_Writer__chunk_indices"
        getattr(writer, name)
        setattr(writer, name, self)

    def append(self, index: Any) -> None:
        """Forget an entry."""

    def __iter__(self) -> Iterator[ChunkIndex]:
        """Yield the entry of each chunk in the file."""
        offset, end, found = _MAGIC, self._size(), None
        while offset < end:
            head = os.pread(self._file, _RECORD.size + _CHUNK.size + 32, offset)
            opcode, length = _RECORD.unpack_from(head)
            length += _RECORD.size
            if opcode == Opcode.MESSAGE_INDEX and found is not None:
                channel = int.from_bytes(head[_RECORD.size : _RECORD.size + 2], "little")
                found.message_index_offsets[channel] = offset
                found.message_index_length += length
            else:
                if found is not None:
                    yield found
                found = _entry(head, offset, length) if opcode == Opcode.CHUNK else None
            offset += length
        if found is not None:
            yield found


def _entry(head: bytes, offset: int, length: int) -> ChunkIndex:
    """Return the entry of a chunk without its message indexes, which follow in the file."""
    start, end, size, _, name_length = _CHUNK.unpack_from(head, _RECORD.size)
    name_at = _RECORD.size + _CHUNK.size
    name = head[name_at : name_at + name_length].decode()
    overhead = name_at + name_length + 8
    return ChunkIndex(
        chunk_start_offset=offset, chunk_length=length, message_start_time=start, message_end_time=end,
        message_index_offsets={}, message_index_length=0, compression=name, compressed_size=length - overhead,
        uncompressed_size=size)
