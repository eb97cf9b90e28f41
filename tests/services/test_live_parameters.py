"""Tunable parameters are read where they are used, so a change takes effect at once."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from applications.outlining.topics import OutlinePoints
from applications.pick_place.topics import REJECTED_TARGETS, WORKSPACE_MARKERS
from common import topics
from common.config import Parameters, World
from common.config.tunables import apply, checked, leaves, tunable_sections
from common.messages import Interlock, StopRequest
from common.robot.transforms import tool_down
from common.sim.interface import GraspTolerances
from common.sim.kinematic import KinematicWorld
from tests.applications.outlining.outline_double import OutlineDouble
from tests.applications.pick_place.cell_double import CellDouble
from tests.services.fake_cell import until
from tests.services.service_turns import CELLS, TURNS, Running, config_of
from tests.services.watched_reading import Watch

SERVICES = sorted({name for cell in CELLS.values() for name in cell.services} - {"viewer"} | {"camera_opencv"})
TUNABLE = [name for name in SERVICES if any(leaf.runtime for leaf in leaves(config_of(name), name).values())]

SPEEDS = {"trajectory_executor": 10.0}  # of the clock


def change(parameters: Parameters, **values: Any) -> None:
    apply(checked(parameters, "it", {f"services.it.{name}": value for name, value in values.items()}))


# --- parameters that are read only in rare situations ---


def test_more_retries_take_effect() -> None:
    cell = CellDouble([(0.40, -0.30)], max_retries=0)
    cell.slips = 3
    cell.until("close")
    change(cell.task.p, max_retries=3)
    cell.until("DONE")
    assert (cell.contained, cell.task.status.retries) == (1, 3)


def test_abandoned_objects_are_retried_after_a_parameter_change() -> None:
    cell = CellDouble([(0.40, -0.30), (0.47, -0.30)])
    change(cell.task.p, **{"hand.min_clearance": 0.05, "grace": 600.0})
    steps(cell, 20)
    reasons = [rejection.reason for rejection in cell.task.status.skipped]
    assert reasons == ["its neighbors leave no room for the fingers at any yaw"] * 2
    change(cell.task.p, **{"hand.min_clearance": 0.003})
    cell.until("DONE")
    assert cell.contained == 2


def steps(cell: CellDouble | OutlineDouble, count: int) -> None:
    for _ in range(count):
        cell.step()


def test_changed_grace_period_takes_effect_while_waiting() -> None:
    empty, unreachable = CellDouble([], empty=600.0), CellDouble([(0.7, 0.4)], grace=600.0)
    unreachable.unreachable = [(0.7, 0.4)]
    for cell, parameter in ((empty, "empty"), (unreachable, "grace")):
        steps(cell, 50)
        assert cell.task.status.state == "IDLE"
        change(cell.task.p, **{parameter: 1.0})
        cell.step()
        assert cell.task.status.state == "DONE"


def test_shorter_time_limit_stops_a_running_motion() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("pre-grasp")
    change(cell.task.p, goal_timeout=0.05)
    steps(cell, 2)
    assert "took longer than 0.05 s" in cell.task.status.message


@pytest.mark.parametrize(("make", "stage"), [
    (lambda: CellDouble([(0.40, -0.30)], obstacle_patience=600.0), "pre-grasp"),
    (lambda: OutlineDouble(obstacle_patience=600.0), "trace")])
def test_shorter_obstacle_patience_takes_effect(make: Callable[[], Any], stage: str) -> None:
    cell = make()
    cell.until(stage)
    obstacle = Interlock(kind="held", by="scene_monitor", reason="a mug obstructs", since=1)
    cell.motion = cell.motion.model_copy(update={
        "held": True, "held_by": ["scene_monitor"], "interlocks": [obstacle]})
    steps(cell, 50)
    assert cell.task.running is not None
    change(cell.task.p, obstacle_patience=1.0)
    assert any(isinstance(asked, StopRequest) for asked in cell.step())
    assert "a mug obstructs" in cell.task.status.message


def test_lower_failure_limit_takes_effect() -> None:
    cell = CellDouble([(0.40, -0.30)], max_failures=1000)
    cell.unplannable = lambda request: "no_path" if request.stage == "home" else ""
    change(cell.task.p, goal_timeout=0.05, max_failures=2)
    cell.until("ERROR", most=100)
    assert "that makes 2 failures in a row" in cell.task.status.message


@pytest.mark.parametrize("camera_on", [True, False])
def test_changed_selection_timeout_takes_effect_while_waiting(camera_on: bool) -> None:
    cell = OutlineDouble(selection_timeout=0.0, picture_timeout=0.0)
    cell.path = OutlinePoints(message="no object is chosen") if camera_on else None
    steps(cell, 200)
    assert cell.status.state == "SELECTING"
    change(cell.task.p, **{"selection_timeout" if camera_on else "picture_timeout": 1.0})
    cell.step()
    assert cell.status.state == "ERROR"


def test_shorter_overtime_stops_a_running_trace() -> None:
    cell = OutlineDouble()
    cell.until("trace")
    change(cell.task.p, overtime=1e-3)
    cell.arrival += 100
    cell.until("ERROR")
    assert "took longer than 1 s" in cell.status.message


def test_simulated_grasps_use_current_tolerances() -> None:
    tolerances = GraspTolerances()
    world = KinematicWorld(World(balls=[(0.5, 0.0)]), tolerances=tolerances)
    near = tool_down(0.5, 0.015, 0.03)
    assert world.obstruction(near, 0.08) == 0.0  # 5 mm into a finger
    change(tolerances, sideways=0.01)
    assert world.obstruction(near, 0.08) == pytest.approx(0.06)
    world.tick(1.0, near, 0.06, True)
    for time, release in ((1.1, 0.02), (1.2, 0.005)):
        change(tolerances, release=release)
        world.tick(time, near, 0.07, False)
        assert bool(world.held) == (release == 0.02)


class Flickering:
    """A device that is gone after each image."""

    live = True

    def __init__(self) -> None:
        self.images = [np.zeros((480, 640, 3), np.uint8)]

    def read(self) -> np.ndarray | None:
        return self.images.pop() if self.images else None

    def close(self) -> None:
        self.images.clear()


@pytest.mark.parametrize(("device", "parameter"), [(lambda: None, "reopen_at_most"), (Flickering, "reopen_after")])
async def test_lost_camera_uses_the_current_timeout(
    device: Callable[[], Any], parameter: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.camera_opencv.open_source", lambda *_, **__: device())
    longest = {"reopen_at_most": 1e-3} if parameter == "reopen_at_most" else {}
    async with Running("camera_opencv", tmp_path, reopen_after=1e-3, **longest) as running:
        log = running.reader(topics.LOG)
        for seconds in ("0.001", "0.002"):
            await running.tune(**{parameter: float(seconds)})
            await until(log, lambda line, s=seconds: line.message.endswith(f"opening it again in {s} s"))


RARE = {  # parameters with a test above
    "services.camera_opencv": ("reopen_after", "reopen_at_most"),
    "services.smart_pick_place": ("max_retries", "grace", "empty", "goal_timeout", "max_failures",
                                  "obstacle_patience"),
    "services.contour_tracer": ("obstacle_patience", "overtime", "picture_timeout", "selection_timeout"),
    "services.trajectory_executor": ("grasp_tolerances.sideways", "grasp_tolerances.release"),
}
RARE_PATHS = {f"{service}.{name}" for service, names in RARE.items() for name in names}


# --- every parameter of every service ---


@pytest.mark.parametrize("service", TUNABLE)
async def test_every_tunable_parameter_is_read_when_it_is_used(
    service: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = Running(service, tmp_path, speed=SPEEDS.get(service, 1.0))
    watch = Watch(monkeypatch, running.config, service)
    async with running:
        await running.turn()
        await running.turn()
        watch.begin()
        await running.turn()
        await running.turn()
    assert sorted(watch.tunable - watch.read - RARE_PATHS) == []


def test_rarely_read_parameters_share_a_model_with_frequent_ones() -> None:
    """So the test above shows that the service works with that model itself, and not with a copy."""
    for path in RARE_PATHS:
        service = path.split(".")[1]
        owners = {p: leaf.owner for p, leaf in leaves(config_of(service), service).items() if leaf.runtime}
        assert [p for p, owner in owners.items() if owner is owners[path] and p not in RARE_PATHS], path
    assert set(TUNABLE) <= set(TURNS)


@pytest.mark.parametrize("cell", CELLS)
def test_section_with_tunable_parameters_belongs_to_one_service_of_the_cell(cell: str) -> None:
    sections = [path for name in CELLS[cell].services for path in tunable_sections(type(config_of(name)))]
    assert sorted(sections) == sorted(set(sections)) == ["motion", "pipeline"]


# --- the next result after a change ---

ALL_BRIGHT = {"hsv_red_lo1": [0, 120, 255], "hsv_red_lo2": [170, 120, 255], "hsv_red_hi1": [1, 121, 255]}


def duration(answer: Any) -> float:
    return float(answer.trajectory.points[-1].time_from_start)


@pytest.mark.parametrize(("service", "result", "changes"), [
    ("vision_detector", len, [({}, 3), ({"min_contour_area_px": 9000.0}, 0), ({"min_contour_area_px": 400.0}, 2),
                              (ALL_BRIGHT, 0)]),
    ("contour_detector", lambda found: len(found.contours), [
        ({}, 1), ({"threshold": 220}, 0), ({"threshold": 127, "min_area": 1e5}, 0)]),
    ("smart_pick_place", lambda request: (request.goal.position_tolerance.x, request.planning_time), [
        ({}, (0.04, 2.0)), ({"grasp_pos_tol": 0.02, "planning_time": 3.0}, (0.02, 3.0))]),
    ("contour_tracer", lambda request: (request.goal.waypoints[0].position.z, request.goal.tool_speed), [
        ({}, (1.102, 0.05)), ({"standoff": 0.02, "tool_speed": 0.1}, (1.12, 0.1))]),
    ("contour_tracer", lambda request: request.goal.step, [({"step": 0.002}, 0.002)]),
    ("trajectory_executor", lambda status: status.error, [({}, ""), ({"tolerances.start": 1e-4}, "start_mismatch")]),
    ("scene_manager", len, [({"confirm_frames": 100, "forget_after": 60.0}, 0), ({}, 0), ({}, 0),
                            ({"confirm_frames": 3}, 1)]),
    ("depth_camera", lambda depth: bool(np.isnan(depth).all()), [({}, False), ({"depth_dropout": 1.0}, True)]),
    ("depth_camera", lambda depth: bool(np.nanmax(depth) > 1.74), [({}, True), ({"farthest": 1.70}, False)]),
    ("duplicate_remover", lambda path: len(path.poses) > 22, [({}, True), ({"tolerance": 0.005}, False)]),
])
async def test_changed_parameter_affects_the_next_result(
    service: str, result: Callable[[Any], Any], changes: list[tuple[dict[str, Any], Any]], tmp_path: Path
) -> None:
    async with Running(service, tmp_path, speed=SPEEDS.get(service, 1.0)) as running:
        for values, expected in changes:
            await running.tune(**values)
            assert result(await running.turn()) == expected, values


async def test_noise_and_brightness_take_effect_in_a_static_world(tmp_path: Path) -> None:
    def pixels(image: Any) -> Any:
        return np.frombuffer(image.data, np.uint8).astype(int)

    async with Running("camera_simulator", tmp_path) as service:
        before = pixels(await service.turn())
        await service.tune(brightness=20.0)
        assert (pixels(await service.turn()) == np.minimum(before + 20, 255)).all()
        await service.tune(brightness=0.0, noise_std=10.0)
        assert 5 < np.std(pixels(await service.turn()) - before) < 15
        await service.tune(noise_std=0.0)
        assert (pixels(await service.turn()) == before).all()
        await service.tune(rate=1e-4)
        waiting = asyncio.create_task(service.turn())
        await asyncio.sleep(0)
        await service.tune(rate=50.0)
        await waiting


async def test_velocity_scaling_takes_effect_in_the_next_plan(tmp_path: Path) -> None:
    async with Running("motion_planner", tmp_path) as service:
        fast = duration(await service.turn())
        await service.tune(**{"motion.velocity_scaling": 0.05, "motion.acceleration_scaling": 0.05})
        slow = duration(await service.turn())
        await service.tune(**{"motion.cartesian_speed_scale": 0.5})
        assert slow > 1.9 * fast
        assert duration(await service.turn()) == pytest.approx(2 * slow, rel=1e-6)


async def test_workspace_bounds_take_effect_on_markers_and_targets(tmp_path: Path) -> None:
    async with Running("workspace_validator", tmp_path) as service:
        shells, rejected = service.reader(WORKSPACE_MARKERS), service.reader(REJECTED_TARGETS)
        await service.turn()
        await service.tune(max_radius=0.5)
        await until(shells, lambda found: found.markers[0].scale.x == 1.0)
        turn = asyncio.create_task(service.turn())
        assert "too far" in (await until(rejected)).rejected[0].reason
        turn.cancel()
        await asyncio.wait({turn})


async def test_contours_rounding_and_rate_of_the_stages_take_effect(tmp_path: Path) -> None:
    async with Running("contour_detector", tmp_path) as service:
        await service.tune(subpixel=False)
        (found,) = (await service.turn()).contours
        assert all(u == round(u) for u, _ in found.pixels)
    async with Running("pixel_to_world", tmp_path) as service:
        await service.turn()
        await service.tune(rounding=0.05)
        for pose in (await service.turn()).poses:
            assert pose.position.x / 0.05 == pytest.approx(round(pose.position.x / 0.05))
    async with Running("robot_state_publisher", tmp_path) as service:
        await service.tune(rate=1.0)
        first = (await service.turn()).transforms[0].header.stamp
        assert (await service.turn()).transforms[0].header.stamp - first == 10**9
