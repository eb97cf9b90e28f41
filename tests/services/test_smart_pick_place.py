from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

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
from services import smart_pick_place
from tests.services.fake_cell import FakeCell, at, ball, trajectory, until

CELL = load_cell("panda")
CONFIG = service_config(CELL, "smart_pick_place", smart_pick_place.Config)


def show_ball(cell: FakeCell, age: float = 0.0) -> None:
    """Publish an arm at home and a ball on the table, both seen some time [s, cell time] ago."""
    header = cell.put_robot(CELL.robot, ball("track_0", 0.40, -0.17), width=0.08, age=age)
    cell.put(VALIDATED_TARGETS, m.PoseArray(header=header, poses=[at(0.40, -0.17, 0.03)]))


@pytest.mark.parametrize(("speed", "age"), [(1.0, 0.0), (10.0, 30.0)])
async def test_target_of_a_recent_image_causes_a_plan_request_above_the_ball(speed: float, age: float) -> None:
    """The timeout is in wall time, the age of an image in cell time."""
    cell = FakeCell(Clock(speed=speed))
    planned = cell.serve_planner()
    await cell.bus.ready()
    async with cell.running(smart_pick_place, CONFIG.model_copy(update={"frame_timeout": 10.0})):
        show_ball(cell, age)
        request = await asyncio.wait_for(planned.get(), 5)
        assert request.stage == "pre-grasp" and isinstance(request.goal, m.SequenceGoal)
        for item, height in zip(request.goal.items, (0.13, 0.03), strict=True):
            position = item.goal.pose.position  # type: ignore[union-attr]
            assert (position.x, position.y) == (0.40, -0.17) and abs(position.z - height) < 1e-9


async def test_empty_plan_and_out_of_range_held_object_do_not_end_the_task() -> None:
    cell = FakeCell()
    planned = cell.serve_planner(trajectory(CELL.robot.joints))
    await cell.bus.ready()
    async with cell.running(smart_pick_place, CONFIG), asyncio.timeout(10):
        show_ball(cell)
        await planned.get()
        await planned.get()  # it is planned again
        header = cell.bus.header("world")
        held = m.AttachedObject(link="panda_hand_tcp", object=ball("far", 1e7, 1e7))
        cell.put(topics.PLANNING_SCENE, m.PlanningScene(header=header, attached=[held]))
        cell.put(topics.GRIPPER_STATE, m.GripperState(header=header, holding=True, outcome="too_wide"))
        await planned.get()


async def test_late_reader_gets_the_status_and_pause_is_answered_with_it() -> None:
    cell = FakeCell()
    async with cell.running(smart_pick_place, CONFIG):
        first, late = await until(cell.reader(PICK_PLACE_STATUS)), await until(cell.reader(PICK_PLACE_STATUS))
        assert first.state == late.state == "IDLE" and "waiting for" in late.message
        command = cell.client(topics.TASK_COMMAND)
        assert (await command.call(m.TaskCommand(command="pause"))).paused
        assert not (await command.call(m.TaskCommand(command="resume"))).paused


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

    return FakeCell().running(smart_pick_place, CONFIG, run)


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


async def test_memory_that_cannot_be_saved_is_saved_as_soon_as_possible(
    tasks: list[PickPlace], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
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
