"""Cell time, which can run faster or slower than the clock on the wall.

Motion, the simulated world, the camera rate and header stamps follow cell time; requests, watchdogs and planning
budgets follow wall time. All processes of a cell compute the same cell time from an epoch and a speed that the
supervisor hands down in the environment.

What day it is, is asked once per host: the supervisor hands down when the host's own clock was at 0, which goes on
while the host sleeps and which nobody sets. So a process that is started again agrees with the others whatever became
of the system clock. Processes without a supervisor agree by a file in a folder that they share (ZENCELL_CLOCK), or
without it by the system clock when they are started; hosts by their system clocks when their supervisors are started.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Mapping
from pathlib import Path

from common import time_source as sources

SPEED_VARIABLE = "ZENCELL_SPEED"
EPOCH_VARIABLE = "ZENCELL_EPOCH"
BOOTED_VARIABLE = "ZENCELL_BOOTED"  # Unix time at which the host's own clock was at 0 [ns]
KEPT_VARIABLE = "ZENCELL_CLOCK"  # folder in which those without a supervisor keep that
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
MIN_SPEED, MAX_SPEED = 0.1, 10.0


class Clock:
    """Cell time: equal to Unix time at the epoch and `speed` times as fast after it."""

    def __init__(self, speed: float = 1.0, epoch_ns: int | None = None, booted_ns: int | None = None) -> None:
        """Start a clock.

        Args:
            speed: seconds of cell time per second of wall time, 0.1 to 10.
            epoch_ns: wall time [ns since the Unix epoch] at which cell time equals wall time; now when not given.
            booted_ns: wall time [ns since the Unix epoch] at which the host's own clock was at 0; by the system clock
                of now when not given.

        Raises:
            ValueError: when the speed is out of bounds.
        """
        if not MIN_SPEED <= speed <= MAX_SPEED:
            raise ValueError(f"speed: {speed:g} is not within {MIN_SPEED:g} to {MAX_SPEED:g}")
        self.speed = speed
        # The host's own clock from here on: a step of the system clock must not move the robot.
        self._offset_ns = sources.wall_ns() - sources.host_ns() if booted_ns is None else booted_ns
        self.epoch_ns = self._wall_ns() if epoch_ns is None else epoch_ns

    @classmethod
    def from_environment(cls, environ: Mapping[str, str] = os.environ) -> Clock:
        """The clock that the supervisor handed down, or one at speed 1."""
        epoch = environ.get(EPOCH_VARIABLE)
        return cls(float(environ.get(SPEED_VARIABLE, "1")), int(epoch) if epoch else None, _booted(environ))

    def environment(self) -> dict[str, str]:
        """Variables from which another process makes the same clock."""
        return {
            SPEED_VARIABLE: repr(self.speed), EPOCH_VARIABLE: str(self.epoch_ns), BOOTED_VARIABLE: str(self._offset_ns),
        }

    @property
    def booted_ns(self) -> int:
        """Unix time at which the host's own clock was at 0 [ns], for all processes of the cell on this host."""
        return self._offset_ns

    def _wall_ns(self) -> int:
        return sources.host_ns() + self._offset_ns

    def now_ns(self) -> int:
        """Cell time now, in ns since the Unix epoch: the stamp of a header."""
        return self.epoch_ns + int((self._wall_ns() - self.epoch_ns) * self.speed)

    def now(self) -> float:
        """Cell time now [s]."""
        return self.now_ns() * 1e-9

    def wall_rate(self, cell_rate: float, most: float) -> float:
        """Rate on the wall clock [Hz] for a rate in cell time, at most `most`."""
        return min(cell_rate * self.speed, most)

    def age_ms(self, stamp_ns: int) -> float:
        """Wall time [ms] since a stamp was taken."""
        return (self.now_ns() - stamp_ns) / self.speed * 1e-6

    async def sleep(self, cell_seconds: float) -> None:
        """Wait until this much cell time has passed."""
        await asyncio.sleep(max(0.0, cell_seconds) / self.speed)


def _booted(environ: Mapping[str, str]) -> int | None:
    """Unix time at which the host's own clock was at 0 [ns], as it was handed down or kept; None when neither.

    Raises:
        ValueError: it cannot be read.
    """
    given, folder = environ.get(BOOTED_VARIABLE), environ.get(KEPT_VARIABLE)
    if given or not folder:
        return int(given) if given else None
    try:
        # Of this run of the host: after the next start its clock begins anew.
        path = Path(folder) / f"clock-{BOOT_ID.read_text().strip()}"
        if not path.exists():
            own = path.with_suffix(f".{os.getpid()}-{sources.new_id()}")
            own.write_text(str(sources.wall_ns() - sources.host_ns()))
            with contextlib.suppress(FileExistsError):  # whoever is first says it for all
                os.link(own, path)
            own.unlink()
        return int(path.read_text())
    except OSError as error:
        raise ValueError(f"{KEPT_VARIABLE} {folder}: {error.strerror}") from None
