"""A parameter that is marked as tunable is read where it is used: a change has an effect on the next thing done."""

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


def test_a_place_is_tried_more_often_once_more_retries_are_allowed() -> None:
    cell = CellDouble([(0.40, -0.30)], max_retries=0)
    cell.slips = 3
    cell.until("close")
    change(cell.task.p, max_retries=3)
    cell.until("DONE")
    assert (cell.contained, cell.task.status.retries) == (1, 3)


def test_what_was_given_up_is_tried_again_when_a_parameter_changes() -> None:
    cell = CellDouble([(0.40, -0.30), (0.47, -0.30)])
    change(cell.task.p, **{"hand.min_clearance": 0.05, "grace": 600.0})
    for _ in range(20):
        cell.step()
    reasons = [rejection.reason for rejection in cell.task.status.skipped]
    assert reasons == ["its neighbors leave no room for the fingers at any yaw"] * 2
    change(cell.task.p, **{"hand.min_clearance": 0.003})
    cell.until("DONE")
    assert cell.contained == 2


def test_the_task_waits_as_long_as_it_is_told_while_it_waits() -> None:
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


def test_a_motion_under_way_is_stopped_after_a_shorter_time() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("pre-grasp")
    change(cell.task.p, goal_timeout=0.05)
    cell.step()
    cell.step()
    assert "took longer than 0.05 s" in cell.task.status.message


@pytest.mark.parametrize("make", [lambda: CellDouble([(0.40, -0.30)], obstacle_patience=600.0),
                                  lambda: OutlineDouble(obstacle_patience=600.0)])
def test_what_is_in_the_way_is_planned_around_after_a_shorter_time(make: Callable[[], Any]) -> None:
    cell = make()
    cell.until("pre-grasp" if isinstance(cell, CellDouble) else "trace")
    in_the_way = Interlock(kind="held", by="scene_monitor", reason="a mug is in the way", since=1)
    cell.motion = cell.motion.model_copy(update={
        "held": True, "held_by": ["scene_monitor"], "interlocks": [in_the_way]})
    for _ in range(50):
        cell.step()
    assert cell.task.running is not None
    change(cell.task.p, obstacle_patience=1.0)
    assert any(isinstance(asked, StopRequest) for asked in cell.step())
    assert "a mug is in the way" in cell.task.status.message


def test_the_task_gives_up_after_fewer_failures() -> None:
    cell = CellDouble([(0.40, -0.30)], max_failures=1000)
    cell.unplannable = lambda request: "no_path" if request.stage == "home" else ""
    change(cell.task.p, goal_timeout=0.05, max_failures=2)
    cell.until("ERROR", most=100)
    assert "that makes 2 failures in a row" in cell.task.status.message


@pytest.mark.parametrize("camera_on", [True, False])
def test_the_outline_waits_for_a_contour_as_long_as_it_is_told_while_it_waits(camera_on: bool) -> None:
    cell = OutlineDouble(selection_timeout=0.0, picture_timeout=0.0)
    cell.path = OutlinePoints(message="no object is chosen") if camera_on else None
    for _ in range(200):
        cell.step()
    assert cell.status.state == "SELECTING"
    change(cell.task.p, **{"selection_timeout" if camera_on else "picture_timeout": 1.0})
    cell.step()
    assert cell.status.state == "ERROR"


def test_an_outline_under_way_is_stopped_after_a_shorter_time() -> None:
    cell = OutlineDouble()
    cell.until("trace")
    change(cell.task.p, overtime=1e-3)
    cell._arrival += 100
    cell.until("ERROR")
    assert "took longer than 1 s" in cell.status.message


def test_fingers_catch_and_let_go_by_the_tolerances_of_now() -> None:
    tolerances = GraspTolerances()
    world = KinematicWorld(World(balls=[(0.5, 0.0)]), tolerances=tolerances)
    beside = tool_down(0.5, 0.015, 0.03)
    assert world.obstruction(beside, 0.08) == 0.0  # 5 mm into a finger
    change(tolerances, sideways=0.01)
    assert world.obstruction(beside, 0.08) == pytest.approx(0.06)
    world.tick(1.0, beside, 0.06, True)
    change(tolerances, release=0.02)
    world.tick(1.1, beside, 0.07, False)
    assert world.held
    change(tolerances, release=0.005)
    world.tick(1.2, beside, 0.07, False)
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
            while not (await log.next()).message.endswith(f"opened again in {wait} s"):
                pass


