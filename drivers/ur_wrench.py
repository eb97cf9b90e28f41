"""The force sensor of UR's e-series in the frame of the flange.

RTDE's `actual_TCP_force` is what acts on the arm at the tool flange, less the payload that the controller knows, but
along the axes of the arm's base; its torque is about the flange, not about the TCP (as Universal Robots' own ROS driver
transforms it, tested there on a UR3e). A CB3 only estimates a force from motor currents, about the TCP: not used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

TWISTS = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)  # alpha of the joints (Denavit-Hartenberg), all models


def at_flange(q: Sequence[float], wrench: Sequence[float]) -> list[float]:
    """Return a wrench (6,) [N], [N m], given along the axes of the base, along those of the flange at q (6,) [rad]."""
    rotation = np.eye(3)  # of the flange in the base
    for angle, twist in zip(q, TWISTS, strict=True):
        (c, s), (ca, sa) = (math.cos(angle), math.sin(angle)), (math.cos(twist), math.sin(twist))
        rotation = rotation @ [[c, -s * ca, s * sa], [s, c * ca, -c * sa], [0.0, sa, ca]]
    return [*(rotation.T @ wrench[:3]).tolist(), *(rotation.T @ wrench[3:]).tolist()]
