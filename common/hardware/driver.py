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
import multiprocessing
import os
import select
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, Protocol

import numpy as np

from common.hardware.interface import ArmState, Gripper, HardwareFault, Limits, Vector
from common.hardware.streaming import REST, SetPointStream

STOPS, RELEASES = ("protective_stop", "emergency_stop"), ("enable", "recover")
STOPPED = "was stopped for safety: `zencell robot recover` lets it move again"
SILENT = 0.25  # [s] without a word from the process or the arm, after which there is no knowing where it is
FIRST_PAUSE, LONGEST_PAUSE = 0.5, 8.0  # [s] before a process that failed is begun again
PRIORITY = 20  # real-time priority of the process, where the system grants one
LEAST = 2e-4  # [s] that are left to others in each cycle
ENDS = 2.0  # [s] in which it ends when it is told to


class Arm(Protocol):
    """What a driver does inside the process; every method may take its time, and raise anything: that ends it."""

    rate: float  # [Hz] at which it wants set-points

    def read(self) -> ArmState:
        """The newest state; raises when the arm has fallen silent."""

    def servo(self, q: Vector) -> None:
        """Go to q (dof,) [rad] within one period."""

    def wait(self) -> None:
        """Called once a period instead of `servo` while there is nothing to follow."""

    def do(self, act: str, value: float) -> None:
        """In a thread beside the others, one at a time: enable, recover, freedrive (value 0 or 1) or payload (kg).

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
        self._begin: Callable[[Connection], multiprocessing.process.BaseProcess] = lambda theirs: context.Process(
            target=drive, args=(module, dict(options), limits, ahead, theirs), name=f"driver of {name}", daemon=True
        )
        context = multiprocessing.get_context("spawn")
        self._name, self._dof = name, len(limits.names)
        self._process: multiprocessing.process.BaseProcess | None = None
        self._ours: Connection | None = None
        self._listener = threading.Thread()
        self._newest: Reading | None = None
        self._epoch = -1
        self._problem = f"connecting to {name}"
        self._pause, self._due = FIRST_PAUSE, 0.0
        self._orders: dict[int, str | None] = {}
        self._releases: set[int] = set()  # of them, those that let the arm move again
        self.stopped = False  # for safety, also by a process before this one, and nobody has let it move again
        self._number = 0
        self._older = 0.0  # what was read last is older by this than it would be if nobody was ever held up [s]
        self._offset = math.inf  # from the controller's time to that of the host [s]
        self._keep_up()

    @property
    def delay(self) -> float:
        """By which the arm, as it was read last, is behind its set-points [s]."""
        return self._delay + self._older

    @property
    def state(self) -> ArmState:
        """What the arm said last, or that it says nothing."""
        if self._newest is None or time.monotonic() - self._newest.stamp > SILENT:
            q = self._newest.state.q if self._newest else [0.0] * self._dof
            return ArmState(q, [0.0] * self._dof, "disconnected", self._problem)
        newest = self._newest.state
        if self.stopped and newest.mode == "running":  # somebody may stand there, whoever ended the stop
            return newest._replace(mode="protective_stop", message=STOPPED)
        return newest

    def read(self, now: float) -> tuple[Vector, Vector]:
        """Positions (dof,) [rad] and velocities [rad/s], as the arm said them last.

        Raises:
            HardwareFault: nobody knows where the arm is.
        """
        self._keep_up()
        newest = self._newest
        if newest is None:
            raise HardwareFault(self._problem or f"{self._name}: its driver has ended")
        silent = time.monotonic() - newest.stamp
        if silent > SILENT:
            raise HardwareFault(self._problem or f"no word from {self._name} for {silent:.1f} s")
        self._older = silent + newest.state.age + newest.behind
        return np.array(newest.state.q), np.array(newest.state.dq)

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        """Send set-points (dof,) [rad], [rad/s]: for when they were made, however late they are sent.

        Raises:
            HardwareFault: the arm cannot be moved now, or has let the motion go: what comes next begins where it is.
        """
        newest = self._newest
        if newest is None or self._ours is None:
            raise HardwareFault(self._problem or f"{self._name}: its driver has ended")
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
        if not self._send(("set", self._epoch, now + self._offset, positions, velocities)):
            raise HardwareFault(self._problem or f"{self._name}: its driver has ended")

    def order(self, act: str, value: float = 0.0) -> int:
        """Have the arm do something beside motion: `outcome` of the number that is returned says what became of it."""
        self._number += 1
        self._orders[self._number] = None
        if act in RELEASES:
            self._releases.add(self._number)
        if not self._send(("do", self._number, act, value)):
            self._orders[self._number] = self._problem or f"{self._name} is not connected"
        return self._number

    def outcome(self, number: int) -> str | None:
        """None while it is done; empty once it was; else why not."""
        self._keep_up()
        return self._orders[number]

    def close(self) -> None:
        """Let go of the arm, at rest."""
        if self._process is None:
            return
        self._send(("end",))
        self._process.join(ENDS)
        self._end()

    def _send(self, message: tuple[object, ...]) -> bool:
        try:
            if self._ours is None:
                return False
            self._ours.send(message)
        except OSError:
            return False  # the process is gone, which is seen when it is read
        return True

    def _keep_up(self) -> None:
        """Begin the process again where it has ended."""
        now = time.monotonic()
        if self._process is None:
            if now < self._due:
                return
            self._ours, theirs = multiprocessing.Pipe()
            self._process = self._begin(theirs)
            self._process.start()
            theirs.close()
            self._listener = threading.Thread(target=self._listen, args=(self._ours,), daemon=True)
            self._listener.start()
        elif not self._listener.is_alive():
            self._end()
            self._problem = self._problem or f"{self._name}: its driver ended without a word"
            self._due, self._pause = now + self._pause, min(2 * self._pause, LONGEST_PAUSE)

    def _listen(self, pipe: Connection) -> None:
        """Be the thread that takes what the process tells, whether anybody reads or not, until it has ended."""
        with contextlib.suppress(EOFError, OSError):
            while True:
                told = pipe.recv()
                if isinstance(told, Reading):
                    self.stopped = self.stopped or told.state.mode in STOPS
                    self._newest, self._problem, self._pause = told, "", FIRST_PAUSE
                    self.late = max(self.late, told.late)
                elif told[0] == "done":
                    if told[1] in self._releases and not told[2]:
                        self.stopped = False
                    self._orders[told[1]] = told[2]
                else:
                    self._problem = f"{self._name}: {told[1]}"
        self._newest = None  # nobody knows where the arm is from now on

    def _end(self) -> None:
        assert self._process is not None and self._ours is not None
        self._process.join(0.1)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._listener.join(ENDS)
        self._ours.close()
        self._process, self._ours, self._newest, self._epoch = None, None, None, -1
        for number, outcome in list(self._orders.items()):
            self._orders[number] = outcome if outcome is not None else f"{self._name}: its driver ended"


def _told(name: str, state: ArmState) -> str:
    return f"{name}: {state.message or state.mode.replace('_', ' ')}"


def drive(module: str, options: dict[str, Any], limits: Limits, ahead: float, pipe: Connection) -> None:
    """Be the process: connect, and play what comes until the other end is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for those who started us: they tell us when the arm rests
    try:
        arm: Arm = importlib.import_module(module).connect(options, limits)
        _hurry()
        with contextlib.suppress(EOFError, BrokenPipeError):  # nobody is there any more who could send set-points
            _follow(arm, SetPointStream(limits, ahead, 1 / arm.rate), pipe)
        arm.close()
    except Exception as error:  # of whatever type: the reason is for the person, the process is done
        with contextlib.suppress(OSError):
            pipe.send(("failed", str(error) or type(error).__name__))
    os._exit(0)  # a vendor's threads may wait for an arm that is gone


