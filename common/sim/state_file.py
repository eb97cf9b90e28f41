"""The saved state of simulated hardware at one moment, and its file, which survives the process however it ends."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import struct
import threading
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import msgpack
from pydantic import AliasChoices, BaseModel, ConfigDict, Field

from common.atomic_file import Unreadable, open_regular, world_file
from common.sim.interface import KINEMATIC, ObjectSnapshot, SimulatedWorld

SLOT = 4 * 1024 * 1024  # [bytes] for each of the two newest states
CLOSE_SECONDS = 0.3
_HEAD = struct.Struct("<QII")  # number of the state, its length and checksum


class Saver(Protocol):
    """Where the state of the simulated hardware is written."""

    def save(self, state: SimulationState) -> None:
        """Write a state."""

    def close(self) -> None:
        """Write what is not written yet."""


def matching_state(
    state: SimulationState | None, simulator: str, world: SimulatedWorld, dof: int
) -> SimulationState | None:
    """Return a persisted state if it is of this simulator, layout and robot; else None."""
    fits = state is not None and (
        state.simulator == simulator and state.layout == world.layout and len(state.q) == dof)
    return state if fits else None


class SimulationState(BaseModel):
    """Joints (dof,) [rad], fingers [m] and objects at one moment; initial positions (x, y, z) [m].

    Details of objects are specific to the `simulator`.
    """

    model_config = ConfigDict(extra="forbid", populate_by_name=True)

    simulator: str = KINEMATIC
    layout: dict[str, tuple[float, ...]]
    q: list[float]
    width: float | None = None
    commanded_width: float | None = Field(None, validation_alias=AliasChoices("commanded_width", "told_width"))
    commanded_effort: float = Field(0.0, validation_alias=AliasChoices("commanded_effort", "told_effort"))  # [N]
    objects: dict[str, ObjectSnapshot] = {}


class StateFile:
    """Stores the newest state in a file with two alternating slots, of which one is always valid."""

    def __init__(self, path: Path, model: type[SimulationState] | None = None) -> None:
        """Open the file of states of a model, or create it.

        Raises:
            Unreadable: it cannot be opened, or is a symbolic link, which could point to a foreign file.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._descriptor = open_regular(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW)
        except OSError as error:
            raise Unreadable(path, "it is a link" if error.errno == errno.ELOOP else error.strerror or str(error)
                             ) from None
        self._number, self._model = 0, model or SimulationState
        self._packer = msgpack.Packer(default=vars)
        self._packed: dict[str, tuple[object, bytes]] = {}  # packed maps of the newest state, most of which stay equal

    def load(self) -> SimulationState | None:
        """Return the newest valid state, or None."""
        newest: SimulationState | None = None
        for place in (0, SLOT):
            head = os.pread(self._descriptor, _HEAD.size, place)
            if len(head) < _HEAD.size:
                continue
            number, length, checksum = _HEAD.unpack(head)
            body = os.pread(self._descriptor, min(length, SLOT), place + _HEAD.size)
            if number <= self._number or _checksum(number, body) != checksum:
                continue
            try:
                found = self._model.model_validate(msgpack.unpackb(body))
                if _finite(found.model_dump()):  # else positions would be undefined
                    newest, self._number = found, number
            except (ValueError, RecursionError):  # another version, or foreign data
                continue
        return newest

    def save(self, state: SimulationState) -> None:
        """Write a state; it survives this process immediately, but not a crash of the machine."""
        fields = vars(state)
        packed = [self._packer.pack(name) + self._pack(name, value) for name, value in fields.items()]
        body = self._packer.pack_map_header(len(fields)) + b"".join(packed)
        if _HEAD.size + len(body) > SLOT:  # it would overwrite the previous state
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
        """Close the file."""
        os.close(self._descriptor)


class BackgroundSaver:
    """Saves the newest state on a thread: a slow disk blocks no caller."""

    def __init__(self, file: StateFile) -> None:
        """Save to this file."""
        self._file = file
        self._newest: SimulationState | None = None
        self._ends = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="state-file", daemon=True)
        self._thread.start()

    def save(self, state: SimulationState) -> None:
        """Save a state next; replaces one that is not written yet."""
        with self._changed:
            self._newest = state
            self._changed.notify()

    def close(self, seconds: float = CLOSE_SECONDS) -> None:
        """Close the file once everything is written; wait at most this long [s]."""
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
            with contextlib.suppress(OSError):  # a full disk must not stop the arm; the previous state stays
                self._file.save(state)


def _finite(value: object) -> bool:
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else None
    return all(map(_finite, parts)) if parts is not None else not isinstance(value, float) or math.isfinite(value)


def _checksum(number: int, body: bytes) -> int:
    """Checksum including the number: a state written over an older one must not become the newest by accident."""
    return zlib.crc32(body, zlib.crc32(number.to_bytes(8, "little")))


def state_file(
    cell: str, environ: Mapping[str, str] = os.environ, model: type[SimulationState] | None = None
) -> StateFile | None:
    """Return the state file of a cell, or None if no folder is configured."""
    path = world_file(cell, environ)
    return StateFile(path, model) if path else None
