"""Problems with constrained paths, and checks with pinocchio's kinematics at every millisecond.

Both ends of a problem have a solution near the home pose: between other postures of the arm there may be no path with
an upright tool.
"""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from common.messages import Box, CollisionObject, PathConstraints, PlanningScene, PlanResponse, Pose, Vector3
from common.planning.collision import CollisionWorld
from common.planning.ik import solve_ik
from common.planning.trajectory import sample, timed_path
from common.robot.model import RobotModel
from common.robot.transforms import tool_down, transform
from tests.common.planning.scenes import only, solid

FLOOR = {"panda": 0.0, "ur5": 1.0}  # [m] height of the wall's foot
_WALL = 0.25  # [m] high
_POSTURE = 2.0  # [rad] at most from the home pose
_CORRIDOR = (0.3, 0.9, 0.35)  # [m] sides


@dataclass(frozen=True)
class ToolMotion:
    """The tool at every millisecond: places (N, 3) [m], axes (N, 3), speeds (N,) [m/s]."""

    places: np.ndarray
    axes: np.ndarray
    speeds: np.ndarray

    def tilt(self, axis=(0.0, 0.0, -1.0)) -> float:
        """The largest angle [rad] of the tool's z axis from an axis."""
        return float(np.arccos(np.clip(self.axes @ np.array(axis), -1, 1)).max())

    def outside(self, box: Box) -> float:
        """The largest distance [m] of the tool outside a box along the axes of world."""
        middle, size = box.pose.position, box.size
        away = np.abs(self.places - (middle.x, middle.y, middle.z))
        return float((away - np.array([size.x, size.y, size.z]) / 2).max())


def driven(robot: RobotModel, response: PlanResponse) -> ToolMotion:
    """The motion of the tool as the controller executes it."""
    assert response.ok, response.message
    trajectory = timed_path(response.trajectory)
    times = np.append(np.arange(0.0, trajectory.duration, 1e-3), trajectory.duration)
    model, data = robot.model, robot.model.createData()
    frame = model.getFrameId(robot.config.tcp_link)
    poses = []
    for q in sample(trajectory, times):
        pin.framesForwardKinematics(model, data, q)
        poses.append(data.oMf[frame].homogeneous.copy())
    poses = np.array(poses)
    speeds = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / np.diff(times)
    return ToolMotion(poses[:, :3, 3], poses[:, :3, 2], speeds)


@dataclass(frozen=True)
class Carry:
    """From a start (dof,) [rad] to a pose (4, 4) of the tool."""

    start: np.ndarray
    T_world_goal: np.ndarray


def walled(robot: str) -> PlanningScene:
    """A wall between the two sides."""
    floor = FLOOR[robot]
    return only(_box("floor", [0.6, 1.0, 0.05], floor - 0.025), _box("wall", [0.5, 0.02, _WALL], floor + _WALL / 2))


def _box(name: str, sides: list[float], z: float) -> CollisionObject:
    return solid(name, "fixture", "box", sides, (0.55, 0.0, z))


def constraints_of(name: str, robot: str) -> PathConstraints:
    """The constraints of a name such as "tilt 0.1, corridor"."""
    tilt = float(name.split()[1].rstrip(",")) if name.startswith("tilt") else None
    if "corridor" not in name:
        return PathConstraints(tilt=tilt)
    x, y, z = _CORRIDOR
    middle = Vector3(x=0.475, z=FLOOR[robot] + 0.05 + z / 2)
    return PathConstraints(tilt=tilt, region=Box(pose=Pose(position=middle), size=Vector3(x=x, y=y, z=z)))


def carries(robot: RobotModel, name: str, count: int, lean: float) -> list[Carry]:
    """Problems with free ends; the same ones each time."""
    rng = np.random.default_rng(0)
    world = CollisionWorld(robot, walled(name), start=robot.named("home"))
    found: list[Carry] = []
    while len(found) < count:
        side = rng.choice([-1.0, 1.0])
        ends = [_random_end(robot, world, rng, name, y, lean) for y in (side, -side)]
        if ends[0] is not None and ends[1] is not None:
            found.append(Carry(ends[0], robot.fk(ends[1])))
    return found


def _random_end(
    robot: RobotModel, world: CollisionWorld, rng: np.random.Generator, name: str, side: float, lean: float
) -> np.ndarray | None:
    """(dof,) [rad] free, with a nearly upright tool on one side of the wall; None if out of reach."""
    z = FLOOR[name] + rng.uniform(0.1, 0.3)
    T = tool_down(rng.uniform(0.38, 0.58), side * rng.uniform(0.15, 0.35), z, rng.uniform(-1.5, 1.5))
    about = rng.uniform(-np.pi, np.pi)
    turn = pin.exp3(rng.uniform(0, lean) * np.array([np.cos(about), np.sin(about), 0.0]))
    q = solve_ik(robot, transform(T[:3, :3] @ turn, T[:3, 3]), robot.named("home"), rng=rng)
    if q is None or world.collides(q) or np.abs(q - robot.named("home")).max() > _POSTURE:
        return None
    return q
