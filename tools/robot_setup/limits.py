"""What the joints of an arm may do: as its URDF says, and by these rules where it does not."""

from __future__ import annotations

import math

from common.errors import ConfigError
from tools.robot_setup.tree import Joint

SPEED = 1.0  # of a joint whose URDF gives none [rad/s or m/s]
TO_SPEED = 0.5  # a joint takes so long to its speed limit [s]: acceleration = velocity / 0.5
TO_ACCELERATION = 0.05  # and so long to its acceleration limit [s]: jerk = acceleration / 0.05
WIDEST = math.pi  # a joint that turns on and on, or farther than a full turn, is planned for within +- this [rad]


def position_range(joint: Joint) -> tuple[float, float, bool]:
    """Lowest and highest position [rad or m] that is planned for, and whether the URDF says otherwise.

    Raises:
        ConfigError: a joint that has ends says not where.
    """
    low, high = joint.lower, joint.upper
    if joint.kind == "continuous":
        return -WIDEST, WIDEST, True
    if low is None or high is None or not low < high:
        raise ConfigError("urdf", joint.name, f"is {joint.kind} and needs limits, lower before upper")
    if joint.kind == "revolute" and high - low > 2 * WIDEST + 1e-3 and low <= -WIDEST and high >= WIDEST:
        return -WIDEST, WIDEST, True
    return low, high, False


def guessed_acceleration(speed: float) -> float:
    """[rad/s^2 or m/s^2] of a joint with such a speed limit [rad/s or m/s]."""
    return round(speed / TO_SPEED, 3)


def guessed_jerk(acceleration: float) -> float:
    """[rad/s^3 or m/s^3] of a joint with such an acceleration limit."""
    return round(acceleration / TO_ACCELERATION, 2)
