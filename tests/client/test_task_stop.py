"""A stop of arm and task by the client, also when one of the two does not confirm it."""

from __future__ import annotations

import asyncio

import pytest

from common import messages as m
from common import topics
from common.client.subscriptions import Subscriptions
from common.client.task import ArmStopFailed, TaskControl, TaskStopFailed
from common.errors import NoResponder, Refused, RemoteError
from common.messages.execution import NOT_PERSISTED
from common.transport.local import LocalNetwork

UNSAVED = m.Interlock(kind="stopped", by="ann", reason=f"{NOT_PERSISTED}: the disk is full", since=1)


async def task_control(arm: bool, task: bool) -> tuple[TaskControl, dict[str, asyncio.Event]]:
    """Return the client of an arm and a task that confirm a stop or not, and events of their requests."""
    network, stopped = LocalNetwork(), {"arm": asyncio.Event(), "task": asyncio.Event()}
    cell = network.bus("cell")

    async def stop_arm(_: m.StopRequest) -> m.MotionStatus:
        stopped["arm"].set()
        if not arm:
            raise Refused("busy", "from the arm")
        return m.MotionStatus(interlocks=[UNSAVED])

    async def stop_task(_: m.TaskCommand) -> m.TaskStatus:
        stopped["task"].set()
        if not task:
            raise Refused("busy", "from the task")
        return m.TaskStatus(state="READY")

    cell.serve(topics.MOTION_STOP, stop_arm)
    cell.serve(topics.TASK_COMMAND, stop_task)
    await cell.ready()
    return TaskControl(Subscriptions(network.bus("operator")), "ann"), stopped


@pytest.mark.parametrize(("arm", "task", "raised", "message"), [
    (True, True, None, ""),
    (True, False, TaskStopFailed,
     "the arm is stopped and stays so until a start; the task did not confirm.*from the task"),
    (False, True, ArmStopFailed, "the task has stopped; the executor of the arm did not confirm.*from the arm"),
    (False, False, RemoteError, "from the task"),
])
async def test_stop_reports_which_of_arm_and_task_did_not_confirm_it(arm, task, raised, message):
    control, stopped = await task_control(arm, task)
    if raised is None:
        assert (await control.stop()).state == "READY"
    else:
        with pytest.raises(raised, match=message):
            await control.stop()
    assert stopped["arm"].is_set() and stopped["task"].is_set(), "both, whatever the other answers"
    assert ("disk is full" in control.unsaved) == arm


@pytest.mark.parametrize("has_task", [True, False])
async def test_commands_reach_the_executor_of_a_cell_without_a_task(has_task: bool) -> None:
    network, holds = LocalNetwork(), list[m.HoldRequest]()
    cell = network.bus("cell")

    async def stop(_: m.StopRequest) -> m.MotionStatus:
        return m.MotionStatus()

    async def hold(request: m.HoldRequest) -> m.MotionStatus:
        holds.append(request)
        return m.MotionStatus()

    cell.serve(topics.MOTION_STOP, stop)
    cell.serve(topics.MOTION_HOLD, hold)
    cell.writer(topics.SUPERVISOR_STATUS).put(m.SupervisorStatus(cell=cell.cell, services=[], has_task=has_task))
    await cell.ready()
    control = TaskControl(Subscriptions(network.bus("operator")), "ann")
    if has_task:  # it is down
        for command in (control.stop, control.start):
            with pytest.raises((TaskStopFailed, NoResponder)):
                await command()
    else:
        assert [type(await command()) for command in (control.stop, control.start)] == [m.MotionStatus] * 2
    assert [(one.hold, one.stops, one.owner) for one in holds] == ([] if has_task else [(False, True, "ann")])


@pytest.mark.parametrize("turns", range(1, 6))
async def test_cancelled_stop_still_reaches_both(turns: int) -> None:
    control, stopped = await task_control(arm=True, task=True)
    stopping = asyncio.create_task(control.stop())
    for _ in range(turns):
        await asyncio.sleep(0)
    stopping.cancel()
    async with asyncio.timeout(10):
        await stopped["arm"].wait()
        await stopped["task"].wait()