async def test_a_camera_that_is_lost_is_waited_for_as_long_as_it_is_said_now(
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
    "services.camera_opencv.reopen_after": test_a_camera_that_is_lost_is_waited_for_as_long_as_it_is_said_now,
    "services.camera_opencv.reopen_at_most": test_a_camera_that_is_lost_is_waited_for_as_long_as_it_is_said_now,
    "services.smart_pick_place.max_retries": test_a_place_is_tried_more_often_once_more_retries_are_allowed,
    "services.smart_pick_place.grace": test_the_task_waits_as_long_as_it_is_told_while_it_waits,
    "services.smart_pick_place.empty": test_the_task_waits_as_long_as_it_is_told_while_it_waits,
    "services.smart_pick_place.goal_timeout": test_a_motion_under_way_is_stopped_after_a_shorter_time,
    "services.smart_pick_place.max_failures": test_the_task_gives_up_after_fewer_failures,
    "services.smart_pick_place.obstacle_patience": test_what_is_in_the_way_is_planned_around_after_a_shorter_time,
    "services.contour_tracer.obstacle_patience": test_what_is_in_the_way_is_planned_around_after_a_shorter_time,
    "services.contour_tracer.overtime": test_an_outline_under_way_is_stopped_after_a_shorter_time,
    "services.contour_tracer.picture_timeout":
        test_the_outline_waits_for_a_contour_as_long_as_it_is_told_while_it_waits,
    "services.contour_tracer.selection_timeout":
        test_the_outline_waits_for_a_contour_as_long_as_it_is_told_while_it_waits,
    "services.trajectory_executor.grasp_tolerances.sideways":
        test_fingers_catch_and_let_go_by_the_tolerances_of_now,
    "services.trajectory_executor.grasp_tolerances.release": test_fingers_catch_and_let_go_by_the_tolerances_of_now,
}


# --- every parameter of every service -----------------------------------------------------------------------------


