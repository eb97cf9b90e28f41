"""The services of the tasks: requests to the planner, status, pause, and memory over restarts."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from applications.outlining.topics import CONTOUR_PATH, OUTLINE_STATUS, OutlinePoints
from applications.pick_place.choice import PickPlaceView, ReleasePositions
from applications.pick_place.grasping import Config
from applications.pick_place.task import PickPlace
from applications.pick_place.topics import PICK_PLACE_STATUS, VALIDATED_TARGETS
from common import messages as m
from common import topics
from common.atomic_file import RUNTIME_VARIABLE
from common.clock import Clock
from common.config import load_cell, service_config
from common.process import task_runner
from common.process.task_runner import run_task
from common.transport.bus import Bus
from services import contour_tracer, smart_pick_place
from tests.harness import running_with
from tests.services.fake_cell import PATIENCE, FakeCell, at, ball, trajectory, until

PANDA, UR5 = load_cell("panda"), load_cell("ur5")
PICK_PLACE = service_config(PANDA, "smart_pick_place", smart_pick_place.Config)
PICK_PLACE = PICK_PLACE.model_copy(update={"frame_timeout": 60.0})  # for a busy machine
TRACER = service_config(UR5, "contour_tracer", contour_tracer.Config)
SQUARE = [(0.45, -0.05), (0.55, -0.05), (0.55, 0.05), (0.45, 0.05)]


@pytest.mark.parametrize(("service", "config", "topic"), [
    (smart_pick_place, PICK_PLACE, PICK_PLACE_STATUS), (contour_tracer, TRACER, OUTLINE_STATUS)])
async def test_late_reader_gets_the_status_and_pause_is_answered_with_it(service, config, topic):
    cell = FakeCell()
    async with cell.running(service, config):
        first, late = await until(cell.reader(topic)), await until(cell.reader(topic))
        assert first.state == late.state == "IDLE"
        assert late.message.startswith("waiting for gripper/state, planning_scene, joint_states, motion/status")
        command = cell.client(topics.TASK_COMMAND)
        answer = await command.call(m.TaskCommand(command="pause"))
        assert (answer.state, answer.paused, answer.started) == ("IDLE", True, True)
        assert not (await command.call(m.TaskCommand(command="resume"))).paused


# --- the contour tracer ---


async def publish_cube(cell: FakeCell) -> None:
    """Publish an arm at home and a selected cube repeatedly: old messages are ignored."""
    cube = m.CollisionObject(id="Object_3", role="target", shape="prism", dimensions=[0.1],
                             outline=[(x - 0.5, y) for x, y in SQUARE], pose=at(0.5, 0.0, 1.05))
    while True:
        header = cell.put_robot(UR5.robot, cube)
        poses = [at(x, y, 1.1) for x, y in SQUARE]
        cell.put(CONTOUR_PATH, OutlinePoints(header=header, poses=poses, object="Object_3"))
        await asyncio.sleep(0.1)


async def test_selected_contour_is_planned_in_stages_and_a_rejected_motion_is_an_error() -> None:
    cell = FakeCell()
    planned, executed = cell.serve_planner(trajectory(UR5.robot.joints, 0.0)), cell.serve_executor()
    status = cell.reader(OUTLINE_STATUS)
    await cell.bus.ready()
    async with cell.running(contour_tracer, TRACER), running_with(publish_cube(cell)), asyncio.timeout(PATIENCE):
        stages = [(await planned.get()).stage for _ in range(5)]
        assert stages == ["approach", "descend", "trace", "retreat", "home"]
        await executed.get()
        failed = await until(status, lambda status: status.state == "ERROR")
    assert failed.message == "approach was refused: not today"
    assert (failed.object, failed.points, failed.fraction) == ("Object_3", 4, 1.0)


async def test_plan_request_is_repeated_while_the_planner_has_no_scene() -> None:
    cell = FakeCell()
    planned = cell.serve_planner(error="no_scene")
    await cell.bus.ready()
    async with cell.running(contour_tracer, TRACER), running_with(publish_cube(cell)), asyncio.timeout(PATIENCE):
        assert len({(await planned.get()).id for _ in range(3)}) == 1


# --- pick and place ---


def show_ball(cell: FakeCell, age: float = 0.0) -> None:
    """Publish an arm at home and a ball on the table, both seen some time [s, cell time] ago."""
    header = cell.put_robot(PANDA.robot, ball("track_0", 0.40, -0.17), width=0.08, age=age)
    cell.put(VALIDATED_TARGETS, m.PoseArray(header=header, poses=[at(0.40, -0.17, 0.03)]))


@pytest.mark.parametrize(("speed", "age"), [(1.0, 0.0), (10.0, 300.0)])
async def test_target_of_a_recent_image_causes_a_plan_request_above_the_ball(speed: float, age: float) -> None:
    """The timeout is in wall time, the age of an image in cell time."""
    cell = FakeCell(Clock(speed=speed))
    planned = cell.serve_planner()
    await cell.bus.ready()
    async with cell.running(smart_pick_place, PICK_PLACE), asyncio.timeout(PATIENCE):
        show_ball(cell, age)
        request = await planned.get()
        assert request.stage == "pre-grasp" and isinstance(request.goal, m.SequenceGoal)
        for item, height in zip(request.goal.items, (0.13, 0.03), strict=True):
            position = item.goal.pose.position  # type: ignore[union-attr]
            assert (position.x, position.y) == (0.40, -0.17) and abs(position.z - height) < 1e-9


async def test_empty_plan_and_out_of_range_held_object_do_not_end_the_task() -> None:
    cell = FakeCell()
    planned = cell.serve_planner(trajectory(PANDA.robot.joints))
    await cell.bus.ready()
    async with cell.running(smart_pick_place, PICK_PLACE), asyncio.timeout(PATIENCE):
        show_ball(cell)
        await planned.get()
        await planned.get()  # it is planned again
        header = cell.bus.header("world")
        held = m.AttachedObject(link="panda_hand_tcp", object=ball("far", 1e7, 1e7))
        cell.put(topics.PLANNING_SCENE, m.PlanningScene(header=header, attached=[held]))
        cell.put(topics.GRIPPER_STATE, m.GripperState(header=header, holding=True, outcome="too_wide"))
        await planned.get()


# --- memory of the task ---

ONE, OTHER = ReleasePositions(places=[(0.5, 0.2, 0.095)]), ReleasePositions(places=[(0.5, 0.3, 0.035)])


@pytest.fixture
def tasks() -> list[PickPlace]:
    return []


def running_task(tasks: list[PickPlace], memory: ReleasePositions | None = None) -> Any:
    """Run the service; its task object is added to a list."""

    class Recorded(PickPlace):
        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            if memory is not None:
                self.remember(memory)
            tasks.append(self)

    async def run(bus: Bus, config: Config) -> None:
        await run_task(bus, config, Recorded, PICK_PLACE_STATUS, PickPlaceView, seen=VALIDATED_TARGETS)

    return FakeCell().running(smart_pick_place, PICK_PLACE, run)


async def condition(test: Callable[[], bool]) -> None:
    async with asyncio.timeout(10):
        while not test():  # noqa: ASYNC110
            await asyncio.sleep(0.01)


@pytest.mark.parametrize("damaged", ["{", '{"places": [[0.5, 0.2, NaN]]}', '{"places": 3}', "[]"])
async def test_release_positions_survive_a_restart_and_a_damaged_file_is_reported(
    damaged: str, tasks: list[PickPlace], monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setenv(RUNTIME_VARIABLE, str(tmp_path))
    saved = tmp_path / "test.smart_pick_place.json"
    async with running_task(tasks):
        tasks[0].remember(ONE)
        await condition(saved.exists)
    async with running_task(tasks):
        assert tasks[1].memory == ONE
    saved.write_text(damaged)
    async with running_task(tasks):
        assert tasks[2].memory == ReleasePositions()
    assert f"the memory of the task is lost: {saved} cannot be read: it is damaged" in caplog.text


async def test_memory_that_cannot_be_saved_is_saved_as_soon_as_possible(tasks, monkeypatch, tmp_path, caplog):
    blocker = tmp_path / "no_folder"
    blocker.write_text("")
    monkeypatch.setenv(RUNTIME_VARIABLE, str(blocker / "cell"))
    monkeypatch.setattr(task_runner, "SAVE_RETRY", 0.01)
    saved = blocker / "cell" / "test.smart_pick_place.json"
    async with running_task(tasks, ONE):
        assert tasks[0].memory == ONE
        tasks[0].remember(OTHER)
        await condition(lambda: "cannot be written" in caplog.text)
        blocker.unlink()
        await condition(saved.exists)
    assert ReleasePositions.model_validate_json(saved.read_text()) == OTHER
    assert caplog.text.count("cannot be written") == 1
