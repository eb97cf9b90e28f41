"""Check a pick-and-place cell before it runs, and lay out a world within reach of an arm."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from applications.pick_place.detector import DetectorOptions
from applications.pick_place.grasping import RELEASED
from common.application import Checks
from common.config import CameraConfig, Cell, Container, Grasp, ObjectConfig, Reach, service_config
from common.config.basics import Rgb
from common.errors import ConfigError
from common.hardware.interface import has_simulated_world
from common.perception.pinhole import Pinhole
from common.planning.ik import controls_full_pose, solve_tool_down_ik
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel
from common.robot.transforms import tool_down
from common.scene.workspace import ReachCache, WorkspaceBounds, configured_bounds, unreachable_reason, yaw_candidates
from common.sim.layout import layout
from common.sim.objects import initial_pose, solid_of
from common.sim.table import is_inside
from tools.check import Finding, error, warning
from tools.check.arm import Arm
from tools.robot_setup.sampling import hits

ALONG = 0.03  # [m] tolerated offset of the position above a container: half of place_pos_tol


def quick(cell: Cell) -> Iterator[Finding]:
    """Find objects that the detectors would not detect, and containers without room for the objects."""
    things = cell.world.objects if has_simulated_world(cell.robot) else []
    detectors = _detectors(cell)
    of_others = any(entry.module.rpartition(".")[0] != "services" for entry in cell.services.values())
    for thing in things if detectors and not of_others else []:
        yield from _seen(cell, thing, detectors)
    for name, container in cell.world.containers.items():
        yield from _room(name, container, cell.world.ball_radius)
    slots, balls = sum(4 * each.layers for each in cell.world.containers.values()), len(things)
    if cell.world.containers and balls > slots:
        yield warning(f"world.containers: {balls} objects for {slots} places in {', '.join(cell.world.containers)}",
                      "give it more layers, or fewer objects")


def _detectors(cell: Cell) -> dict[str, tuple[DetectorOptions, CameraConfig]]:
    """Return parameters and camera of the cell's ball detectors by name."""
    found = {}
    for entry in cell.services.values():
        if entry.kind == "vision_detector":
            config = service_config(cell, entry.name, importlib.import_module(entry.module).Config)
            found[entry.name] = config, config.world.camera
    return found


def _seen(
    cell: Cell, thing: ObjectConfig, detectors: dict[str, tuple[DetectorOptions, CameraConfig]]
) -> Iterator[Finding]:
    radius = cell.world.ball_radius
    if thing.shape != "sphere" or thing.radius != radius:
        what = f"a sphere of radius {thing.radius:g} m" if thing.shape == "sphere" else f"a {thing.shape}"
        yield warning(f"world.objects: {thing.id} is {what}, {_names(detectors)} looks for spheres of "
                      f"world.ball_radius = {radius:g} m", "take spheres of that size, or a detector of your own")
        return
    hsv = _hsv(thing.color)
    if not any(_in_a_window(hsv, options) for options, _ in detectors.values()):
        yield error(f"world.objects: the colour of {thing.id}, {list(thing.color)}, is {hsv} as hue, saturation, "
                    f"value, which no window of {_names(detectors)} holds",
                    f"set services.{next(iter(detectors))}.hsv_red_lo1 and hsv_red_hi1, or another colour")
    if not thing.placed:
        return
    at = initial_pose(thing, solid_of(thing))[:3, 3]
    areas = {name: _area(at, radius, camera) / options.min_contour_area_px for name, (options, camera) in
             detectors.items()}
    best = max(areas, key=lambda name: areas[name])
    if 0 < areas[best] < 1:
        least = detectors[best][0].min_contour_area_px
        yield error(f"world.objects: {thing.id} appears on {areas[best] * least:.0f} px^2, less than "
                    f"services.{best}.min_contour_area_px = {least:g}", "set that lower, or bring the camera closer")


def _names(detectors: dict[str, tuple[DetectorOptions, CameraConfig]]) -> str:
    return " or ".join(detectors)


def _hsv(color: Rgb) -> tuple[int, int, int]:
    bgr = np.array([[[round(255 * part) for part in reversed(color)]]], np.uint8)
    hue, saturation, value = cv2.cvtColor(bgr, cv2.COLOR_BGR2HSV)[0, 0].tolist()
    return hue, saturation, value