@pytest.mark.parametrize("service", TUNABLE)
@pytest.mark.slow
async def test_every_tunable_parameter_is_read_anew_for_the_next_thing_that_a_service_does(
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
def test_what_is_read_rarely_is_kept_in_the_same_model_as_something_that_is_read_always(path: str) -> None:
    """So the test above shows that the service works with that model itself, and not with a copy."""
    service = path.split(".")[1]
    owners = {p: leaf.owner for p, leaf in leaves(config_of(service), service).items() if leaf.runtime}
    assert [p for p, owner in owners.items() if owner is owners[path] and p not in RARE]


def test_rare_parameters_are_parameters_that_there_are() -> None:
    tunable = {p for name in TUNABLE for p, leaf in leaves(config_of(name), name).items() if leaf.runtime}
    assert set(RARE) <= tunable
    assert set(TUNABLE) <= set(SCENARIOS)


@pytest.mark.parametrize("cell", CELLS)
def test_a_section_with_parameters_to_change_is_declared_by_one_service_of_the_cell(cell: str) -> None:
    sections = [path for name in CELLS[cell].services for path in tunable_sections(type(config_of(name)))]
    assert sorted(sections) == sorted(set(sections)) == ["motion", "pipeline"]


# --- what the next thing done is like -----------------------------------------------------------------------------


async def test_a_larger_least_area_hides_the_balls_of_the_next_picture_though_it_is_the_same(tmp_path: Path) -> None:
    async with Running("vision_detector", tmp_path) as service:
        assert len(await service.turn()) == 3
        await service.tune(min_contour_area_px=9000.0)
        assert await service.turn() == []
        await service.tune(min_contour_area_px=400.0)
        assert len(await service.turn()) == 2
        await service.tune(hsv_red_lo1=[0, 120, 255], hsv_red_lo2=[170, 120, 255], hsv_red_hi1=[1, 121, 255])
        assert await service.turn() == []


async def test_noise_and_brightness_show_in_the_next_picture_of_a_still_world(tmp_path: Path) -> None:
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


async def test_a_camera_that_waits_for_its_next_picture_takes_it_when_the_rate_is_raised(tmp_path: Path) -> None:
    async with Running("camera_simulator", tmp_path) as service:
        await service.turn()
        await service.tune(rate=1e-4)
        waiting = asyncio.create_task(service.turn())
        await asyncio.sleep(0)
        await service.tune(rate=50.0)
        await waiting
        await service.turn()


async def test_the_next_plan_is_slower_by_the_velocity_scaling(tmp_path: Path) -> None:
    def seconds(answer: Any) -> float:
        return float(answer.trajectory.points[-1].time_from_start)

    async with Running("motion_planner", tmp_path) as service:
        fast = seconds(await service.turn())
        await service.tune(**{"motion.velocity_scaling": 0.05, "motion.acceleration_scaling": 0.05})
        slow = seconds(await service.turn())
        await service.tune(**{"motion.cartesian_speed_scale": 0.5})
        assert slow > 1.9 * fast
        assert seconds(await service.turn()) == pytest.approx(2 * slow, rel=1e-6)


async def test_a_goal_box_and_a_planning_time_are_those_of_the_next_request(tmp_path: Path) -> None:
    async with Running("smart_pick_place", tmp_path) as service:
        request: PlanRequest = await service.turn()
        assert (request.goal.position_tolerance.x, request.planning_time) == (0.04, 2.0)  # type: ignore[union-attr]
        await service.tune(grasp_pos_tol=0.02, planning_time=3.0)
        request = await service.turn()
        assert (request.goal.position_tolerance.x, request.planning_time) == (0.02, 3.0)  # type: ignore[union-attr]


async def test_a_goal_is_refused_by_the_tolerances_of_now(tmp_path: Path) -> None:
    async with Running("trajectory_executor", tmp_path, speed=10.0) as service:
        assert (await service.turn()).state == "succeeded"
        await service.tune(**{"tolerances.start": 1e-4})
        assert (await service.turn()).error == "start_mismatch"


async def test_the_shell_is_drawn_anew_and_the_next_target_judged_by_it(tmp_path: Path) -> None:
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


async def test_a_ball_needs_as_many_frames_as_are_asked_for_now(tmp_path: Path) -> None:
    async with Running("scene_manager", tmp_path) as service:
        await service.tune(confirm_frames=100, forget_after=60.0)
        assert [await service.turn() for _ in range(5)] == [[]] * 5
        await service.tune(confirm_frames=3)
        assert len(await service.turn()) == 1


async def test_the_next_depth_image_ends_where_the_camera_sees_no_farther(tmp_path: Path) -> None:
    async with Running("depth_camera", tmp_path) as service:
        farthest = float(np.nanmax(await service.turn()))
        await service.tune(farthest=farthest - 0.05, depth_dropout=0.0)
        assert float(np.nanmax(await service.turn())) < farthest - 0.04
        await service.tune(depth_dropout=1.0)
        assert np.isnan(await service.turn()).all()


async def test_the_next_contours_are_those_of_the_threshold_of_now(tmp_path: Path) -> None:
    async with Running("contour_detector", tmp_path) as service:
        assert len((await service.turn()).contours) == 1
        await service.tune(threshold=220)
        assert (await service.turn()).contours == []
        await service.tune(threshold=127, min_area=1e5)
        assert (await service.turn()).contours == []
        await service.tune(min_area=0.0, subpixel=False)
        (found,) = (await service.turn()).contours
        assert all(u == round(u) for u, _ in found.pixels)


async def test_the_next_outline_is_rounded_and_cleared_as_it_is_said_now(tmp_path: Path) -> None:
    async with Running("pixel_to_world", tmp_path) as service:
        await service.turn()
        await service.tune(rounding=0.05)
        for pose in (await service.turn()).poses:
            assert pose.position.x / 0.05 == pytest.approx(round(pose.position.x / 0.05))
    async with Running("duplicate_remover", tmp_path) as service:
        many = len((await service.turn()).poses)
        await service.tune(tolerance=0.005)
        assert len((await service.turn()).poses) < many / 4


async def test_the_next_trace_keeps_the_standoff_and_speed_of_now(tmp_path: Path) -> None:
    async with Running("contour_tracer", tmp_path) as service:
        trace = (await service.turn()).goal
        assert (trace.waypoints[0].position.z, trace.tool_speed) == (1.102, 0.05)
        await service.tune(standoff=0.02, tool_speed=0.1, step=0.002)
        trace = (await service.turn()).goal
        assert (trace.waypoints[0].position.z, trace.tool_speed, trace.step) == (1.12, 0.1, 0.002)


async def test_tf_comes_as_rarely_as_it_is_said_now(tmp_path: Path) -> None:
    async with Running("robot_state_publisher", tmp_path) as service:
        await service.turn()
        await service.tune(rate=1.0)
        first = (await service.turn()).transforms[0].header.stamp
        assert (await service.turn()).transforms[0].header.stamp - first == 10**9
