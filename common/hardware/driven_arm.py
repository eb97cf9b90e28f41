"""A real arm whose driver runs in a process of its own at the arm's rate: `DrivenArm` is the controller's side of it.

The controller sends set-points ahead of time and the process plays them (`SetPointStream`), so that a garbage
collection, an image or a planner in the executor's process does not disturb the arm. When set-points cease, the arm
comes to rest by itself. A failure ends the process, which is restarted after a pause that doubles. Times here are of
the host's monotonic clock, which both processes share: the network and the arm do not know cell time.
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

from common.hardware.driver_process import DriverProcess, run_driver
from common.hardware.interface import SAFETY_STOPS, ArmState, Gripper, HardwareFault, Interrupted, Limits, Vector
from common.hardware.streaming import JUMP, REST, SetPointStream

STOPPED = "was stopped for safety: `zencell robot recover` lets it move again"
TIMEOUT = 0.25  # [s] without a message of the process or a state of the arm, after which its position is unknown
PRIORITY = 20  # real-time priority of the process, where the system grants one
LEAST_SLEEP = 2e-4  # [s] of each cycle left to other processes
REPORT_PERIOD = 1.5e-3  # [s] at least between two readings in which nothing has changed


class ArmDriver(Protocol):
    """What a driver does inside the process; every method may block, and raise anything: that ends the process."""

    rate: float  # [Hz] of set-points, in the host's time; it may change
    paced_by_arm: bool  # whether `read` blocks until the arm's next cycle
    realtime: bool  # whether the process asks for real-time priority
    # slowed: bool  # optional: whether the arm's own controller slows set-points by its speed slider

    def read(self) -> ArmState:
        """Return the newest state; raise when the arm does not report any more."""

    def due(self) -> list[float]:
        """Return the times [s] of the set-points that the arm wants now, the newest last.

        More than one when cycles were missed.
        """

    def servo(self, points: list[Vector]) -> None:
        """Move to the last of the set-points (dof,) [rad] that were due within one period."""

    def wait(self) -> None:
        """Run once a period instead of `servo` while there are no set-points."""

    def do(self, act: str, *values: float) -> None:
        """Run a function of the arm, see `ControlledArm.order`; called in a second thread, one call at a time.

        Raises:
            ValueError: the arm cannot do it, with the reason.
        """

    def close(self) -> None:
        """Release the arm, at rest."""


class Reading(NamedTuple):
    """Message of the process: the state of the arm at `stamp`, and how late the process is.

    `epoch` counts interruptions of the set-points; the process does not play what was sent in an earlier epoch. `late`
    is the longest delay of a cycle since the last reading [s], `behind` the delay of the set-points caused by it [s].
    `ceased` says why the process brings the arm to rest by itself, which ends the epoch; the motion may continue in the
    next one if it is `resumable`.
    """

    stamp: float
    state: ArmState
    epoch: int
    why: str
    late: float
    behind: float = 0.0
    ceased: str = ""
    resumable: bool = False


class DrivenArm:
    """An arm behind a driver process.

    Attributes:
        late: longest delay of a cycle of the process so far [s].
        stopped: whether a safety stop, also of an earlier process, still waits for an operator to have it recover.
        share: of the full speed at which the next set-point moves the arm, 0 to 1.
    """

    def __init__(
        self, module: str, options: Mapping[str, Any], limits: Limits, *, gripper: Gripper | None, ahead: float,
        delay: float, name: str, max_payload: float = math.inf,
    ) -> None:
        """Start the process; `module` has `connect(options, limits) -> ArmDriver`, `name` is for messages.

        Set-points are sent `ahead` of time [s]; the arm reaches them after `delay` [s]. Payloads above `max_payload`
        [kg] are rejected.
        """
        self.gripper = gripper
        self.ahead, self._delay = ahead, delay
        self.late, self.share = 0.0, 1.0
        self.stopped = False
        self._process = DriverProcess(name, drive, (module, dict(options), limits, ahead), self._on_message,
                                      self._on_end)
        self._max_payload = max_payload
        self._name, self._dof = name, len(limits.names)
        self._newest: Reading | None = None
        self._epoch = -1
        self._orders: dict[int, str | None] = {}
        self._releases: set[int] = set()  # orders that let the arm move again
        self._number = 0
        self._extra_delay = 0.0  # [s] of the newest reading, added by hold-ups
        self._offset = math.inf  # from cell time to the host's monotonic time [s]
        self._process.keep_running()

    @property
    def delay(self) -> float:
        """Delay of the newest joint reading behind the set-points [s]."""
        return self._delay + self._extra_delay

    @property
    def state(self) -> ArmState:
        """Return the newest state, or that the arm is disconnected."""
        if self._newest is None or self._is_stale(self._newest):
            q = self._newest.state.q if self._newest else [0.0] * self._dof
            return ArmState(q, [0.0] * self._dof, "disconnected", self._process.problem)
        newest = self._newest.state
        if self.stopped and newest.mode == "running":  # people may be near the arm, whatever ended the stop
            return newest._replace(mode="protective_stop", message=STOPPED)
        return newest

    def read(self, now: float) -> tuple[Vector, Vector]:
        """Return positions (dof,) [rad] and velocities [rad/s] as last reported.

        Raises:
            HardwareFault: the position of the arm is unknown.
        """
        self._process.keep_running()
        newest = self._newest
        if newest is None:
            raise HardwareFault(self._process.failure)
        age = time.monotonic() - newest.stamp + newest.state.age
        if self._is_stale(newest):
            raise HardwareFault(self._process.problem or f"no message from {self._name} for {age:.1f} s")
        self._extra_delay = age + newest.behind
        return np.array(newest.state.q), np.array(newest.state.dq)

    @property
    def known_payload(self) -> tuple[float, float, float, float] | None:
        """Payload that the arm's controller subtracts: mass [kg], centre of mass from the flange x, y, z [m]."""
        return self._newest.state.payload if self._newest is not None else None

    def wrench(self) -> Vector | None:
        """Return what acts on the flange (6,) [N], [N m], along its axes, as last reported; None: nothing is."""
        newest = self._newest
        return None if newest is None or newest.state.wrench is None else np.array(newest.state.wrench)

    @staticmethod
    def _is_stale(newest: Reading) -> bool:
        """Return whether the process reports no more, or for too long nothing new of the arm, as if it were held up."""
        age = time.monotonic() - newest.stamp
        return age > TIMEOUT or age + newest.state.age > 2 * TIMEOUT

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        """Send set-points (dof,) [rad], [rad/s], for the time at which they were computed, however late they are sent.

        Raises:
            HardwareFault: the arm cannot be moved now, or has ended the motion: the next one starts where the arm is.
            Interrupted: it comes to rest, or has, and the motion may continue from there.
        """
        newest = self._newest
        if newest is None:
            raise HardwareFault(self._process.failure)
        if (state := self.state).mode != "running":
            raise HardwareFault(f"{self._name}: {state.message or state.mode.replace('_', ' ')}")
        if newest.ceased and newest.epoch <= self._epoch:
            self._epoch = newest.epoch + 1  # of the set-points that are sent once the arm is at rest
            raise (Interrupted if newest.resumable else HardwareFault)(f"{self._name}: {newest.ceased}")
        if newest.epoch != self._epoch:
            first, self._epoch = self._epoch < 0, newest.epoch
            if not first:  # after connecting nothing was sent yet, and set-points start where the arm was read
                raise (Interrupted if newest.resumable else HardwareFault)(
                    f"{self._name}: {newest.why or 'was released for a moment'}")
        self._offset = min(self._offset, time.monotonic() - now)
        if not self._process.send(("set", self._epoch, now + self._offset, positions, velocities, self.share)):
            raise HardwareFault(self._process.failure)

    def order(self, act: str, *values: float) -> int:
        """Start a function of the arm; return a number for `outcome`."""
        self._number += 1
        self._orders[self._number] = None
        if act == "recover":
            self._releases.add(self._number)
        if act == "payload" and values[0] > self._max_payload:
            limit = f"{self._max_payload:g} kg of {self._name}"
            self._orders[self._number] = f"{values[0]:g} kg exceeds the limit of {limit}"
        elif not self._process.send(("do", self._number, act, *values)):
            self._orders[self._number] = self._process.problem or f"{self._name} is not connected"
        return self._number

    def outcome(self, number: int) -> str | None:
        """Return None while the order runs, then once "" for success or the reason of its failure."""
        self._process.keep_running()
        outcome = self._orders[number]
        if outcome is not None:
            del self._orders[number]
        return outcome

    def close(self) -> None:
        """Release the arm, at rest."""
        self._process.close()

    def _on_message(self, message: Any) -> None:
        if isinstance(message, Reading):
            self.stopped = self.stopped or message.state.mode in SAFETY_STOPS
            self._newest = message
            self._process.set_working()
            self.late = max(self.late, message.late)
        elif message[0] == "done":
            if message[1] in self._releases and not message[2]:
                self.stopped = False
            self._orders[message[1]] = message[2]

    def _on_end(self) -> None:
        self._newest, self._epoch = None, -1
        for number, outcome in list(self._orders.items()):
            self._orders[number] = outcome if outcome is not None else f"{self._name}: its driver ended"


