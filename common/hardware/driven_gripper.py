"""A real gripper whose driver runs in a process of its own: `DrivenGripper` is the controller's side of it.

A vendor's library may block until the fingers have stopped, and its network may be slow: neither delays the arm. A
failure ends the process, which is restarted after a pause that doubles.
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
from common.hardware.driver_process import DriverProcess, run_driver
from common.hardware.interface import GripperReading, HardwareFault

TIMEOUT = 1.0  # [s] without a message of the process, after which the state of the fingers is unknown
MOVING_TIMEOUT = 10.0  # [s] the same while they move: a library may block all other calls meanwhile
PERIOD = 0.02  # [s] between two readings
STOP_TIMEOUT = 2.0  # [s] for a motion to end when a new command arrives


class FingerState(NamedTuple):
    """State reported by a gripper: `width` between the fingers [m], `effort` they press with [N]."""

    width: float
    moving: bool
    holding: bool
    effort: float


class GripperDriver(Protocol):
    """What a driver does inside the process; every method may block, and raise anything: that ends the process.

    `move` is called in a second thread, one call at a time, while `read` continues.
    """

    def read(self) -> FingerState:
        """Return the newest state."""

    def move(self, width: float, effort: float) -> None:
        """Move the fingers to a width [m], pressing with an effort [N]; return at once or when they have stopped."""

    def stop(self) -> None:
        """Make a `move` in progress return soon."""

    def close(self) -> None:
        """Release the gripper; what it holds stays held."""


class GripperSample(NamedTuple):
    """Message of the process: the state at `stamp` [s, monotonic], after it has received command `number`."""

    stamp: float
    number: int
    fingers: FingerState


class DrivenGripper:
    """A gripper behind a driver process."""

    def __init__(self, module: str, options: Mapping[str, Any], config: GripperConfig, *, name: str) -> None:
        """Start the process; `module` has `connect(options, config) -> GripperDriver`, `name` is for messages."""
        self._newest: GripperSample | None = None
        self._rate, self._number = 0.0, 0
        self._process = DriverProcess(name, _drive, (module, dict(options), config), self._on_sample, self._on_end)
        self._process.keep_running()

    def command(self, width: float, now: float, effort: float) -> None:
        """Start to move the fingers to a width [m], pressing with an effort [N]; replaces a motion under way.

        Raises:
            HardwareFault: the driver is not connected.
        """
        self._number += 1
        if self._newest is None or not self._process.send(("move", self._number, width, effort)):
            raise HardwareFault(self._process.failure)

    def read(self, now: float) -> GripperReading:
        """Return the newest reported state of the fingers.

        Raises:
            HardwareFault: the state is unknown.
        """
        self._process.keep_running()
        newest = self._newest
        if newest is None:
            raise HardwareFault(self._process.failure)
        width, moving, holding, effort = newest.fingers
        age = time.monotonic() - newest.stamp
        if age > (MOVING_TIMEOUT if moving else TIMEOUT):
            raise HardwareFault(self._process.problem or f"no message from {self._process.name} for {age:.1f} s")
        outdated = newest.number < self._number  # of before the newest command
        return GripperReading(width, self._rate, moving or outdated, holding and not outdated, effort)

    def close(self) -> None:
        """Release the gripper; what it holds stays held."""
        self._process.close()

    def _on_sample(self, sample: GripperSample) -> None:
        before, self._newest = self._newest, sample
        if before is not None:
            moved = sample.fingers.width - before.fingers.width
            self._rate = moved / max(sample.stamp - before.stamp, 1e-3)
        self._process.set_working()

    def _on_end(self) -> None:
        self._newest, self._rate, self._number = None, 0.0, 0


def _drive(module: str, options: dict[str, Any], config: GripperConfig, pipe: Connection) -> None:
    """Run in the process: connect, and serve commands until the other end is gone."""

    def work() -> None:
        driver: GripperDriver = importlib.import_module(module).connect(options, config)
        with contextlib.suppress(EOFError, BrokenPipeError):
            _serve(driver, pipe)
        driver.close()

    run_driver(pipe, work)


def _serve(driver: GripperDriver, pipe: Connection) -> None:
    moves, running, received, fingers = ThreadPoolExecutor(1), None, 0, driver.read()
    while True:
        while pipe.poll():
            match pipe.recv():
                case ("move", number, width, effort):
                    if running is not None and not running.done():
                        driver.stop()
                        running.result(STOP_TIMEOUT)
                    received = number
                    pipe.send(GripperSample(time.monotonic(), received, fingers._replace(moving=True)))
                    running = moves.submit(driver.move, width, effort)
                case ("end",):
                    raise EOFError
        running = _unless_done(running)
        fingers = driver.read()
        moving = fingers.moving or running is not None
        pipe.send(GripperSample(time.monotonic(), received, fingers._replace(moving=moving)))
        time.sleep(PERIOD)


def _unless_done(running: Future[None] | None) -> Future[None] | None:
    """Return a motion that is still in progress; raise what ended it."""
    if running is None or not running.done():
        return running
    running.result()
    return None
