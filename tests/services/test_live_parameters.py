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
from common.messages import Interlock, PlanRequest, StopRequest
from common.robot.transforms import tool_down
from common.sim.interface import GraspTolerances
from common.sim.kinematic import KinematicWorld
from tests.applications.outlining.outline_double import OutlineDouble
from tests.applications.pick_place.cell_double import CellDouble
from tests.services.service_turns import CELLS, SCENARIOS, Running, config_of
from tests.services.watched_reading import Watch

SHOWS = ("viewer",)  # decides nothing; what of it is live is tested with its page
SERVICES = sorted({name for cell in CELLS.values() for name in cell.services} - set(SHOWS) | {"camera_opencv"})
TUNABLE = [name for name in SERVICES if any(leaf.runtime for leaf in leaves(config_of(name), name).values())]


def change(parameters: Parameters, **values: Any) -> None:
    apply(checked(parameters, "it", {f"services.it.{name}": value for name, value in values.items()}))


# --- what is read only when something rare happens ----------------------------------------------------------------


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
    for _ in range(20):
        cell.step()
    reasons = [rejection.reason for rejection in cell.task.status.skipped]
    assert reasons == ["its neighbors leave no room for the fingers at any yaw"] * 2
    change(cell.task.p, **{"hand.min_clearance": 0.003})
    cell.until("DONE")
    assert cell.contained == 2


def test_changed_grace_period_takes_effect_while_waiting() -> None:
    cell = CellDouble([], empty=600.0)
    for _ in range(50):
        cell.step()
    assert cell.task.status.state == "IDLE"
    change(cell.task.p, empty=1.0)
    cell.step()
    assert cell.task.status.state == "DONE"
    left = CellDouble([(0.7, 0.4)], grace=600.0)
    left.unreachable = [(0.7, 0.4)]
    for _ in range(50):
        left.step()
    change(left.task.p, grace=1.0)
    left.step()
    assert left.task.status.state == "DONE"


def test_shorter_time_limit_stops_a_running_motion() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("pre-grasp")
    change(cell.task.p, goal_timeout=0.05)
    cell.step()
    cell.step()
    assert "took longer than 0.05 s" in cell.task.status.message


@pytest.mark.parametrize("make", [lambda: CellDouble([(0.40, -0.30)], obstacle_patience=600.0),
                                  lambda: OutlineDouble(obstacle_patience=600.0)])
def test_shorter_obstacle_patience_takes_effect(make: Callable[[], Any]) -> None:
    cell = make()
    cell.until("pre-grasp" if isinstance(cell, CellDouble) else "trace")
    obstacle = Interlock(kind="held", by="scene_monitor", reason="a mug is in the way", since=1)
    cell.motion = cell.motion.model_copy(update={
        "held": True, "held_by": ["scene_monitor"], "interlocks": [obstacle]})
    for _ in range(50):
        cell.step()
    assert cell.task.running is not None
    change(cell.task.p, obstacle_patience=1.0)
    assert any(isinstance(asked, StopRequest) for asked in cell.step())
    assert "a mug is in the way" in cell.task.status.message


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
    for _ in range(200):
        cell.step()
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
    change(tolerances, release=0.02)
    world.tick(1.1, near, 0.07, False)
    assert world.held
    change(tolerances, release=0.005)
    world.tick(1.2, near, 0.07, False)
    assert not world.held


class Flickering:
    """A device that is gone after each picture."""

    live = True

    def __init__(self) -> None:
        self.pictures = [np.zeros((480, 640, 3), np.uint8)]

    def read(self) -> np.ndarray | None:
        return self.pictures.pop() if self.pictures else None

    def close(self) -> None:
        self.pictures.clear()


async def waits(running: Running, values: list[dict[str, float]], said: list[str]) -> None:
    """Return when the camera has said how long it waits, after each change."""
    async with running, asyncio.timeout(30):
        log = running.bus.reader(topics.LOG)
        for change_, wait in zip(values, said, strict=True):
            await running.tune(**change_)
            while not (await log.next()).message.endswith(f"opening it again in {wait} s"):
                pass


async def test_lost_camera_uses_the_current_timeout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = Running("camera_opencv", tmp_path)
    running.config = running.config.model_copy(update={"reopen_after": 1e-3, "reopen_at_most": 1e-3})
    monkeypatch.setattr("services.camera_opencv.open_source", lambda *_, **__: None)
    await waits(running, [{}, {"reopen_at_most": 2e-3}], ["0.001", "0.002"])
    running = Running("camera_opencv", tmp_path)
    running.config = running.config.model_copy(update={"reopen_after": 1e-3})
    monkeypatch.setattr("services.camera_opencv.open_source", lambda *_, **__: Flickering())
    await waits(running, [{}, {"reopen_after": 2e-3}], ["0.001", "0.002"])


