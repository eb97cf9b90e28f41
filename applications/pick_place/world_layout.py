"""Lays out a world that suits an arm: table, container, camera, objects and heights, scaled to the arm's reach."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from applications.pick_place.grasping import RELEASED
from common.config import Grasp
from common.errors import ConfigError
from common.planning.ik import controls_full_pose, solve_tool_down_ik
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel
from common.scene.workspace import WorkspaceBounds, unreachable_reason, yaw_candidates
from tools.robot_setup.fingers import link_points
from tools.robot_setup.sampling import hits

VALIDATOR = "workspace_validator"
ROOM = 0.015  # clearance between a ball and the open fingers [m]
BALL, SMALLEST = 0.03, 0.01  # radius [m]
BALLS = 7
ENOUGH = 45  # grid positions needed for seven balls and a container
DEEP, WIDE = 1.2, 1.2  # area that is searched for positions [m], at scale 1

Place = tuple[float, float]


@dataclass(frozen=True)
class Scale:
    """Sizes of a layout [m]: those of the included cells times `factor`; the gripper limits the radius of the balls."""

    factor: float
    radius: float
    grasp: dict[str, float]

    @property
    def step(self) -> float:
        """Grid of the positions that are tried."""
        return 0.04 * self.factor

    @property
    def nearest(self) -> float:
        """Distance to the base axis at which the arm itself is not in collision."""
        return 0.12 * self.factor

    @property
    def seen(self) -> Place:
        """Half of the table area that the camera sees, a little less."""
        return 0.34 * self.factor, 0.46 * self.factor

    @property
    def clear(self) -> float:
        """From the center of the container to a ball."""
        return 0.16 * self.factor

    def container(self) -> dict[str, float]:
        """Return the sizes of the container, empty where they are the default ones."""
        if self.factor == 1:
            return {}
        sizes = {"half_side": 0.08, "wall_height": 0.1, "slot_offset": 0.033}
        return {name: round(size * self.factor, 4) for name, size in sizes.items()} | {"wall_thickness": 0.004}


# Approach, lift and release: lower ones for an arm too short for the first; then smaller worlds.
ATTEMPTS: tuple[tuple[float, dict[str, float]], ...] = (
    (1.0, {}),
    (1.0, {"approach_clearance": 0.06, "lift_height": 0.08, "drop_z": 0.2}),
    (1.0, {"approach_clearance": 0.04, "lift_height": 0.06, "drop_z": 0.18}),
    (0.7, {"approach_clearance": 0.04, "lift_height": 0.06, "drop_z": 0.14}),
    (0.5, {"approach_clearance": 0.03, "lift_height": 0.05, "drop_z": 0.1}),
    (0.4, {"approach_clearance": 0.03, "lift_height": 0.05, "drop_z": 0.09}),
)


def fit_world(robot: RobotModel, cell: dict[str, Any]) -> dict[str, Any]:
    """Return the tree of a cell file with a world in reach of the robot, grasp heights and workspace bounds.

    The table is at z = 0. The balls get random positions, different for each seed; the image is centered on the
    reachable area.

    Raises:
        ConfigError: the robot has no usable gripper, or reaches too little.
    """
    gripper = robot.config.gripper
    if gripper is None:
        raise ConfigError("--cell", ..., "needs a robot with a gripper, because the task picks objects; "
                          "--gripper robotiq_2f85.urdf mounts one")
    widest = (gripper.max_width - ROOM) / 2
    smallest = max(SMALLEST, round(gripper.travel[0][0] / 2 + 0.002, 3) if gripper.travel else 0.0)
    if round(min(BALL, widest), 3) < smallest:
        raise ConfigError("gripper.max_width", gripper.max_width,
                          f"is too narrow for the smallest ball, {2 * smallest:g} m in diameter")
    geometry, most, edge = RobotGeometry(robot), 0, _edge(robot)
    for factor, heights in ATTEMPTS:
        scale = Scale(factor, max(round(min(BALL * factor, widest), 3), smallest), heights)
        grasp = Grasp.model_validate(heights)
        bounds = WorkspaceBounds(min_radius=scale.nearest, max_radius=round(robot.reach, 2))
        reached = _reached(robot, grasp, bounds, scale, edge)
        nearest = _free_from(reached, [_is_free(robot, geometry, (*place, scale.radius), grasp) for place in reached],
                             scale)
        reached = [place for place in reached if math.hypot(*place) >= nearest]
        most = max(most, len(reached))
        box = _box(robot, reached, grasp, scale)
        if box is not None:
            bounds = bounds.model_copy(update={"min_radius": nearest})
            return {**cell, "world": _world(scale, *box, edge), **({"grasp": heights} if heights else {}),
                    "services": _services(cell["services"], bounds)}
    raise ConfigError("--cell", ..., f"the arm takes things from at most {most} of the places that were tried in front "
                      f"of it, tool down, up to {robot.reach:.2f} m away: too few for {BALLS} balls and a box")


def _services(services: dict[str, Any], bounds: WorkspaceBounds) -> dict[str, Any]:
    if VALIDATOR not in services:
        return dict(services)
    return {**services, VALIDATOR: {**(services[VALIDATOR] or {}), "min_radius": bounds.min_radius,
                                    "max_radius": bounds.max_radius}}


def _world(scale: Scale, place: Place, middle: float, edge: float) -> dict[str, Any]:
    margin = scale.seen[0] + 0.1 * scale.factor
    far = round(middle + margin, 2)
    edge = max(edge, round(middle - margin, 2)) if edge else 0.0
    return {
        "fixtures": [{"id": "table", "shape": "box", "dimensions": [round(far - edge, 3), 1.2 * scale.factor, 0.05],
                      "position": [round((far + edge) / 2, 3), 0.0, -0.025], "color": [0.55, 0.35, 0.10]}],
        "container": {"id": "box", "x": place[0], "y": place[1], **scale.container()},
        "camera": {"position": [middle, 0.0, 0.8 * scale.factor]},
        "ball_radius": scale.radius, "layout": "random", "count": BALLS,
        **({"min_separation": 0.07 * scale.factor, "container_clearance": 0.04 * scale.factor}
           if scale.factor < 1 else {}),
    }


def _edge(robot: RobotModel) -> float:
    """Return x of the table's near edge [m]: 0 if the arm is on it, else beyond what is below its top.

    The parts of the arm below the table may turn about the base.
    """
    if robot.config.base_position[2] >= 0:
        return 0.0
    poses = robot.link_poses(robot.named("home"))
    points = np.vstack([own @ poses[link][:3, :3].T + poses[link][:3, 3] for link, own in link_points(robot).items()])
    low = points[points[:, 2] < 0.02]
    return round(float(np.hypot(low[:, 0], low[:, 1]).max(initial=0.0)) + 0.05, 2)


def _reached(robot: RobotModel, grasp: Grasp, bounds: WorkspaceBounds, scale: Scale, edge: float) -> list[Place]:
    """Return the positions on the table in front of the arm from which it can take a ball."""

    def takes(x: float, y: float) -> bool:
        return math.hypot(x, y) < robot.reach and not unreachable_reason(
            robot, (x, y, scale.radius), grasp, bounds, explained=False)

    start = max(scale.nearest, edge + 2 * scale.radius if edge else 0.0)
    columns = [round(float(x), 3) for x in np.arange(start, robot.reach, scale.step)]
    half = scale.factor * WIDE / 2
    if len(columns) * scale.step > DEEP * scale.factor:  # an area around the middle of what is in reach
        ahead = [x for x in columns if any(takes(x, y) for y in (0.0, -half / 2, half / 2))]
        middle = float(np.median(ahead)) if ahead else 0.0
        columns = [x for x in ahead if abs(x - middle) <= DEEP * scale.factor / 2]
    rows = [round(float(y), 3) for y in np.arange(-min(half, robot.reach), min(half, robot.reach), scale.step)]
    return [(x, y) for x in columns for y in rows if takes(x, y)]


def _is_free(robot: RobotModel, geometry: RobotGeometry, place: tuple[float, float, float], grasp: Grasp) -> bool:
    """Return whether the arm grasps there without self-collision, coming from home, with any gripper yaw."""
    x, y, z = place
    at, home, tilt = (x, y, grasp.height(z)), robot.named("home"), grasp.tilt(robot.dof)
    found = (solve_tool_down_ik(robot, at, yaw, home, tilt=tilt, iterations=20)
             for yaw in (yaw_candidates(WorkspaceBounds().yaw_count) if controls_full_pose(robot) else (0.0,)))
    return any(q is not None and not hits(robot, geometry, q) for q in found)


def _free_from(reached: list[Place], free: list[bool], scale: Scale) -> float:
    """Return the radius [m] of the first ring around the base in which grasps are almost all free of self-collision."""
    away = [math.hypot(*place) for place in reached]
    for nearest in np.arange(scale.nearest, max(away, default=scale.nearest), scale.step):
        ring = [clear for clear, radius in zip(free, away, strict=True)
                if nearest <= radius < nearest + 2 * scale.step]
        if ring and sum(ring) >= 0.9 * len(ring):
            return round(float(nearest), 2)
    return round(max(away, default=scale.nearest), 2)


def _box(robot: RobotModel, reached: list[Place], grasp: Grasp, scale: Scale) -> tuple[Place, float] | None:
    """Return the container's position at the side of the image, and x of the image center; None without room."""
    best: tuple[float, Place, float] | None = None
    deep, wide = scale.seen
    inside = 0.1 * scale.factor
    ahead = [x for x, _ in reached]
    for middle in np.arange(max(min(ahead, default=0.0), 0.2 * scale.factor), max(ahead, default=0.0), scale.step):
        seen = [place for place in reached if abs(place[0] - middle) < deep and abs(place[1]) < wide]
        for x, y in seen:
            if abs(y) > wide - inside or abs(x - middle) > deep - inside or abs(y) < inside:
                continue
            free = sum(max(abs(x - other[0]), abs(y - other[1])) > scale.clear for other in seen)
            value = free + 20 * abs(y) / scale.factor
            if free >= ENOUGH and (best is None or value > best[0]) and _released(robot, (x, y), grasp):
                best = value, (x, y), round(float(middle), 2)
    return best[1:] if best is not None else None


def _released(robot: RobotModel, place: Place, grasp: Grasp) -> bool:
    """Return whether the tool can be above the container, coming from home."""
    at, tilt = (*place, grasp.drop_z), grasp.tilt(robot.dof) if controls_full_pose(robot) else RELEASED
    return solve_tool_down_ik(robot, at, 0.0, robot.named("home"), tilt=tilt, restarts=20, iterations=40) is not None
