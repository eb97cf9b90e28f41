"""Pause and resume in complete cells: the joints stop, and a paused motion is completed."""

from typing import Any

import pytest

from applications.outlining.topics import OUTLINE_STATUS
from applications.pick_place.topics import PICK_PLACE_STATUS
from common import topics
from common.client.operator_motion import MotionFailed, OperatorMotion
from common.messages import JointGoal, JointState, MotionStatus, TaskCommand
from common.transport.bus import Bus, Reader
from tests.harness import until
from tests.simulated.outlined import assert_cube_outlined
from tests.simulated.visited import SimulatedCell, in_box

STATUS = {"panda": PICK_PLACE_STATUS, "ur5": OUTLINE_STATUS}
STILL = 30  # joint states in a row


def moves(cell: SimulatedCell, state: JointState) -> bool:
    speed = dict(zip(state.name, state.velocity, strict=True))
    return any(abs(speed[name]) > 0.02 for name in cell.cell.robot.joints)


async def held(motion: Reader[MotionStatus]) -> MotionStatus:
    return await until(motion, lambda m: m.held and not m.message.startswith("coming to rest"))


async def assert_still(cell: SimulatedCell, joints: Reader[JointState], after: int) -> list[float]:
    """Return the positions of the arm; check that they do not change from a time [ns] on."""
    count, seen = len(cell.cell.robot.joints), set()
    await until(joints, lambda s: s.header.stamp > after)
    for _ in range(STILL):
        seen.add(tuple((await joints.next()).position[:count]))
    assert len(seen) == 1
    return list(seen.pop())


async def pause_in_motion(cell: SimulatedCell, bus: Bus, stage: str) -> Any:
    """Pause while the arm moves in a stage, check standstill, resume, and return the status at the end."""
    joints, motion = bus.reader(topics.JOINT_STATES), bus.reader(topics.MOTION_STATUS)
    status = bus.reader(STATUS[cell.cell.name])
    await until(status, lambda s: s.stage == stage, 90)
    await until(joints, lambda s: moves(cell, s))
    task = bus.client(topics.TASK_COMMAND)
    await task.call(TaskCommand(command="pause"), 10.0)
    at_rest = await held(motion)
    assert at_rest.state == "active" and 0 < at_rest.progress < 1, at_rest
    assert (await until(status, lambda s: s.paused)).stage == stage
    await assert_still(cell, joints, at_rest.header.stamp)
    with pytest.raises(MotionFailed, match=r"is paused.*stop the task first"):
        await OperatorMotion(bus, [status]).move(JointGoal(named="home"))
    await task.call(TaskCommand(command="resume"), 10.0)
    ended = await until(motion, lambda m: m.id != at_rest.id or m.state != "active")
    assert (ended.id, ended.state) == (at_rest.id, "succeeded"), "the same motion resumes"
    return await until(status, lambda s: s.state in ("DONE", "ERROR"), 120)


@pytest.mark.slow
@pytest.mark.parametrize(("cell", "stage", "settings"), [
    ("panda", "across", {"overrides": ["world.count=1"]}), ("ur5", "trace", {"world": "w2"})])
def test_paused_task_resumes_the_same_motion_and_completes(cell: str, stage: str, settings: dict[str, Any]) -> None:
    async def visit(simulated: SimulatedCell, bus: Bus) -> None:
        status = await pause_in_motion(simulated, bus, stage)
        assert status.failures == 0
        assert stage != "trace" or (status.closed and status.object == "Object_0")

    summary = SimulatedCell(cell, visit=visit, **settings).summary
    if cell == "ur5":
        assert_cube_outlined(summary)
    else:
        assert summary["truth"] == in_box(1)
    assert (summary["state"], summary["failures"], summary.get("retries", 0)) == ("DONE", 0, 0)
    assert summary["seconds"]["moving"] < summary["seconds"]["task"]
