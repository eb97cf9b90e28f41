"""Check a pick-and-place cell before it runs, and lay out a world within reach of an arm."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator

import cv2
import numpy as np

from applications.pick_place.detector import DetectorOptions
from applications.pick_place.grasping import RELEASED
from common.application import Checks
from common.config import CameraConfig, Cell, Container, ObjectConfig, Reach, service_config
from common.config.basics import Rgb
from common.hardware.backends import has_simulated_world
from common.perception.pinhole import Pinhole
from common.planning.ik import controls_full_pose
from common.robot.transforms import tool_down
from common.scene.workspace import ReachCache, configured_bounds, unreachable_reason, yaw_candidates
from common.sim.layout import layout
from common.sim.objects import initial_pose, solid_of
from common.sim.table import is_inside
from tools.check import Finding, error, warning
from tools.check.arm import Arm

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


CHECKS = Checks(quick=quick, reach=reach)