def drive(module: str, options: dict[str, Any], limits: Limits, ahead: float, pipe: Connection) -> None:
    """Run in the process: connect, and play set-points until the other end is gone."""

    def work() -> None:
        arm: ArmDriver = importlib.import_module(module).connect(options, limits)
        if arm.realtime:
            _raise_priority()
        player = Player(arm, SetPointStream(limits, ahead, 1 / arm.rate), pipe)
        with contextlib.suppress(EOFError, BrokenPipeError):  # the sender of set-points is gone
            while True:
                player.cycle()
        arm.close()

    run_driver(pipe, work)


def _raise_priority() -> None:
    """Ask for real-time priority, or a lower niceness, where the system grants it."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (AttributeError, OSError):
        with contextlib.suppress(OSError):
            os.nice(-10)


class Player:
    """The loop of the process: receives set-points and orders, servoes the arm, and reports its state."""

    def __init__(self, arm: ArmDriver, stream: SetPointStream, pipe: Connection) -> None:
        """Report to `pipe`; nothing is sent to the arm before the first set-point."""
        self._arm, self._stream, self._pipe = arm, stream, pipe
        self._acts, self._results = ThreadPoolExecutor(1), deque[tuple[str, int, str]]()
        self._period, self._epoch, self._playing, self._why = 1 / arm.rate, 0, False, ""
        self._target: Vector | None = None  # newest set-point since the arm became ready
        self._resumable = False  # whether a motion may continue in this epoch
        self._slowed: bool = getattr(arm, "slowed", False)
        self._due, self._reported_at = time.monotonic(), 0.0
        self._reported: tuple[str, str, int, str] = ("", "", -1, "")

    def cycle(self) -> None:
        """Do one cycle.

        Raises:
            EOFError, BrokenPipeError: the other end wants this process to end, or is gone.
        """
        self._receive()
        while self._results:
            self._pipe.send(self._results.popleft())
        now = time.monotonic()
        state = self._arm.read()
        if points := self._points(state):
            self._arm.servo(points)  # at rest too, where the motion ended
        else:
            self._arm.wait()
        self._report(now, state)
        self._due = max(self._due + self._period, now)
        time.sleep(LEAST_SLEEP if self._arm.paced_by_arm else max(LEAST_SLEEP, self._due - time.monotonic()))

    def _receive(self) -> None:
        while self._pipe.poll():
            match self._pipe.recv():
                case ("set", epoch, at, q, dq, share):
                    if epoch == self._epoch:
                        if not self._playing:
                            self._stream.begin(self._start(q), at)
                            self._playing = True
                        self._stream.put(at, q, dq, share)
                case ("do", number, act, *values):
                    self._acts.submit(self._do, act, *values).add_done_callback(partial(self._note_result, number))
                case ("end",):
                    raise EOFError

    def _start(self, q: Vector) -> Vector:
        """Return where the curve to a first set-point (dof,) [rad] starts: where the last one ended, or the arm is.

        An arm that its slider has stopped is behind the last one.
        """
        measured = np.array(self._arm.read().q)
        if self._target is not None and not (
            self._slowed and np.abs(q - measured).max() < np.abs(q - self._target).max() - JUMP
        ):
            return self._target
        return measured

    def _points(self, state: ArmState) -> list[Vector]:
        """Return the set-points (dof,) [rad] that are due."""
        points: list[Vector] = []
        if state.mode != "running":
            if self._playing or self._target is not None:
                self._epoch, self._playing, self._target, self._why = self._epoch + 1, False, None, state.message
                self._resumable = False
            return points
        slider = state.speed if self._slowed else 1.0
        times = self._arm.due()
        self._stream.period = 1 / self._arm.rate
        for at in times:
            if self._playing:
                self._target, dq = self._stream.at(at, slider)
                if self._stream.ceased and not np.any(np.abs(dq) > REST):
                    self._epoch, self._playing, self._why = self._epoch + 1, False, self._stream.ceased
                    self._resumable = self._stream.resumable
            if self._target is not None:
                points.append(self._target)
        return points

    def _report(self, now: float, state: ArmState) -> None:
        """Send a reading if it is new or due, and the pipe takes it: the arm must not wait for the reader."""
        behind = self._stream.behind if self._playing or self._resumable else 0.0
        ceased, resumable = "", self._resumable
        if self._playing:
            ceased, resumable = self._stream.ceased, self._stream.resumable
        news = (state.mode, state.message, self._epoch, ceased)
        if (news != self._reported or now - self._reported_at >= REPORT_PERIOD) and (
            select.select([], [self._pipe], [], 0.0)[1]
        ):
            self._reported_at, self._reported = now, news
            late = max(0.0, now - self._due)
            self._pipe.send(Reading(now, state, self._epoch, self._why, late, behind, ceased, resumable))

    def _do(self, act: str, *values: float) -> str:
        try:
            self._arm.do(act, *values)
        except ValueError as refusal:
            return str(refusal)
        return ""

    def _note_result(self, number: int, done: Future[str]) -> None:
        self._results.append(("done", number, str(done.exception() or done.result())))
