"""Scores grasp candidates with the learned scorer."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from applications.sorting.grasps.candidates import Candidates
from applications.sorting.grasps.scoring import FEATURES
from applications.sorting.learning.network import Network
from applications.sorting.learning.patches import patches_of
from applications.sorting.surface import Surface

Array = npt.NDArray[np.float64]

NUMBERS = (*FEATURES, "opening", "height")  # what a network gets besides the patch: width and height of the tool [m]


def numbers_of(found: Candidates, floor: float) -> npt.NDArray[np.float32]:
    """Return (n, k) what `NUMBERS` names of candidates; `floor` is its z [m]."""
    height = found.T[:, 2, 3] - floor
    return np.column_stack([found.features, found.opening, height]).astype(np.float32)


def learned_score(network: Network, found: Candidates, surface: Surface, T_tcp_closing: Array) -> Array:
    """Return (n,) the probabilities that candidates hold.

    Args:
        network: that expects `NUMBERS`.
        found: candidates.
        surface: that they were found on.
        T_tcp_closing: (4, 4) pose of the gripper's closing frame in the frame of the tool.
    """
    return network.score(patches_of(surface, np.asarray(found.T @ T_tcp_closing)), numbers_of(found, surface.floor))
