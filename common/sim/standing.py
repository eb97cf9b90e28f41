"""What stays as it is while the process that simulates it is gone: an arm with its brakes on, and things that lie.

Real hardware and a real table do not go back to their beginnings when a driver is started again. So that simulated
ones do not either, their state is kept in a file, which survives the process however it ends.
"""

from __future__ import annotations

import os
import socket
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path

import msgpack
from pydantic import BaseModel, ConfigDict

from common.sim.interface import StandingObject

STATE_VARIABLE = "ZENCELL_STATE"  # folder for what is kept, this and what persons decided
STANDING_VARIABLE = "ZENCELL_STANDING"  # folder for this alone; without both nothing is kept
SLOT = 256 * 1024  # [bytes] for each of the two newest states
_HEAD = struct.Struct("<QII")  # number of the state, its length and checksum


class Standing(BaseModel):
    """Joints (dof,) [rad], fingers [m] and objects at one moment; where objects were at first (x, y, z) [m]."""

    model_config = ConfigDict(extra="forbid")

    layout: dict[str, tuple[float, ...]]
    q: list[float]
    width: float | None = None
    told_width: float | None = None
    objects: dict[str, StandingObject] = {}


class StateFile:
    """Keeps the newest state in a file: two places are written in turn, so that one of them is always whole."""

    def __init__(self, path: Path) -> None:
        """Open the file, which need not be there yet."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        self._number = 0

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
                newest, self._number = Standing.model_validate(msgpack.unpackb(body)), number
            except ValueError:  # of another version
                continue
        return newest

    def save(self, state: Standing) -> None:
        """Write a state, which outlives this process at once, but not the machine."""
        body = msgpack.packb(state, default=vars)
        self._number += 1
        place = SLOT * (self._number % 2)
        os.pwrite(self._descriptor, _HEAD.pack(self._number, len(body), _checksum(self._number, body)) + body, place)

    def close(self) -> None:
        """Close the file, which stays."""
        os.close(self._descriptor)


def _checksum(number: int, body: bytes) -> int:
    """Of the number too: one that was written over an older state must not make it the newest."""
    return zlib.crc32(body, zlib.crc32(number.to_bytes(8, "little")))


def state_file(cell: str, environ: Mapping[str, str] = os.environ) -> StateFile | None:
    """The file of a cell's simulated hardware; None when nobody has said where it is to be kept.

    Its name has that of the host: a container that is started again has the same one, a new one has not.
    """
    folder = environ.get(STANDING_VARIABLE) or environ.get(STATE_VARIABLE)
    return StateFile(Path(folder) / f"{cell}-{socket.gethostname()}.state") if folder else None