def _in_a_window(hsv: tuple[int, int, int], o: DetectorOptions) -> bool:
    windows = ((o.hsv_red_lo1, o.hsv_red_hi1), (o.hsv_red_lo2, o.hsv_red_hi2))
    return any(all(low <= part <= high for low, part, high in zip(lows, hsv, highs, strict=True))
               for lows, highs in windows)


def _area(at: np.ndarray, radius: float, config: CameraConfig) -> float:
    """Image area of a sphere inside its outermost pixels [px^2], as contours measure it; 0 behind the camera."""
    distance = float(Pinhole.from_config(config).to_camera(at)[2])
    if distance <= 0:
        return 0.0
    return math.pi * math.prod(max(focal * radius / distance - 0.5, 0.0) for focal in (config.fx, config.fy))


def _room(name: str, container: Container, radius: float) -> Iterator[Finding]:
    inner, field = container.half_side - container.wall_thickness, f"world.containers.{name}"
    if inner < radius:
        yield error(f"{field}: {2e3 * inner:.0f} mm between the walls are too narrow for balls of "
                    f"{2e3 * radius:.0f} mm", f"set {field}.half_side")
    elif container.slot_offset + radius > inner + 1e-9:
        yield error(f"{field}.slot_offset: {container.slot_offset:g} puts balls of radius {radius:g} m into the walls, "
                    f"which are {inner:g} m from the middle", f"set {field}.half_side or slot_offset")


# --- reach --------------------------------------------------------------------------------------------------------


def reach(cell: Cell, arm: Arm) -> Iterator[Finding]:
    """Find objects out of the arm's reach, and containers that the tool cannot be above.

    Raises:
        ConfigError: inconsistent bounds, or no random layout within reach.
    """
    bounds = configured_bounds(cell.section(Reach).parameters)  # type: ignore[attr-defined]
    cache = ReachCache(arm.robot, cell.grasp, bounds)
    gripper = cell.robot.gripper
    width = gripper.max_width if gripper is not None and gripper.joints else None
    tilt = cell.grasp.tilt(arm.robot.dof)
    turned = f"with any of {bounds.yaw_count} gripper orientations" if controls_full_pose(arm.robot) else "at any yaw"
    turns = [yaw + (math.pi / 2 if gripper is not None and gripper.closing_axis == "x" else 0.0)
             for yaw in (yaw_candidates(bounds.yaw_count) if controls_full_pose(arm.robot) else [0.0])]
    things = []
    if has_simulated_world(cell.robot):
        layout(cell.world, cell.run.seed,
               lambda x, y, z: not unreachable_reason(arm.robot, (x, y, z), cell.grasp, bounds, explained=False))
        things = [thing for thing in cell.world.objects if thing.placed]
    for thing in things:
        x, y, z = (float(value) for value in initial_pose(thing, solid_of(thing))[:3, 3])
        if any(is_inside(container, x, y) for container in cell.world.containers.values()):
            continue
        what = f"world.objects: {thing.id} at ({x:z.3f}, {y:z.3f}, {z:.3f}) cannot be taken"
        low = cell.grasp.height(z)
        poses = [tool_down(x, y, low, turn) for turn in turns]
        if reason := cache.reason((x, y, z)):
            explained = reason.startswith(("too ", "singular")) or not controls_full_pose(arm.robot)
            why = "" if explained else arm.why_not(poses, width, tilt)
            yield error(f"{what}, {reason}{f' ({why})' if why else ''}", "move it, or robot.base_position")
        elif why := arm.why_not(poses, width, tilt):
            yield error(f"{what}, {why} {turned}",
                        "move it away from there, or set grasp.grasp_clearance or grasp.min_grasp_z")
    for name, box in cell.world.containers.items():
        nearer = 1 - ALONG / max(math.hypot(box.x, box.y), ALONG)
        poses = [tool_down(share * box.x, share * box.y, cell.grasp.drop_z, turn)
                 for share in (1.0, nearer) for turn in turns]
        if why := arm.why_not(poses, width, max(tilt, RELEASED)):
            yield error(f"world.containers.{name}: the tool cannot be above it, at ({box.x:z.3f}, {box.y:z.3f}, "
                        f"{cell.grasp.drop_z:.3f}), {turned}, {why}",
                        "move it, or set grasp.drop_z")