def _hurry() -> None:
    """Run ahead of all else on this host, where we may."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (AttributeError, OSError):
        with contextlib.suppress(OSError):
            os.nice(-10)


def _do(arm: Arm, act: str, value: float) -> str:
    try:
        arm.do(act, value)
    except ValueError as refusal:
        return str(refusal)
    return ""


def _tell(results: deque[tuple[str, int, str]], number: int, done: Future[str]) -> None:
    results.append(("done", number, str(done.exception() or done.result())))


def _follow(arm: Arm, stream: SetPointStream, pipe: Connection) -> None:
    acts, results = ThreadPoolExecutor(1), deque[tuple[str, int, str]]()
    period, epoch, taken, why = 1 / arm.rate, 0, False, ""
    kept: Vector | None = None  # where the arm is kept; None before the first set-point since it became ready
    due = time.monotonic()
    while True:
        while pipe.poll():
            match pipe.recv():
                case ("set", number, at, q, dq):
                    if number == epoch:
                        if not taken:
                            stream.begin(np.array(arm.read().q) if kept is None else kept, at)
                            taken = True
                        stream.put(at, q, dq)
                case ("do", number, act, value):
                    acts.submit(_do, arm, act, value).add_done_callback(partial(_tell, results, number))
                case ("end",):
                    raise EOFError
        while results:
            pipe.send(results.popleft())
        now = time.monotonic()
        state = arm.read()
        if state.mode != "running":
            if taken or kept is not None:
                epoch, taken, kept, why = epoch + 1, False, None, state.message
        elif taken:
            kept, dq = stream.at(now)
            if stream.ceased and not np.any(np.abs(dq) > REST):
                epoch, taken, why = epoch + 1, False, stream.ceased
        if kept is not None:
            arm.servo(kept)  # at rest too, where the motion ended
        else:
            arm.wait()
        if select.select([], [pipe], [], 0.0)[1]:  # else nobody takes it: the arm is not to wait for that
            behind, ceased = (stream.behind, stream.ceased) if taken else (0.0, "")
            pipe.send(Reading(now, state, epoch, why, max(0.0, now - due), behind, ceased))
        due = max(due + period, now)
        time.sleep(max(LEAST, due - time.monotonic()))
