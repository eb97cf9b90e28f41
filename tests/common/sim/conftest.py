import pytest

from common.config import World
from tests.common.sim.rig import TABLE

SPOTS = [(0.40, -0.30), (0.52, -0.30), (0.64, -0.25), (0.40, -0.17), (0.52, -0.17), (0.64, -0.13), (0.40, -0.04)]


@pytest.fixture(scope="session")
def world_config() -> World:
    return World(fixtures=[TABLE], spots=SPOTS)
