"""Cell time, which can run faster or slower than wall time.

Motion, the simulated world, camera rates and header stamps use cell time; requests, watchdogs and planning budgets use
wall time. All processes of a cell compute the same cell time from an epoch and a speed that the supervisor hands down
in the environment.

The system clock is read once per host: the supervisor hands down the Unix time at which the host's boot clock was at
0. That clock continues while the host sleeps, and is never set. So a restarted process agrees with the others whatever
happened to the system clock. Processes without a supervisor share that time by a file in a common folder
(ZENCELL_CLOCK), or else read the system clock when they start; hosts agree by their system clocks when their
supervisors start.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Mapping
from pathlib import Path

from common import time_source

SPEED_VARIABLE = "ZENCELL_SPEED"
EPOCH_VARIABLE = "ZENCELL_EPOCH"
BOOTED_VARIABLE = "ZENCELL_BOOTED"  # Unix time at which the host's boot clock was at 0 [ns]
CLOCK_FOLDER_VARIABLE = "ZENCELL_CLOCK"  # folder in which processes without a supervisor share that time
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
MIN_SPEED, MAX_SPEED = 0.1, 10.0


class Clock:
    """Cell time: equal to Unix time at the epoch, and `speed` times as fast after it."""

    def __init__(self, speed: float = 1.0, epoch_ns: int | None = None, booted_ns: int | None = None) -> None:
        """Start a clock.

        Args:
            speed: seconds of cell time per second of wall time, 0.1 to 10.
            epoch_ns: wall time [ns since the Unix epoch] at which cell time equals wall time; by default now.
            booted_ns: wall time [ns since the Unix epoch] at which the host's boot clock was at 0; by default as of
                the current system clock.

        Raises:
            ValueError: the speed is out of bounds.
        """
        if not MIN_SPEED <= speed <= MAX_SPEED:
            raise ValueError(f"speed: {speed:g} is not within {MIN_SPEED:g} to {MAX_SPEED:g}")
        self.speed = speed
        # From here on by the boot clock: a step of the system clock must not move the robot.
        self._offset_ns = time_source.booted_ns() if booted_ns is None else booted_ns
        self.epoch_ns = self._wall_ns() if epoch_ns is None else epoch_ns

    @classmethod
    def from_environment(cls, environ: Mapping[str, str] = os.environ) -> Clock:
        """Return the clock that the supervisor handed down, or one at speed 1."""
        epoch = environ.get(EPOCH_VARIABLE)
        return cls(float(environ.get(SPEED_VARIABLE, "1")), int(epoch) if epoch else None, _booted(environ))

    def environment(self) -> dict[str, str]:
        """Return the environment variables that give another process the same clock."""
        return {
            SPEED_VARIABLE: repr(self.speed), EPOCH_VARIABLE: str(self.epoch_ns), BOOTED_VARIABLE: str(self._offset_ns),
        }

    @property
    def booted_ns(self) -> int:
        """Unix time at which the host's boot clock was at 0 [ns], for all processes of the cell on this host."""
        return self._offset_ns

    def _wall_ns(self) -> int:
        return time_source.host_ns() + self._offset_ns

    def now_ns(self) -> int:
        """Return the current cell time [ns since the Unix epoch], the stamp of a header."""
        return self.epoch_ns + int((self._wall_ns() - self.epoch_ns) * self.speed)

    def now(self) -> float:
        """Return the current cell time [s since the Unix epoch]."""
        return self.now_ns() * 1e-9

    def wall_rate(self, cell_rate: float, most: float) -> float:
        """Return the rate in wall time [Hz] for a rate in cell time, at most `most`."""
        return min(cell_rate * self.speed, most)

    def age_ms(self, stamp_ns: int) -> float:
        """Return the wall time [ms] since a stamp was taken."""
        return (self.now_ns() - stamp_ns) / self.speed * 1e-6

    async def sleep(self, cell_seconds: float) -> None:
        """Sleep for a time in cell time [s]."""
        await asyncio.sleep(max(0.0, cell_seconds) / self.speed)


def _booted(environ: Mapping[str, str]) -> int | None:
    """Return the Unix time at which the boot clock was at 0 [ns], as handed down or shared; None if neither.

    Raises:
        ValueError: it cannot be read.
    """
    given, folder = environ.get(BOOTED_VARIABLE), environ.get(CLOCK_FOLDER_VARIABLE)
    if given or not folder:
        return int(given) if given else None
    try:
        # One file for each boot of the host, which restarts its clock.
        path = Path(folder) / f"clock-{BOOT_ID.read_text().strip()}"
        if not path.exists():
            own = path.with_suffix(f".{os.getpid()}-{time_source.new_id()}")
            own.write_text(str(time_source.booted_ns()))
            with contextlib.suppress(FileExistsError):  # the first process decides for all
                os.link(own, path)
            own.unlink()
        return int(path.read_text())
    except OSError as error:
        raise ValueError(f"{CLOCK_FOLDER_VARIABLE} {folder}: {error.strerror}") from None