RARE: dict[str, Callable[..., Any]] = {
    "services.camera_opencv.reopen_after": test_lost_camera_uses_the_current_timeout,
    "services.camera_opencv.reopen_at_most": test_lost_camera_uses_the_current_timeout,
    "services.smart_pick_place.max_retries": test_more_retries_take_effect,
    "services.smart_pick_place.grace": test_changed_grace_period_takes_effect_while_waiting,
    "services.smart_pick_place.empty": test_changed_grace_period_takes_effect_while_waiting,
    "services.smart_pick_place.goal_timeout": test_shorter_time_limit_stops_a_running_motion,
    "services.smart_pick_place.max_failures": test_lower_failure_limit_takes_effect,
    "services.smart_pick_place.obstacle_patience": test_shorter_obstacle_patience_takes_effect,
    "services.contour_tracer.obstacle_patience": test_shorter_obstacle_patience_takes_effect,
    "services.contour_tracer.overtime": test_shorter_overtime_stops_a_running_trace,
    "services.contour_tracer.picture_timeout":
        test_changed_selection_timeout_takes_effect_while_waiting,
    "services.contour_tracer.selection_timeout":
        test_changed_selection_timeout_takes_effect_while_waiting,
    "services.trajectory_executor.grasp_tolerances.sideways":
        test_simulated_grasps_use_current_tolerances,
    "services.trajectory_executor.grasp_tolerances.release": test_simulated_grasps_use_current_tolerances,
}


# --- every parameter of every service -----------------------------------------------------------------------------


