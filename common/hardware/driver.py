"""A real arm's driver in a process of its own, at the arm's rate: `DrivenArm` is what the controller sees of it.

The controller sends set-points ahead of time; the process plays them (`SetPointStream`), so that no garbage collection,
no picture and no planner of ours is felt by the arm. When they cease the arm comes to rest by itself. Whatever fails in
the process ends it; it is begun again after a time that doubles. Times here are of the host's monotonic clock, which
both processes share: the network and the arm do not know of cell time.
"""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import select
import time
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, Protocol

import numpy as np

from common.hardware.driver_process import DriverProcess, run
from common.hardware.interface import ArmState, Gripper, HardwareFault, Limits, Vector
from common.hardware.streaming import REST, SetPointStream

STOPS, RELEASES = ("protective_stop", "emergency_stop"), ("enable", "recover")
STOPPED = "was stopped for safety: `zencell robot recover` lets it move again"
SILENT = 0.25  # [s] without a word from the process or the arm, after which there is no knowing where it is
PRIORITY = 20  # real-time priority of the process, where the system grants one
LEAST = 2e-4  # [s] that are left to others in each cycle
TOLD = 1.5e-3  # [s] between two readings that are told, at least, where nothing happened


class Arm(Protocol):
    """What a driver does inside the process; every method may take its time, and raise anything: that ends it."""

    rate: float  # [Hz] at which it wants set-points, in the host's time; it may change
    paces: bool  # whether `read` waits for the arm, and so says when the next cycle begins
    hurries: bool  # whether its process is to run ahead of all else on this host

    def read(self) -> ArmState:
        """The newest state; raises when the arm has fallen silent."""

    def due(self) -> list[float]:
        """Times [s] of the set-points that it wants now, the newest last: more than one where it did without some."""

    def servo(self, points: list[Vector]) -> None:
        """Go to the last of the set-points (dof,) [rad] that were due within one period."""

    def wait(self) -> None:
        """Called once a period instead of `servo` while there is nothing to follow."""

    def do(self, act: str, *values: float) -> None:
        """In a thread beside the others, one at a time: see `ControlledArm.order`.

        Raises:
            ValueError: it cannot, with the reason.
        """

    def close(self) -> None:
        """Let go of the arm, at rest."""


class Reading(NamedTuple):
    """What the process tells: the state of the arm at `stamp`, and how well the process keeps time.

    `epoch` counts how often set-points were cut off; what was sent in an earlier one is not played any more. `late` is
    the longest that a cycle came late [s] since the last reading, and `behind` how much later than they should be [s]
    set-points are played for that. `ceased` says why the arm is being brought to rest by itself, which ends the epoch.
    """

    stamp: float
    state: ArmState
    epoch: int
    why: str
    late: float
    behind: float = 0.0
    ceased: str = ""


class DrivenArm:
    """Hardware behind a process that talks to the arm."""

    def __init__(
        self, module: str, options: Mapping[str, Any], limits: Limits, *, gripper: Gripper | None, ahead: float,
        delay: float, name: str,
    ) -> None:
        """Begin the process; `module` has `connect(options, limits) -> Arm`, `name` says in messages what it is.

        Set-points are sent `ahead` of time [s]; the arm is at them after `delay` [s].
        """
        self.gripper = gripper
        self.ahead, self._delay = ahead, delay
        self.late = 0.0  # [s] the latest cycle of the process so far
        self._process = DriverProcess(name, drive, (module, dict(options), limits, ahead), self._hear, self._lost)
        self._name, self._dof = name, len(limits.names)
        self._newest: Reading | None = None
        self._epoch = -1
        self._orders: dict[int, str | None] = {}
        self._releases: set[int] = set()  # of them, those that let the arm move again
        self.stopped = False  # for safety, also by a process before this one, and nobody has let it move again
        self._number = 0
        self._older = 0.0  # what was read last is older by this than it would be if nobody was ever held up [s]
        self._offset = math.inf  # from the controller's time to that of the host [s]
        self._process.keep_up()

    @property
    def delay(self) -> float:
        """By which the arm, as it was read last, is behind its set-points [s]."""
        return self._delay + self._older

    @property
    def state(self) -> ArmState:
        """What the arm said last, or that it says nothing."""
        if self._newest is None or self._is_silent(self._newest):
            q = self._newest.state.q if self._newest else [0.0] * self._dof
            return ArmState(q, [0.0] * self._dof, "disconnected", self._process.problem)
        newest = self._newest.state
        if self.stopped and newest.mode == "running":  # somebody may stand there, whoever ended the stop
            return newest._replace(mode="protective_stop", message=STOPPED)
        return newest

    def read(self, now: float) -> tuple[Vector, Vector]:
        """Positions (dof,) [rad] and velocities [rad/s], as the arm said them last.

        Raises:
            HardwareFault: nobody knows where the arm is.
        """
        self._process.keep_up()
        newest = self._newest
        if newest is None:
            raise HardwareFault(self._process.problem or f"{self._name}: its driver has ended")
        old = time.monotonic() - newest.stamp + newest.state.age
        if self._is_silent(newest):
            raise HardwareFault(self._process.problem or f"no word from {self._name} for {old:.1f} s")
        self._older = old + newest.behind
        return np.array(newest.state.q), np.array(newest.state.dq)

    @staticmethod
    def _is_silent(newest: Reading) -> bool:
        """Whether the process says nothing any more, or for too long nothing new of the arm, as one held up may."""
        silent = time.monotonic() - newest.stamp
        return silent > SILENT or silent + newest.state.age > 2 * SILENT

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        """Send set-points (dof,) [rad], [rad/s]: for when they were made, however late they are sent.

        Raises:
            HardwareFault: the arm cannot be moved now, or has let the motion go: what comes next begins where it is.
        """
        newest = self._newest
        if newest is None:
            raise HardwareFault(self._process.problem or f"{self._name}: its driver has ended")
        if (state := self.state).mode != "running":
            raise HardwareFault(_told(self._name, state))
        if newest.ceased and newest.epoch <= self._epoch:
            self._epoch = newest.epoch + 1  # what is sent once it rests
            raise HardwareFault(f"{self._name}: {newest.ceased}")
        if newest.epoch != self._epoch:
            connected, self._epoch = self._epoch < 0, newest.epoch
            if not connected:  # else nothing was sent yet, and what is sent now begins where the arm was read
                raise HardwareFault(f"{self._name}: {newest.why or 'was let go of for a moment'}")
        self._offset = min(self._offset, time.monotonic() - now)
        if not self._process.send(("set", self._epoch, now + self._offset, positions, velocities)):
            raise HardwareFault(self._process.problem or f"{self._name}: its driver has ended")

    def order(self, act: str, *values: float) -> int:
        """Have the arm do something beside motion: `outcome` of the number that is returned says what became of it."""
        self._number += 1
        self._orders[self._number] = None
        if act in RELEASES:
            self._releases.add(self._number)
        if not self._process.send(("do", self._number, act, *values)):
            self._orders[self._number] = self._process.problem or f"{self._name} is not connected"
        return self._number

    def outcome(self, number: int) -> str | None:
        """None while it is done; empty once it was; else why not."""
        self._process.keep_up()
        outcome = self._orders[number]
        if outcome is not None:
            del self._orders[number]
        return outcome

    def close(self) -> None:
        """Let go of the arm, at rest."""
        self._process.close()

    def _hear(self, told: Any) -> None:
        if isinstance(told, Reading):
            self.stopped = self.stopped or told.state.mode in STOPS
            self._newest = told
            self._process.works()
            self.late = max(self.late, told.late)
        elif told[0] == "done":
            if told[1] in self._releases and not told[2]:
                self.stopped = False
            self._orders[told[1]] = told[2]

    def _lost(self) -> None:
        """Nobody knows where the arm is from now on."""
        self._newest, self._epoch = None, -1
        for number, outcome in list(self._orders.items()):
            self._orders[number] = outcome if outcome is not None else f"{self._name}: its driver ended"


