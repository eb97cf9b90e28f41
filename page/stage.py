"""What the layers of the scene stand on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import viser

    from common.config import Surroundings
    from common.robot.model import RobotModel
    from common.robot.visual_meshes import Piece
    from page.console import Console
    from page.feeds import Latest
    from page.figure import LinkPoses, Transforms
    from page.labels import View


@dataclass(frozen=True)
class Stage:
    """What a layer may look at and use. Poses are in world."""

    scene: viser.SceneApi  # to which nodes are added
    robot: RobotModel  # for kinematics, and what its file says
    around: Surroundings  # the camera and the table
    console: Console  # brings what a person does to the cell
    latest: Latest  # the newest message of a topic, of those that any part of the page reads
    clock: Callable[[], float]  # the time [s] by which things move that no message moves
    poses: LinkPoses  # where the robot's links are now
    transforms: Transforms  # where frames are now
    pieces: list[Piece]  # meshes of the robot
    rough: list[Piece]  # fewer triangles of the same
    view: Callable[[], View | None] = lambda: None  # how who looks first sees the scene
