"""A real gripper's driver in a process of its own: `DrivenGripper` is what the controller sees of it.

A vendor's library may block until the fingers have stopped, and its network may be slow: neither is felt by the arm.
What fails in the process ends it; it is begun again after a time that doubles.
"""

from __future__ import annotations

import contextlib
import importlib
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, Protocol

from common.config import GripperConfig
from common.hardware.driver_process import DriverProcess, run
from common.hardware.interface import GripperReading, HardwareFault

SILENT = 1.0  # [s] without a word from the process, after which there is no knowing how the fingers stand
MOVES = 10.0  # [s] of silence while they move: a library may let nothing else be done meanwhile
PERIOD = 0.02  # [s] between two readings
STOPS = 2.0  # [s] in which fingers leave off what they do, when they are told something else


class Fingers(NamedTuple):
    """What a gripper says of itself: `width` between the fingers [m], `effort` they press with [N]."""

    width: float
    moving: bool
    holding: bool
    effort: float


class Hand(Protocol):
    """What a driver does inside the process; every method may take its time, and raise anything: that ends it.

    `move` is called in a thread beside, one at a time, while `read` goes on.
    """

    def read(self) -> Fingers:
        """The newest state."""

    def move(self, width: float, effort: float) -> None:
        """Bring the fingers to a width [m], pressing with an effort [N]; returns at once, or when they have stopped."""

    def stop(self) -> None:
        """Have a `move` that is under way return soon."""

    def close(self) -> None:
        """Let go of the gripper; what it holds stays held."""


class Told(NamedTuple):
    """What the process tells: the state at `stamp`, [s] monotonic, after it has heard of the command `number`."""

    stamp: float
    number: int
    fingers: Fingers


class DrivenGripper:
    """A gripper behind a process that talks to it."""

    def __init__(self, module: str, options: Mapping[str, Any], config: GripperConfig, *, name: str) -> None:
        """Begin the process; `module` has `connect(options, config) -> Hand`, `name` says in messages what it is."""
        self._newest: Told | None = None
        self._rate, self._number = 0.0, 0
        self._process = DriverProcess(name, _drive, (module, dict(options), config), self._hear, self._lost)
        self._process.keep_up()

    def command(self, width: float, now: float, effort: float) -> None:
        """Start to move the fingers to a width [m], pressing with an effort [N]; replaces a motion under way.

        Raises:
            HardwareFault: nobody is there to do it.
        """
        self._number += 1
        if self._newest is None or not self._process.send(("move", self._number, width, effort)):
            raise HardwareFault(self._process.problem or f"{self._process.name}: its driver has ended")

    def read(self, now: float) -> GripperReading:
        """State of the fingers, as they said it last.

        Raises:
            HardwareFault: nobody knows how they stand.
        """
        self._process.keep_up()
        newest = self._newest
        if newest is None:
            raise HardwareFault(self._process.problem or f"{self._process.name}: its driver has ended")
        width, moving, holding, effort = newest.fingers
        silent = time.monotonic() - newest.stamp
        if silent > (MOVES if moving else SILENT):
            raise HardwareFault(self._process.problem or f"no word from {self._process.name} for {silent:.1f} s")
        unheard = newest.number < self._number
        return GripperReading(width, self._rate, moving or unheard, holding and not unheard, effort)

    def close(self) -> None:
        """Let go of the gripper; what it holds stays held."""
        self._process.close()

    def _hear(self, told: Told) -> None:
        before, self._newest = self._newest, told
        if before is not None:
            self._rate = (told.fingers.width - before.fingers.width) / max(told.stamp - before.stamp, 1e-3)
        self._process.works()

    def _lost(self) -> None:
        self._newest, self._rate, self._number = None, 0.0, 0


def _drive(module: str, options: dict[str, Any], config: GripperConfig, pipe: Connection) -> None:
    """Be the process: connect, and do what comes until the other end is gone."""

    def work() -> None:
        hand: Hand = importlib.import_module(module).connect(options, config)
        with contextlib.suppress(EOFError, BrokenPipeError):
            _attend(hand, pipe)
        hand.close()

    run(pipe, work)


def _attend(hand: Hand, pipe: Connection) -> None:
    moves, running, heard, fingers = ThreadPoolExecutor(1), None, 0, hand.read()
    while True:
        while pipe.poll():
            match pipe.recv():
                case ("move", number, width, effort):
                    if running is not None and not running.done():
                        hand.stop()
                        running.result(STOPS)
                    heard = number
                    pipe.send(Told(time.monotonic(), heard, fingers._replace(moving=True)))
                    running = moves.submit(hand.move, width, effort)
                case ("end",):
                    raise EOFError
        running = _unless_done(running)
        fingers = hand.read()
        pipe.send(Told(time.monotonic(), heard, fingers._replace(moving=fingers.moving or running is not None)))
        time.sleep(PERIOD)


def _unless_done(running: Future[None] | None) -> Future[None] | None:
    """What still goes on; raises what went wrong."""
    if running is None or not running.done():
        return running
    running.result()
    return None
