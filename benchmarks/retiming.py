"""Duration of trajectories compared with toppra's on the same paths: `python -m benchmarks.retiming [--pairs N]`.

Paths between random positions of the Panda through one in between, corners rounded off, as `common/planning` does it,
with jerk limits raised 1000-fold: toppra has none. It exits with 1 where one takes more than 5 % longer. toppra is no
dependency: install it (`pip install toppra`).
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from numpy.typing import NDArray

from common.config import load_cell
from common.planning.path import SmoothPath, blended_path
from common.planning.retiming import limited_jerk, parametrise
from common.planning.waypoint_timing import BLENDS, LIMIT_SHARE
from common.robot.model import RobotModel

Array = NDArray[np.float64]

MOST = 0.05  # share by which ours may take longer
RAISED = 1000.0  # times the jerk limits
GRID = 2000  # points of toppra's grid


def of_toppra(path: SmoothPath, velocity: Array, acceleration: Array) -> float:
    """Seconds that toppra needs for a path from rest to rest."""
    import toppra
    from toppra.algorithm import TOPPRA
    from toppra.constraint import DiscretizationType, JointAccelerationConstraint, JointVelocityConstraint
    from toppra.interpolator import AbstractGeometricPath

    ends = np.concatenate([[0.0], np.cumsum(path.lengths)])

    class Pieces(AbstractGeometricPath):  # type: ignore[misc]
        """The parabolas of a path."""

        @property
        def dof(self) -> int:
            return int(path.starts.shape[1])

        @property
        def path_interval(self) -> Array:
            return np.array([0.0, ends[-1]])

        @property
        def waypoints(self) -> None:
            return None

        def __call__(self, positions: Array | float, order: int = 0) -> Array:
            s = np.atleast_1d(np.asarray(positions, dtype=float))
            i = np.clip(np.searchsorted(ends, s, side="right") - 1, 0, len(path.lengths) - 1)
            at, length = (s - ends[i])[:, None], path.lengths[i][:, None]
            bend = (path.d1[i] - path.d0[i]) / length
            found = (path.starts[i] + at * (path.d0[i] + at * bend / 2), path.d0[i] + at * bend, bend)[order]
            return found[0] if np.ndim(positions) == 0 else found

    toppra.setup_logging("ERROR")
    limits = [JointVelocityConstraint(np.stack([-velocity, velocity], axis=1)),
              JointAccelerationConstraint(np.stack([-acceleration, acceleration], axis=1),
                                          discretization_scheme=DiscretizationType.Interpolation)]
    grid = np.unique(np.concatenate([np.linspace(0.0, ends[-1], GRID), ends]))
    trajectory = TOPPRA(limits, Pieces(), gridpoints=grid).compute_trajectory()
    if trajectory is None:
        raise SystemExit("toppra found no trajectory")
    return float(trajectory.duration)


def main() -> int:
    """Print the shares by which ours take longer; 1 where one is more than 5 %."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=50)
    parser.add_argument("--scaling", type=float, default=0.2)
    given = parser.parse_args()
    robot = RobotModel.load(load_cell("panda").robot)
    rng = np.random.default_rng(0)
    velocity, acceleration, jerk = (given.scaling * limit for limit in (robot.velocity, robot.acceleration, robot.jerk))
    longer = []
    for _ in range(given.pairs):
        points = rng.uniform(robot.lower, robot.upper, (3, robot.dof))
        path, = blended_path(points, np.array([0.0, BLENDS[0], 0.0]))
        ours = limited_jerk(parametrise(path, LIMIT_SHARE * velocity, LIMIT_SHARE * acceleration), RAISED * jerk)
        longer.append(ours.duration / of_toppra(path, velocity, acceleration) - 1)
    median, most, least = (100 * float(each) for each in (np.median(longer), max(longer), min(longer)))
    print(f"{given.pairs} paths at {given.scaling:g} of the limits: {median:.2f} % longer than toppra's in the median, "
          f"{most:.2f} % at most, {least:.2f} % at least")
    return int(max(longer) > MOST)


if __name__ == "__main__":
    sys.exit(main())