VALIDATOR = "workspace_validator"
STEP = 0.04  # grid of the positions that are tried [m]
ROOM = 0.015  # clearance between a ball and the open fingers [m]
BALL, SMALLEST = 0.03, 0.01  # radius [m]
BALLS = 7
# Half of the table area that the camera sees [m], a little less; container and slots have their default size.
SEEN_X, SEEN_Y = 0.34, 0.46
CLEAR = 0.16  # from the center of the container to a ball [m]
ENOUGH = 45  # grid positions needed for seven balls and a container
# Heights of approach, lift and release: lower ones for an arm too short for the first.
GRASPS: tuple[dict[str, float], ...] = (
    {}, {"approach_clearance": 0.06, "lift_height": 0.08, "drop_z": 0.2},
    {"approach_clearance": 0.04, "lift_height": 0.06, "drop_z": 0.18},
)
NEAREST = 0.12  # distance to the base axis at which the arm itself is not in collision [m]
RING = 0.08  # width of a ring of positions around the base [m]

Place = tuple[float, float]


def fit_world(robot: RobotModel, cell: dict[str, Any]) -> dict[str, Any]:
    """Return the tree of a cell file with a world in reach of the robot, grasp heights and workspace bounds.

    The balls get random positions, different for each seed; the image is centered on the reachable area.

    Raises:
        ConfigError: the robot has no usable gripper, or reaches too little.
    """
    gripper = robot.config.gripper
    if gripper is None:
        raise ConfigError("--cell", ..., "needs a robot with a gripper, because the task picks objects")
    radius = round(min(BALL, (gripper.max_width - ROOM) / 2), 3)
    if radius < SMALLEST:
        raise ConfigError("gripper.max_width", gripper.max_width,
                          f"is too narrow for the smallest ball, {2 * SMALLEST:g} m in diameter")
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
                      f"tool down: too few for {BALLS} balls and a box next to them")


def _reached(robot: RobotModel, grasp: Grasp, bounds: WorkspaceBounds, radius: float) -> list[Place]:
    """Return the positions on the table in front of the arm from which it can take a ball."""
    most = min(robot.reach, 1.0)
    found = []
    for x in np.arange(0.12, most, STEP):
        for y in np.arange(-most, most, STEP):
            place = round(float(x), 3), round(float(y), 3)
            if math.hypot(*place) >= most or abs(y) >= 0.6:
                continue
            if not unreachable_reason(robot, (*place, radius), grasp, bounds, explained=False):
                found.append(place)
    return found


def _is_free(robot: RobotModel, geometry: RobotGeometry, place: tuple[float, float, float], grasp: Grasp) -> bool:
    """Return whether the arm grasps there without self-collision, coming from home, with any gripper yaw."""
    x, y, z = place
    at, home, tilt = (x, y, grasp.height(z)), robot.named("home"), grasp.tilt(robot.dof)
    found = (solve_tool_down_ik(robot, at, yaw, home, tilt=tilt, iterations=20)
             for yaw in (yaw_candidates(WorkspaceBounds().yaw_count) if controls_full_pose(robot) else (0.0,)))
    return any(q is not None and not hits(robot, geometry, q) for q in found)


def _free_from(reached: list[Place], free: list[bool]) -> float:
    """Return the radius [m] of the first ring around the base in which grasps are almost all free of self-collision."""
    away = [math.hypot(*place) for place in reached]
    for nearest in np.arange(NEAREST, max(away, default=NEAREST), STEP):
        ring = [clear for clear, radius in zip(free, away, strict=True) if nearest <= radius < nearest + RING]
        if ring and sum(ring) >= 0.9 * len(ring):
            return round(float(nearest), 2)
    return round(max(away, default=NEAREST), 2)


def _box(robot: RobotModel, reached: list[Place], grasp: Grasp) -> tuple[Place, float] | None:
    """Return the container's position at the side of the image, and x of the image center; None without room."""
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
    """Return whether the tool can be above the container, coming from home."""
    at, tilt = (*place, grasp.drop_z), grasp.tilt(robot.dof) if controls_full_pose(robot) else RELEASED
    return solve_tool_down_ik(robot, at, 0.0, robot.named("home"), tilt=tilt, restarts=20, iterations=40) is not None


CHECKS = Checks(quick=quick, reach=reach)
