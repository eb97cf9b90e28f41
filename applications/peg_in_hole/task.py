"""The task: one peg after the other from the table into the hole, whose place is known to a millimetre and a degree."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from common import messages as m
from common.config import Parameters, RobotConfig, Scenery
from common.config.basics import Length, Point
from common.errors import ConfigError
from common.hardware.backends import is_simulated
from common.robot.transforms import invert, matrix_to_pose, pose_to_matrix, rpy_to_matrix
from common.sim.interface import KINEMATIC
from common.tasks.force import Insert
from common.tasks.handling import Handling, HandlingConfig
from common.tasks.stages import AwaitImage, Cycle, Grip, Move, Place, Stage, View, place_of

NEAR = 0.005  # [m] from the axis of the hole: a peg there is in it
LIFTED = 0.08  # [m] above the start of the insertion
FARTHER = 0.006  # [m] of the line beyond the depth, for a surface that is lower than expected


class Hole(Parameters):
    """Where the hole is, as the task knows it, and how the peg is inserted."""

    position: Point = Field(description="of the axis at the surface [m], world")
    around: list[str] = Field(min_length=1, description="ids of the fixtures that the peg may touch")
    error: float = Field(0.0, ge=0, le=0.005, description="added to the position in a direction drawn by seed [m]")
    tilt_error: float = Field(0.0, ge=0, le=0.1, description="of the peg about an axis drawn by seed [rad]")
    depth: Length = Field(0.015, description="below the surface [m]")
    clearance: Length = Field(0.01, description="height above the surface at which the insertion starts [m]")
    force: float = Field(12.0, gt=0, le=200, description="of the search and the push [N]")
    radius: Length = Field(0.003, description="of the search [m]")
    timeout: float = Field(80.0, gt=0, le=600, description="of one insertion [s]")

    def has(self, place: Place, length: float) -> bool:
        """Return whether a peg of this length [m] with its center at a place [m] is in the hole."""
        x, y, z = self.position
        return math.dist((x, y), place[:2]) < NEAR and place[2] - length / 2 < z - self.depth / 2


class Config(HandlingConfig):
    """Parameters of the task."""

    hole: Hole
    robot: RobotConfig
    scenery: Scenery = Scenery()

    def require_usable(self) -> None:
        """Require an arm that measures forces, as far as the configuration says.

        Raises:
            ConfigError: a simulated arm is in a world without forces.
        """
        super().require_usable()
        if self.scenery.simulator == KINEMATIC and is_simulated(self.robot):
            raise ConfigError("world.simulator", KINEMATIC, "has no forces, which an insertion needs: use mujoco")


class Inserting(Handling):
    """Brings each peg to the hole and inserts it; starts over with a peg that was not inserted."""

    p: Config

    def choose(self, view: View) -> None:
        """Insert the next peg that is not in the hole."""
        pegs = view.objects("target")
        outside = [peg for peg in pegs if not self._inserted(peg)]
        if outside:
            self.bring(outside, view)
        elif pegs:
            self.finish(view)
        else:
            self.lack("no peg is seen", view)

    def _inserted(self, peg: m.CollisionObject) -> bool:
        return self.p.hole.has(place_of(peg.pose), peg.dimensions[2])

    def destination(self, thing: m.CollisionObject, view: View) -> m.Pose | None:
        """Return the pose at the start of the insertion, with the configured errors."""
        T = np.eye(4)
        T[:3, 3] = self._start()
        T[2, 3] += thing.dimensions[2] / 2
        return matrix_to_pose(T)

    def _start(self) -> Place:
        """Return where the end of the peg starts [m]."""
        x, y, z = self.p.hole.position
        toward, off = self._drawn()[0], self.p.hole.error
        return x + off * math.cos(toward), y + off * math.sin(toward), z + self.p.hole.clearance

    def _drawn(self) -> tuple[float, float]:
        toward, about = np.random.default_rng(self.p.run.seed).uniform(0.0, 2 * math.pi, 2)
        return float(toward), float(about)

    def put(self, thing: m.CollisionObject, held: m.Pose, cycle: Cycle, view: View, width: float | None) -> list[Stage]:
        """Move above the hole, insert, release, retreat, go home and look."""
        goal = self.destination(thing, view)
        assert goal is not None
        tool = pose_to_matrix(goal) @ invert(pose_to_matrix(held))
        about = self._drawn()[1]
        tilt = rpy_to_matrix(self.p.hole.tilt_error * math.cos(about), self.p.hole.tilt_error * math.sin(about), 0.0)
        end = np.array(self._start())
        tool[:3, 3] = end + tilt @ (tool[:3, 3] - end)
        tool[:3, :3] = tilt @ tool[:3, :3]
        above = tool.copy()
        above[2, 3] += LIFTED
        hole, expected = self.p.hole, None if view.holding else held
        length = float(np.linalg.norm(tool[:3, 3] - end))
        insert = Insert(
            "insert", "PLACING", cycle, force=hole.force, frame="world", zero=True,
            max_distance=hole.clearance + hole.depth + FARTHER, carries=True, attach=thing.id, attach_pose=expected,
            touches=[(thing.id, name) for name in hole.around],
            fields={"depth": hole.depth, "tip": length, "surface": hole.clearance, "radius": hole.radius,
                    "timeout": hole.timeout})
        return [
            Move("across", "PLACING", cycle, goal=_at(above), carries=True, attach=thing.id, attach_pose=expected),
            Move("approach", "PLACING", cycle, goal=_at(tool), straight=True, carries=True, attach=thing.id,
                 attach_pose=expected),
            insert,
            Grip("release", "PLACING", cycle, width=self.opening(width), carries=True, holds=False),
            self.retreat(view, height=LIFTED),
            self.home(view),
            AwaitImage(),
        ]

    def note(self, view: View) -> None:
        """Count the inserted pegs."""
        if self.shown(view):
            pegs = view.objects("target")
            self.status.done, self.status.total = sum(map(self._inserted, pegs)), len(pegs)


def _at(T: NDArray[np.float64]) -> m.PoseGoal:
    return m.PoseGoal(pose=matrix_to_pose(T))