def _told(name: str, state: ArmState) -> str:
    return f"{name}: {state.message or state.mode.replace('_', ' ')}"


def drive(module: str, options: dict[str, Any], limits: Limits, ahead: float, pipe: Connection) -> None:
    """Be the process: connect, and play what comes until the other end is gone."""

    def work() -> None:
        arm: Arm = importlib.import_module(module).connect(options, limits)
        if arm.hurries:
            _hurry()
        with contextlib.suppress(EOFError, BrokenPipeError):  # nobody is there any more who could send set-points
            _follow(arm, SetPointStream(limits, ahead, 1 / arm.rate), pipe)
        arm.close()

    run(pipe, work)


def _hurry() -> None:
    """Run ahead of all else on this host, where we may."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (AttributeError, OSError):
        with contextlib.suppress(OSError):
            os.nice(-10)


def _do(arm: Arm, act: str, *values: float) -> str:
    try:
        arm.do(act, *values)
    except ValueError as refusal:
        return str(refusal)
    return ""


def _tell(results: deque[tuple[str, int, str]], number: int, done: Future[str]) -> None:
    results.append(("done", number, str(done.exception() or done.result())))


def _follow(arm: Arm, stream: SetPointStream, pipe: Connection) -> None:
    acts, results = ThreadPoolExecutor(1), deque[tuple[str, int, str]]()
    period, epoch, taken, why = 1 / arm.rate, 0, False, ""
    kept: Vector | None = None  # where the arm is kept; None before the first set-point since it became ready
    due, told, said = time.monotonic(), 0.0, ("", "", -1, "")
    while True:
        while pipe.poll():
            match pipe.recv():
                case ("set", number, at, q, dq):
                    if number == epoch:
                        if not taken:
                            stream.begin(np.array(arm.read().q) if kept is None else kept, at)
                            taken = True
                        stream.put(at, q, dq)
                case ("do", number, act, *values):
                    acts.submit(_do, arm, act, *values).add_done_callback(partial(_tell, results, number))
                case ("end",):
                    raise EOFError
        while results:
            pipe.send(results.popleft())
        now = time.monotonic()
        state = arm.read()
        points = []
        if state.mode != "running":
            if taken or kept is not None:
                epoch, taken, kept, why = epoch + 1, False, None, state.message
        else:
            wanted = arm.due()
            stream.period = 1 / arm.rate
            for at in wanted:
                if taken:
                    kept, dq = stream.at(at)
                    if stream.ceased and not np.any(np.abs(dq) > REST):
                        epoch, taken, why = epoch + 1, False, stream.ceased
                if kept is not None:
                    points.append(kept)
        if points:
            arm.servo(points)  # at rest too, where the motion ended
        else:
            arm.wait()
        behind, ceased = (stream.behind, stream.ceased) if taken else (0.0, "")
        says = (state.mode, state.message, epoch, ceased)
        if (says != said or now - told >= TOLD) and select.select([], [pipe], [], 0.0)[1]:  # else nobody takes it,
            told, said = now, says  # for whom the arm must not wait; what is new may be all that comes for a while
            pipe.send(Reading(now, state, epoch, why, max(0.0, now - due), behind, ceased))
        due = max(due + period, now)
        time.sleep(LEAST if arm.paces else max(LEAST, due - time.monotonic()))
