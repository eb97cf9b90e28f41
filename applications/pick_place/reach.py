"""A world for an arm that nobody has set up: table, box, camera and balls where it takes things from, tool down."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from applications.pick_place.parameters import RELEASED
from common.config import Grasp
from common.errors import ConfigError
from common.planning.ik import controls_full_pose, solve_tool_down_ik
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel
from common.scene.workspace import WorkspaceBounds, reach_reason, yaw_candidates
from tools.robot_setup.home import hits

VALIDATOR = "workspace_validator"
STEP = 0.04  # of the grid of places that are tried [m]
ROOM = 0.015  # more than a ball that fingers leave when open [m]
BALL, SMALLEST = 0.03, 0.01  # radius [m]
BALLS = 7
# Half the picture that the camera has of the table [m], a little less; the box and its slots are as they always are.
SEEN_X, SEEN_Y = 0.34, 0.46
CLEAR = 0.16  # from the middle of the box to that of a ball [m]
ENOUGH = 45  # places of the grid, of which seven balls need not fill many
# Heights of approach, lift and release: an arm that is too short for the first has lower ones.
GRASPS: tuple[dict[str, float], ...] = (
    {}, {"approach_clearance": 0.06, "lift_height": 0.08, "drop_z": 0.2},
    {"approach_clearance": 0.04, "lift_height": 0.06, "drop_z": 0.18},
)
NEAREST = 0.12  # to the axis of the base, where the arm itself is not in the way [m]
RING = 0.08  # width of a ring of places about the base, all of which are to be free [m]

Place = tuple[float, float]


def fitted(robot: RobotModel, cell: dict[str, Any]) -> dict[str, Any]:
    """The tree of a cell file, with a world in reach of the robot, heights of grasps and bounds of the workspace.

    Balls lie at random places, another for each seed, in a picture whose middle is that of what is reached.

    Raises:
        ConfigError: the robot grasps nothing, or reaches too little.
    """
    gripper = robot.config.gripper
    if gripper is None:
        raise ConfigError("--cell", ..., "needs a robot with a gripper: it is to take things")
    radius = round(min(BALL, (gripper.max_width - ROOM) / 2), 3)
    if radius < SMALLEST:
        raise ConfigError("gripper.max_width", gripper.max_width, f"is too narrow for a ball of {2 * SMALLEST:g} m")
    geometry, most = RobotGeometry(robot), 0
    for heights in GRASPS:
        grasp = Grasp.model_validate(heights)
        bounds = WorkspaceBounds(min_radius=NEAREST, max_radius=round(robot.reach, 2))
        reached = _reached(robot, grasp, bounds, radius)
        nearest = _free_from(reached, [_is_free(robot, geometry, (*place, radius), grasp) for place in reached])
        reached = [place for place in reached if math.hypot(*place) >= nearest]
        bounds = bounds.model_copy(update={"min_radius": nearest})
        most = max(most, len(reached))
        box = _box(robot, reached, grasp)
        if box is None:
            continue
        (x, y), middle = box
        services = dict(cell["services"])
        if VALIDATOR in services:
            services[VALIDATOR] = {**(services[VALIDATOR] or {}), "min_radius": bounds.min_radius,
                                   "max_radius": bounds.max_radius}
        side = round(middle + SEEN_X + 0.1, 2)
        world = {
            "fixtures": [{"id": "table", "shape": "box", "dimensions": [side, 1.2, 0.05],
                          "position": [side / 2, 0.0, -0.025], "color": [0.55, 0.35, 0.10]}],
            "container": {"id": "box", "x": x, "y": y},
            "camera": {"position": [middle, 0.0, 0.8]},
            "ball_radius": radius, "layout": "random", "count": BALLS,
        }
        return {**cell, "world": world, **({"grasp": heights} if heights else {}), "services": services}
    raise ConfigError("--cell", ..., f"the arm takes things from {most} of the places {STEP:g} m apart in front of it, "
                      f"tool down: too few for {BALLS} balls and a box beside them")


def _reached(robot: RobotModel, grasp: Grasp, bounds: WorkspaceBounds, radius: float) -> list[Place]:
    """Places on the table in front of the arm from which it takes a ball."""
    most = min(robot.reach, 1.0)
    found = []
    for x in np.arange(0.12, most, STEP):
        for y in np.arange(-most, most, STEP):
            place = round(float(x), 3), round(float(y), 3)
            if math.hypot(*place) >= most or abs(y) >= 0.6:
                continue
            if not reach_reason(robot, (*place, radius), grasp, bounds, explained=False):
                found.append(place)
    return found


def _is_free(robot: RobotModel, geometry: RobotGeometry, place: tuple[float, float, float], grasp: Grasp) -> bool:
    """Whether the arm is clear of itself as it takes something there, with one turn of the hand, coming from home."""
    x, y, z = place
    at, home, tilt = (x, y, grasp.height(z)), robot.named("home"), grasp.tilt(robot.dof)
    found = (solve_tool_down_ik(robot, at, yaw, home, tilt=tilt, iterations=20)
             for yaw in (yaw_candidates(WorkspaceBounds().yaw_count) if controls_full_pose(robot) else (0.0,)))
    return any(q is not None and not hits(robot, geometry, q) for q in found)


def _free_from(reached: list[Place], free: list[bool]) -> float:
    """The radius [m] of the first ring of places about the base in which the arm is in its own way hardly anywhere."""
    away = [math.hypot(*place) for place in reached]
    for nearest in np.arange(NEAREST, max(away, default=NEAREST), STEP):
        ring = [clear for clear, radius in zip(free, away, strict=True) if nearest <= radius < nearest + RING]
        if ring and sum(ring) >= 0.9 * len(ring):
            return round(float(nearest), 2)
    return round(max(away, default=NEAREST), 2)


def _box(robot: RobotModel, reached: list[Place], grasp: Grasp) -> tuple[Place, float] | None:
    """Where the box stands, at the side of the picture, and x of the middle of the picture; None without room."""
    best: tuple[float, Place, float] | None = None
    for middle in np.arange(0.2, 0.9, STEP):
        seen = [place for place in reached if abs(place[0] - middle) < SEEN_X and abs(place[1]) < SEEN_Y]
        for x, y in seen:
            if abs(y) > SEEN_Y - 0.1 or abs(x - middle) > SEEN_X - 0.1 or abs(y) < 0.1:
                continue
            free = sum(max(abs(x - other[0]), abs(y - other[1])) > CLEAR for other in seen)
            value = free + 20 * abs(y)
            if free >= ENOUGH and (best is None or value > best[0]) and _released(robot, (x, y), grasp):
                best = value, (x, y), round(float(middle), 2)
    return best[1:] if best is not None else None


def _released(robot: RobotModel, place: Place, grasp: Grasp) -> bool:
    """Whether the tool comes above the box, coming from home."""
    at, tilt = (*place, grasp.drop_z), grasp.tilt(robot.dof) if controls_full_pose(robot) else RELEASED
    return solve_tool_down_ik(robot, at, 0.0, robot.named("home"), tilt=tilt, restarts=20, iterations=40) is not None
