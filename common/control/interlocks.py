"""Interlocks: stops, holds and blocked goals that keep the robot from moving, and the file in which they persist.

Interlocks of operators, the speed set by an operator and an unrecovered safety stop persist over restarts of the
executor and the machine. Holds of the watchdog, the scene monitor, the coordinator of several arms and the controller
do not.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import re
import socket
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Literal, Self
from zlib import crc32

from filelock import FileLock, Timeout
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from common.atomic_file import STATE_VARIABLE, AtomicFile, Unreadable, state_folder
from common.errors import ConfigError, Refused
from common.messages import UNKNOWN_OPERATOR, HoldRequest, Interlock, StopRequest
from common.messages.basics import either_name
from common.messages.execution import NOT_PERSISTED
from common.time_source import monotonic, wall_ns

OTHERS = "others"  # name of the shared entry when there are too many
MAX_ENTRIES = 16  # interlocks of operators
MAX_REASON = 300  # characters
MAX_GOALS = 200  # ids of stopped goals
AHEAD = 10 * 10**9  # [ns] that the clock of a client may be ahead
SLOWEST = 0.05  # speed scaling when the persisted one cannot be read
STOPPED = "stopped"
LATEST = 7 * 10**18  # [ns since the Unix epoch], in the year 2191: a later `since` leaves no room for those after it
RETRY_PERIOD = 1.0  # [s] after interlocks could not be written
LOCK_TIMEOUT = 3.0  # [s] for a process that is just ending: it brakes first
LOCK_PERIOD = 0.02  # [s] between two attempts to get the lock
HOLDER_ROOM = 512  # [bytes] for the name of the holder in the lock file
UNSAFE = re.compile(r"[^A-Za-z0-9._-]")  # in the name of a file


def _not_late(interlock: Interlock) -> Interlock:
    if interlock.since > LATEST:
        raise ValueError(f"since {interlock.since} is later than {LATEST}")
    return interlock


class Speed(BaseModel):
    """Speed scaling of trajectories as an operator set it while the cell ran."""

    model_config = ConfigDict(extra="forbid")

    scaling: float = Field(ge=0, le=1)
    configured: float | None = Field(None, ge=0, le=1)  # value of the cell file at that time


class Record(BaseModel):
    """What persists. Files of earlier versions have `inhibits` for `interlocks`."""

    model_config = ConfigDict(extra="forbid")

    version: Literal[1] = 1
    interlocks: list[Annotated[Interlock, AfterValidator(_not_late)]] = Field(
        [], max_length=2 * MAX_ENTRIES - 8, validation_alias=either_name("interlocks"))  # leaves room for our own
    goals: list[str] = Field([], max_length=MAX_GOALS)
    speed: Speed | None = None
    newest: int = Field(0, ge=0, le=LATEST)  # `since` of the newest interlock there ever was
    arm_stopped: bool = False  # by a safety stop of the arm's own controller from which no operator has recovered it
    checksum: int | None = None  # CRC-32 of the rest; records of earlier versions have none

    @model_validator(mode="after")
    def _check(self) -> Self:
        expected = crc32(self.model_dump_json(exclude={"checksum"}).encode())
        if self.checksum not in (None, expected):
            raise ValueError("the checksum does not match")
        self.checksum = expected
        return self


class Interlocks:
    """All interlocks in force. Without a clock and without a file."""

    def __init__(self, record: Record | None = None, now: Callable[[], int] = wall_ns) -> None:
        """Start with a persisted record; `now` returns the time since the Unix epoch [ns]."""
        record = record or Record()
        self._by_operators = {(interlock.kind, interlock.by): interlock for interlock in record.interlocks}
        self._internal: dict[str, Interlock] = {}  # of watchdog, scene monitor and controller
        self._goals = dict.fromkeys(record.goals)
        self._newest = record.newest
        self._now = now
        self._problem, self._saved = "", record.interlocks
        self.speed, self.arm_stopped = record.speed, record.arm_stopped

    @property
    def record(self) -> Record:
        """What must persist."""
        return Record(interlocks=[*self._by_operators.values()], goals=[*self._goals], speed=self.speed,
                      newest=self._newest, arm_stopped=self.arm_stopped)

    @property
    def all(self) -> list[Interlock]:
        """All interlocks; the reason of one that is not on disk yet starts with that."""
        return [*map(self._with_problem, self._by_operators.values()), *self._internal.values()]

    @property
    def holds(self) -> list[Interlock]:
        """Holds of operators."""
        return [interlock for interlock in self._by_operators.values() if interlock.kind == "held"]

    @property
    def stops(self) -> list[Interlock]:
        """Stops of operators."""
        return [interlock for interlock in self._by_operators.values() if interlock.kind == "stopped"]

    def note_saved(self, record: Record, problem: str = "") -> None:
        """Record what is on disk, and why the rest is not."""
        self._problem, self._saved = problem, record.interlocks

    def stop(self, request: StopRequest) -> None:
        """Add the stop of an operator."""
        self._put("stopped", request.owner, request.reason)

    def hold(self, request: HoldRequest) -> list[Interlock]:
        """Add a hold, or release interlocks; return those of operators that were released."""
        if request.by != "operator":
            self.set_internal_hold(request.by, request.hold, request.reason)
            return []
        if request.hold:
            self._put("held", request.owner, request.reason)
            return []
        latest = max(self._newest, self._now() + AHEAD)
        released = [interlock for interlock in self._by_operators.values() if _releases(request, interlock, latest)]
        for interlock in released:
            del self._by_operators[interlock.kind, interlock.by]
            by = (request.owner or UNKNOWN_OPERATOR) if interlock.by == UNKNOWN_OPERATOR else interlock.by
            if request.into_stop and ("stopped", by) not in self._by_operators:
                self._by_operators["stopped", by] = interlock.model_copy(update={"kind": "stopped", "by": by})
        return released

    def set_internal_hold(self, holder: str, hold: bool, reason: str) -> None:
        """Add or release a hold of watchdog, scene monitor or controller."""
        if hold:
            self._internal[holder] = self._create("held", holder, reason)
        else:
            self._internal.pop(holder, None)

    def block_goals(self, goals: Iterable[str]) -> None:
        """Block goals that must never move the robot, even if they arrive later or again; keep the newest 200."""
        for goal in goals:
            self._goals.pop(goal, None)
            self._goals[goal] = None
        while len(self._goals) > MAX_GOALS:
            del self._goals[next(iter(self._goals))]

    def check(self, goal: str, owner: str = "", acknowledged: int | None = None) -> Refused | None:
        """Return why a motion of arm or fingers is blocked, or None.

        Args:
            goal: its id.
            owner: the operator who requests it. Stops of this operator do not block it if the operator knew them;
                a stop without a name blocks every motion until it is released.
            acknowledged: `since` of the newest interlock that the operator knew.
        """
        if goal in self._goals:
            return Refused(STOPPED, f"goal {goal!r} was stopped before")
        named = owner not in ("", UNKNOWN_OPERATOR, OTHERS)
        # An acknowledgement of what was never published acknowledges nothing.
        known = acknowledged if named and acknowledged is not None and acknowledged <= self._newest else 0
        stops = [stop for stop in self.stops if stop.by != owner or stop.since > known]
        return Refused(STOPPED, "; ".join(stop.description for stop in stops)) if stops else None

    def _with_problem(self, interlock: Interlock) -> Interlock:
        if not self._problem or interlock in self._saved:
            return interlock
        reason = f"{NOT_PERSISTED} ({self._problem}), lost if the executor ends"
        reason += interlock.reason and f"; {interlock.reason}"
        return interlock.model_copy(update={"reason": reason[:MAX_REASON]})

    def _put(self, kind: Literal["stopped", "held"], owner: str, reason: str) -> None:
        by = owner or UNKNOWN_OPERATOR
        if (kind, by) not in self._by_operators and len(self._by_operators) >= MAX_ENTRIES:
            by = OTHERS
        self._by_operators[kind, by] = self._create(kind, by, reason)

    def _create(self, kind: Literal["stopped", "held"], by: str, reason: str) -> Interlock:
        self._newest = max(self._newest + 1, self._now())
        return Interlock(kind=kind, by=by, reason=reason[:MAX_REASON], since=self._newest)


def _releases(request: HoldRequest, interlock: Interlock, latest: int) -> bool:
    """Return whether a request releases an interlock; an acknowledgement later than `latest` acknowledges nothing."""
    if request.acknowledged is None and interlock.kind == "stopped":
        return False
    if request.acknowledged is not None and not interlock.since <= request.acknowledged <= latest:
        return False  # added after the operator decided on that request
    if request.override:
        return True
    if interlock.kind == "stopped":
        return request.stops
    return interlock.by in (request.owner, UNKNOWN_OPERATOR)


def effective_speed(saved: Speed | None, configured: float) -> float:
    """Return the speed scaling: the saved one, or the slower of both if another one was configured since."""
    if saved is None:
        return configured
    return saved.scaling if saved.configured == configured else min(saved.scaling, configured)


# --- the file ---


class InterlockFile(AtomicFile[Record]):
    """The file of a cell. One that cannot be read keeps the robot from moving."""

    def __init__(self, path: Path) -> None:
        """Use this file, which need not exist yet."""
        super().__init__(path, Record)

    def require_writable(self) -> None:
        """Return if the file can be written, from now on also on a full disk.

        Raises:
            ConfigError: it cannot.
        """
        try:
            record, problem = self.load()
            if not problem:  # else it stays for inspection
                self.save(record)
            self.make_room(record)
        except OSError as error:
            raise _not_writable(self.path, error) from None

    def load(self) -> tuple[Record, str]:
        """Return the record, and the problem of an unreadable file: then the record stops the robot and slows it."""
        try:
            record = self.find()
            if record is None and os.path.lexists(self._new):
                raise Unreadable(self.path, "it was removed")
            return record or Record(), ""
        except Unreadable as error:
            reason = f"the saved interlocks cannot be read: {error.path}: {error.why}. Check the cell before a start"
            stop = Interlock(kind="stopped", by="trajectory_executor", reason=reason[:MAX_REASON], since=wall_ns())
            return Record(interlocks=[stop], speed=Speed(scaling=SLOWEST), newest=stop.since, arm_stopped=True), (
                str(error))


def interlock_file(cell: str, arm: str | None = None, environ: Mapping[str, str] = os.environ) -> InterlockFile:
    """Return the file of a cell, or of a real arm, which may be part of several cells; the names are of early versions.

    The first use for a real arm takes over the file of the cell, where interlocks of a real arm were before.

    Args:
        cell: its name.
        arm: identity of a real arm, else None.
        environ: environment variables.

    Raises:
        ConfigError: there is no folder for it, or the file of the cell cannot be taken over.
    """
    folder = state_folder(environ)
    of_cell = folder / f"{cell}.inhibits.json"
    if arm is None:
        return InterlockFile(of_cell)
    of_arm = folder / f"arm-{UNSAFE.sub('_', arm)}.inhibits.json"
    try:
        if of_cell.exists() and not os.path.lexists(of_arm):
            of_cell.rename(of_arm)
            of_cell.with_name(f"{of_cell.name}.new").unlink(missing_ok=True)
    except OSError as error:
        raise _not_writable(of_arm, error) from None
    return InterlockFile(of_arm)


def _not_writable(path: Path, error: OSError) -> ConfigError:
    why = f"cannot be written ({error.strerror or error}): stops and holds would be lost at a restart"
    return ConfigError(STATE_VARIABLE, str(path.parent), why)


@contextlib.asynccontextmanager
async def exclusive_lock(record: Path, holder: str) -> AsyncIterator[None]:
    """Hold the lock of a record, and of the other files of the cell, against other processes.

    The kernel releases it when this process ends, also by SIGKILL.

    Raises:
        ConfigError: another process has it, which is named; or the folder cannot be locked.
    """
    name = f"{holder}, process {os.getpid()} on {socket.gethostname()}".encode()[:HOLDER_ROOM - 1]

    def write_name(descriptor: int) -> None:
        with contextlib.suppress(OSError):  # on a full disk the file names no holder
            os.pwrite(descriptor, name.ljust(HOLDER_ROOM - 1) + b"\n", 0)

    path = record.with_suffix(".lock")
    lock = FileLock(path, mode=0o600, fallback_to_soft=False, on_acquired=write_name)
    deadline = monotonic() + LOCK_TIMEOUT
    try:
        record.parent.mkdir(parents=True, exist_ok=True)
        while not lock.is_locked:
            with contextlib.suppress(Timeout):
                lock.acquire(blocking=False)
                break
            if monotonic() > deadline:
                other = path.read_bytes()[:HOLDER_ROOM].decode(errors="replace").strip() or "another process"
                raise ConfigError(STATE_VARIABLE, str(record.parent), f"is in use by {other}: each would undo stops of "
                                  "the other")
            await asyncio.sleep(LOCK_PERIOD)
    except OSError as error:
        raise _not_writable(record, error) from None
    try:
        yield
    finally:
        lock.release()


class InterlockStore:
    """Interlocks in memory and in their file: a change is answered once it is on disk.

    Attributes:
        interlocks: those in force.
        on_change: called after it has changed whether all of them are on disk.
    """

    def __init__(self, file: InterlockFile, log: logging.Logger) -> None:
        """Start with the content of the file."""
        self._file, self._log, self._writing = file, log, asyncio.Lock()
        self._saved, problem = file.load()
        self._problem = ""  # why the newest change is not on disk
        self._retrying: asyncio.Task[None] | None = None
        self._removed = False  # whether the file is to be written again, as it is gone
        self.on_change: Callable[[], None] = lambda: None
        self.interlocks = Interlocks(self._saved)
        if problem:
            log.error("%s; the robot counts as stopped: check the cell, then `zencell task start`", problem)
        for interlock in self.interlocks.all:
            log.warning("%s: `zencell task %s` releases it", interlock.description,
                        "start" if interlock.kind == "stopped" else "resume")

    async def save(self) -> str:
        """Write all changes so far; return "", or why they are not on disk. A failed write is retried each second."""
        async with self._writing:
            record = self.interlocks.record
            if record == self._saved and not self._problem and not self._removed:
                return ""
            before = self._problem
            try:
                await asyncio.to_thread(self._file.save, record)
            except OSError as error:
                why = error.strerror or str(error)
                self._problem = f"{self._file.path} cannot be written ({why}): a restart of the executor loses this"
                self.interlocks.note_saved(self._saved, why)
                if self._problem != before:
                    self._log.error("%s; retrying every second", self._problem)
                if self._retrying is None:
                    self._retrying = asyncio.create_task(self._retry(), name="save interlocks")
            else:
                self._saved, self._problem, self._removed = record, "", False
                self.interlocks.note_saved(record)
                if before:
                    self._log.warning("%s is written again: all interlocks persist", self._file.path)
            if before or self._problem:
                self.on_change()
            return self._problem

    async def restore_file(self) -> None:
        """Write the file again whenever it was removed, until cancelled."""
        while True:
            await asyncio.sleep(RETRY_PERIOD)
            if not self._problem and not await asyncio.to_thread(os.path.lexists, self._file.path):
                self._log.error("%s was removed while it was in use: it is written again. Leave the folder "
                                "of persistent state alone, as stops are lost with it", self._file.path)
                self._removed = True
                await self.save()

    async def _retry(self) -> None:
        while self._problem:
            await asyncio.sleep(RETRY_PERIOD)
            await self.save()
        self._retrying = None

    def close(self) -> None:
        """Stop retrying."""
        if self._retrying is not None:
            self._retrying.cancel()