@pytest.mark.parametrize("service", TUNABLE)
@pytest.mark.slow
async def test_every_tunable_parameter_is_read_when_it_is_used(
    service: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = Running(service, tmp_path)
    watch = Watch(monkeypatch, running.config, service)
    async with running:
        await running.turn()
        await running.turn()
        watch.begin()
        await running.turn()
        await running.turn()
    assert sorted(watch.tunable - watch.read - set(RARE)) == []


@pytest.mark.parametrize("path", RARE)
def test_rarely_read_parameters_share_a_model_with_frequent_ones(path: str) -> None:
    """So the test above shows that the service works with that model itself, and not with a copy."""
    service = path.split(".")[1]
    owners = {p: leaf.owner for p, leaf in leaves(config_of(service), service).items() if leaf.runtime}
    assert [p for p, owner in owners.items() if owner is owners[path] and p not in RARE]


def test_listed_rare_parameters_exist() -> None:
    tunable = {p for name in TUNABLE for p, leaf in leaves(config_of(name), name).items() if leaf.runtime}
    assert set(RARE) <= tunable
    assert set(TUNABLE) <= set(SCENARIOS)


@pytest.mark.parametrize("cell", CELLS)
def test_a_section_with_parameters_to_change_is_declared_by_one_service_of_the_cell(cell: str) -> None:
    sections = [path for name in CELLS[cell].services for path in tunable_sections(type(config_of(name)))]
    assert sorted(sections) == sorted(set(sections)) == ["motion", "pipeline"]


# --- what the next thing done is like -----------------------------------------------------------------------------


async def test_larger_minimum_area_takes_effect_on_an_unchanged_image(tmp_path: Path) -> None:
    async with Running("vision_detector", tmp_path) as service:
        assert len(await service.turn()) == 3
        await service.tune(min_contour_area_px=9000.0)
        assert await service.turn() == []
        await service.tune(min_contour_area_px=400.0)
        assert len(await service.turn()) == 2
        await service.tune(hsv_red_lo1=[0, 120, 255], hsv_red_lo2=[170, 120, 255], hsv_red_hi1=[1, 121, 255])
        assert await service.turn() == []


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


async def test_raised_camera_rate_takes_effect_at_once(tmp_path: Path) -> None:
    async with Running("camera_simulator", tmp_path) as service:
        await service.turn()
        await service.tune(rate=1e-4)
        waiting = asyncio.create_task(service.turn())
        await asyncio.sleep(0)
        await service.tune(rate=50.0)
        await waiting
        await service.turn()


async def test_velocity_scaling_takes_effect_in_the_next_plan(tmp_path: Path) -> None:
    def seconds(answer: Any) -> float:
        return float(answer.trajectory.points[-1].time_from_start)

    async with Running("motion_planner", tmp_path) as service:
        fast = seconds(await service.turn())
        await service.tune(**{"motion.velocity_scaling": 0.05, "motion.acceleration_scaling": 0.05})
        slow = seconds(await service.turn())
        await service.tune(**{"motion.cartesian_speed_scale": 0.5})
        assert slow > 1.9 * fast
        assert seconds(await service.turn()) == pytest.approx(2 * slow, rel=1e-6)


async def test_goal_tolerance_and_planning_time_take_effect_in_the_next_request(tmp_path: Path) -> None:
    async with Running("smart_pick_place", tmp_path) as service:
        request: PlanRequest = await service.turn()
        assert (request.goal.position_tolerance.x, request.planning_time) == (0.04, 2.0)  # type: ignore[union-attr]
        await service.tune(grasp_pos_tol=0.02, planning_time=3.0)
        request = await service.turn()
        assert (request.goal.position_tolerance.x, request.planning_time) == (0.02, 3.0)  # type: ignore[union-attr]


async def test_goal_tolerances_take_effect(tmp_path: Path) -> None:
    async with Running("trajectory_executor", tmp_path, speed=10.0) as service:
        assert (await service.turn()).state == "succeeded"
        await service.tune(**{"tolerances.start": 1e-4})
        assert (await service.turn()).error == "start_mismatch"


async def test_workspace_bounds_take_effect_on_markers_and_targets(tmp_path: Path) -> None:
    async with Running("workspace_validator", tmp_path) as service:
        shells, rejected = service.bus.reader(WORKSPACE_MARKERS), service.bus.reader(REJECTED_TARGETS)
        await service.turn()
        await service.tune(max_radius=0.5)
        async with asyncio.timeout(30):
            while (await shells.next()).markers[0].scale.x != 1.0:
                pass
            turn = asyncio.create_task(service.turn())
            assert "too far" in (await rejected.next()).rejected[0].reason
        turn.cancel()
        await asyncio.wait({turn})


async def test_confirm_frames_take_effect(tmp_path: Path) -> None:
    async with Running("scene_manager", tmp_path) as service:
        await service.tune(confirm_frames=100, forget_after=60.0)
        assert [await service.turn() for _ in range(5)] == [[]] * 5
        await service.tune(confirm_frames=3)
        assert len(await service.turn()) == 1


async def test_depth_range_takes_effect(tmp_path: Path) -> None:
    async with Running("depth_camera", tmp_path) as service:
        farthest = float(np.nanmax(await service.turn()))
        await service.tune(farthest=farthest - 0.05, depth_dropout=0.0)
        assert float(np.nanmax(await service.turn())) < farthest - 0.04
        await service.tune(depth_dropout=1.0)
        assert np.isnan(await service.turn()).all()


async def test_contour_threshold_takes_effect(tmp_path: Path) -> None:
    async with Running("contour_detector", tmp_path) as service:
        assert len((await service.turn()).contours) == 1
        await service.tune(threshold=220)
        assert (await service.turn()).contours == []
        await service.tune(threshold=127, min_area=1e5)
        assert (await service.turn()).contours == []
        await service.tune(min_area=0.0, subpixel=False)
        (found,) = (await service.turn()).contours
        assert all(u == round(u) for u, _ in found.pixels)


async def test_rounding_and_tolerance_take_effect_in_the_next_outline(tmp_path: Path) -> None:
    async with Running("pixel_to_world", tmp_path) as service:
        await service.turn()
        await service.tune(rounding=0.05)
        for pose in (await service.turn()).poses:
            assert pose.position.x / 0.05 == pytest.approx(round(pose.position.x / 0.05))
    async with Running("duplicate_remover", tmp_path) as service:
        many = len((await service.turn()).poses)
        await service.tune(tolerance=0.005)
        assert len((await service.turn()).poses) < many / 4


async def test_standoff_and_speed_take_effect_in_the_next_trace(tmp_path: Path) -> None:
    async with Running("contour_tracer", tmp_path) as service:
        trace = (await service.turn()).goal
        assert (trace.waypoints[0].position.z, trace.tool_speed) == (1.102, 0.05)
        await service.tune(standoff=0.02, tool_speed=0.1, step=0.002)
        trace = (await service.turn()).goal
        assert (trace.waypoints[0].position.z, trace.tool_speed, trace.step) == (1.12, 0.1, 0.002)


async def test_tf_rate_takes_effect(tmp_path: Path) -> None:
    async with Running("robot_state_publisher", tmp_path) as service:
        await service.turn()
        await service.tune(rate=1.0)
        first = (await service.turn()).transforms[0].header.stamp
        assert (await service.turn()).transforms[0].header.stamp - first == 10**9
