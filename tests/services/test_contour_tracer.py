from __future__ import annotations

import asyncio

from applications.outlining.topics import CONTOUR_PATH, OUTLINE_STATUS, OutlinePoints
from common import messages as m
from common import topics
from common.config import load_cell, service_config
from services import contour_tracer
from tests.harness import running_with
from tests.services.fake_cell import PATIENCE, FakeCell, at, trajectory, until

CELL = load_cell("ur5")
CONFIG = service_config(CELL, "contour_tracer", contour_tracer.Config)
SQUARE = [(0.45, -0.05), (0.55, -0.05), (0.55, 0.05), (0.45, 0.05)]


async def publish(cell: FakeCell) -> None:
    """Publish an arm at home and a selected cube repeatedly: old messages are ignored."""
    cube = m.CollisionObject(id="Object_3", role="target", shape="prism", dimensions=[0.1],
                             outline=[(x - 0.5, y) for x, y in SQUARE], pose=at(0.5, 0.0, 1.05))
    while True:
        header = cell.put_robot(CELL.robot, cube)
        poses = [at(x, y, 1.1) for x, y in SQUARE]
        cell.put(CONTOUR_PATH, OutlinePoints(header=header, poses=poses, object="Object_3"))
        await asyncio.sleep(0.1)


async def test_selected_contour_is_planned_in_stages_and_a_rejected_motion_is_an_error() -> None:
    cell = FakeCell()
    planned, executed = cell.serve_planner(trajectory(CELL.robot.joints, 0.0)), cell.serve_executor()
    status = cell.reader(OUTLINE_STATUS)
    await cell.bus.ready()
    async with cell.running(contour_tracer, CONFIG), running_with(publish(cell)), asyncio.timeout(PATIENCE):
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
    async with cell.running(contour_tracer, CONFIG), running_with(publish(cell)), asyncio.timeout(PATIENCE):
        assert len({(await planned.get()).id for _ in range(3)}) == 1


async def test_late_reader_gets_the_status_and_pause_is_answered_with_it() -> None:
    cell = FakeCell()
    async with cell.running(contour_tracer, CONFIG):
        first, late = await until(cell.reader(OUTLINE_STATUS)), await until(cell.reader(OUTLINE_STATUS))
        assert first.state == late.state == "IDLE"
        assert late.message == "waiting for gripper/state, planning_scene, joint_states, motion/status"
        command = cell.client(topics.TASK_COMMAND)
        answer = await command.call(m.TaskCommand(command="pause"))
        assert (answer.state, answer.paused, answer.started) == ("IDLE", True, True)
        assert not (await command.call(m.TaskCommand(command="resume"))).paused
