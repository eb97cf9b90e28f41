from collections.abc import Callable

import numpy as np
import pytest

from common.hardware.interface import Limits
from common.messages import JointTrajectory, JointTrajectoryPoint
from tests.drivers.rig import Rig

Make = Callable[..., JointTrajectory]


@pytest.fixture(scope="session")
def limits() -> Limits:
    two = np.ones(2)
    return Limits(("shoulder", "elbow"), -3 * two, 3 * two, 2 * two, 10 * two)


@pytest.fixture(scope="session")
def rest_to_rest(limits: Limits) -> Make:
    """A quintic from rest to rest, sampled at `points` instants."""

    def make(start: list[float], end: list[float], duration: float = 1.0, points: int = 21) -> JointTrajectory:
        q0, move = np.array(start, dtype=float), np.array(end, dtype=float) - np.array(start, dtype=float)
        samples = []
        for u in np.linspace(0.0, 1.0, points):
            samples.append(
                JointTrajectoryPoint(
                    time_from_start=float(u * duration),
                    positions=(q0 + move * (10 * u**3 - 15 * u**4 + 6 * u**5)).tolist(),
                    velocities=(move * (30 * u**2 - 60 * u**3 + 30 * u**4) / duration).tolist(),
                    accelerations=(move * (60 * u - 180 * u**2 + 120 * u**3) / duration**2).tolist(),
                )
            )
        return JointTrajectory(joint_names=list(limits.names), points=samples)

    return make


@pytest.fixture
def rig(limits: Limits) -> Rig:
    return Rig(limits)
