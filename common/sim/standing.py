"""What stays as it is while the process that simulates it is gone: an arm with its brakes on, and things that lie.

Real hardware and a real table do not go back to their beginnings when a driver is started again. So that simulated
ones do not either, their state is kept in a file, which survives the process however it ends.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import socket
import struct
import threading
import zlib
from collections.abc import Mapping
from pathlib import Path

import msgpack
from pydantic import BaseModel, ConfigDict

from common.atomic_file import Unreadable, open_regular, runtime_folder
from common.sim.interface import KINEMATIC, StandingObject

SLOT = 4 * 1024 * 1024  # [bytes] for each of the two newest states
CLOSE_SECONDS = 0.3
_HEAD = struct.Struct("<QII")  # number of the state, its length and checksum


class Standing(BaseModel):
    """Joints (dof,) [rad], fingers [m] and objects at one moment; where objects were at first (x, y, z) [m].

    How objects stand is told in the words of the `simulator`, which no other one knows.
    """

    model_config = ConfigDict(extra="forbid")

    simulator: str = KINEMATIC
    layout: dict[str, tuple[float, ...]]
    q: list[float]
    width: float | None = None
    told_width: float | None = None
    told_effort: float = 0.0  # [N]
    objects: dict[str, StandingObject] = {}


class StateFile:
    """Keeps the newest state in a file: two places are written in turn, so that one of them is always whole."""

    def __init__(self, path: Path) -> None:
        """Open the file, which need not be there yet.

        Raises:
            Unreadable: it cannot be opened, or is a link, which may be to something of somebody else's.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._descriptor = open_regular(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW)
        except OSError as error:
            raise Unreadable(path, "it is a link" if error.errno == errno.ELOOP else error.strerror or str(error)
                             ) from None
        self._number = 0
        self._packer = msgpack.Packer(default=vars)
        self._packed: dict[str, tuple[object, bytes]] = {}  # of the maps in the newest state, most of which stay

    def load(self) -> Standing | None:
        """The newest state that is whole; None when there is none."""
        newest: Standing | None = None
        for place in (0, SLOT):
            head = os.pread(self._descriptor, _HEAD.size, place)
            if len(head) < _HEAD.size:
                continue
            number, length, checksum = _HEAD.unpack(head)
            body = os.pread(self._descriptor, min(length, SLOT), place + _HEAD.size)
            if number <= self._number or _checksum(number, body) != checksum:
                continue
            try:
                found = Standing.model_validate(msgpack.unpackb(body))
                if _finite(found.model_dump()):  # else nothing could be put there
                    newest, self._number = found, number
            except (ValueError, RecursionError):  # of another version, or nobody's
                continue
        return newest

    def save(self, state: Standing) -> None:
        """Write a state, which outlives this process at once, but not the machine."""
        fields = vars(state)
        packed = [self._packer.pack(name) + self._pack(name, value) for name, value in fields.items()]
        body = self._packer.pack_map_header(len(fields)) + b"".join(packed)
        if _HEAD.size + len(body) > SLOT:  # it must not be written over the one before
            return
        self._number += 1
        place = SLOT * (self._number % 2)
        os.pwrite(self._descriptor, _HEAD.pack(self._number, len(body), _checksum(self._number, body)) + body, place)

    def _pack(self, name: str, value: object) -> bytes:
        before, packed = self._packed.get(name, (None, b""))
        if value is not before or not isinstance(value, dict):
            packed = self._packer.pack(value)
            self._packed[name] = value, packed
        return packed

    def close(self) -> None:
        """Close the file, which stays."""
        os.close(self._descriptor)


class SavedBeside:
    """Saves the newest state from a thread of its own: a disk that takes its time holds nobody."""

    def __init__(self, file: StateFile) -> None:
        """Save to this file."""
        self._file = file
        self._newest: Standing | None = None
        self._ends = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="standing", daemon=True)
        self._thread.start()

    def save(self, state: Standing) -> None:
        """Have a state written next, in place of one that still waits for that."""
        with self._changed:
            self._newest = state
            self._changed.notify()

    def close(self, seconds: float = CLOSE_SECONDS) -> None:
        """Close the file when all is written; wait for that at most so long [s]."""
        with self._changed:
            self._ends = True
            self._changed.notify()
        self._thread.join(seconds)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None or self._ends)
                state, self._newest = self._newest, None
            if state is None:
                return self._file.close()
            with contextlib.suppress(OSError):  # a full disk stops no arm; what was kept before stays
                self._file.save(state)


def _finite(kept: object) -> bool:
    parts = kept.values() if isinstance(kept, dict) else kept if isinstance(kept, list | tuple) else None
    return all(map(_finite, parts)) if parts is not None else not isinstance(kept, float) or math.isfinite(kept)


def _checksum(number: int, body: bytes) -> int:
    """Of the number too: one that was written over an older state must not make it the newest."""
    return zlib.crc32(body, zlib.crc32(number.to_bytes(8, "little")))


def state_file(cell: str, environ: Mapping[str, str] = os.environ) -> StateFile | None:
    """The file of a cell's simulated hardware; None when nobody has said where it is to be kept.

    Its name has that of the host: a container that is started again has the same one, a new one has not.
    """
    folder = runtime_folder(environ)
    return StateFile(folder / f"{cell}-{socket.gethostname()}.state") if folder else None
