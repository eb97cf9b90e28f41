"""A grasp as lines: two fingers and the bar between them, for pictures and the page."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from applications.sorting.topics import GraspCandidate
from common.robot.transforms import pose_to_matrix

LENGTH = 0.045  # [m] of a drawn finger


def finger_lines(grasp: GraspCandidate, axis: int) -> npt.NDArray[np.float64]:
    """Return two fingers and the bar that joins them as segments (3, 2, 3) [m] in world.

    Args:
        grasp: pose of the tool center point between the finger tips, and its opening.
        axis: of the tool along which the fingers close, 0 or 1.
    """
    T, aside, back = pose_to_matrix(grasp.pose), np.zeros(3), np.array([0.0, 0.0, -LENGTH])
    aside[axis] = grasp.opening / 2
    local = np.array([[-aside, -aside + back], [aside, aside + back], [-aside + back, aside + back]])
    return np.asarray(local @ T[:3, :3].T + T[:3, 3])
