"""Hardware backend: a mock arm that counts as real, in a simulated world, as a driver on a protocol double does."""

from common.config import Parameters
from common.hardware.mock import create as create_mock

simulated = False


class Options(Parameters):
    """Address of the arm."""

    host: str


def has_simulated_world(options):
    return True


def identity(options):
    return options.host


def create(robot, limits, start, options):
    return create_mock(robot, limits, start, None)
