from collections.abc import Callable

import pytest

from common.hardware.interface import Limits
from common.messages import JointTrajectory
from tests.common.control import trajectories
from tests.drivers.rig import Rig


@pytest.fixture(scope="session")
def limits() -> Limits:
    return trajectories.LIMITS


@pytest.fixture(scope="session")
def rest_to_rest() -> Callable[..., JointTrajectory]:
    return trajectories.rest_to_rest


@pytest.fixture
def rig(limits: Limits) -> Rig:
    return Rig(limits)
