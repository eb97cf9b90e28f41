"""The band: by how much the schedules of two arms may differ before the coordinator has corrected it.

    band = drift + report + 2 message + tick + cycle + braking

An arm may be `drift` behind before anything is done. That it is later shows at the latest in its next report, each
`report`, which takes `message` to the coordinator; that decides within a `tick`, proofs included, and its hold takes
another `message` and a control `cycle` to the other arm, which then brakes on its path. No arm is ever ahead of its
schedule by more than its start ramp, which `drift` contains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.hardware.interface import Limits
from common.hardware.pace import RAMP_UP, SHORTEST_STOP
from common.planning.trajectory import TimedPath

AFTER_RELEASE = RAMP_UP / 2  # [s] that an arm loses while it speeds up to the rate of its schedule


@dataclass(frozen=True)
class Delays:
    """Durations [s] that the band covers."""

    drift: float = 0.05
    report: float = 0.1  # common.control.status.PROGRESS_PERIOD
    message: float = 0.03
    tick: float = 0.06
    cycle: float = 0.01

    def band(self, *braking: float) -> float:
        """Return the band for arms whose motions brake in these times [s]."""
        return self.drift + self.report + 2 * self.message + self.tick + self.cycle + max(braking, default=0.0)


def braking_time(path: TimedPath, limits: Limits) -> float:
    """Return an upper bound of the time [s] in which the executor stops an arm on its path.

    A joint loses its speed at its deceleration limit, which is reached and left at its jerk limit. Where the path
    itself accelerates, only half of the limit is left for braking in the worst case.
    """
    fastest = np.abs(path.velocities).max(axis=0)
    steady = float((2 * fastest / limits.braking).max())
    onset = float((2 * np.minimum(limits.braking / limits.jerks, np.sqrt(fastest / limits.jerks))).max())
    return max(SHORTEST_STOP, steady) + onset
