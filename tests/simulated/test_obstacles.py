"""Obstacles in the path of running motions in complete cells: the arm brakes, waits, resumes or is replanned."""

import asyncio

import pytest

from common import topics
from common.errors import RequestFailed
from common.messages import CollisionObject, FollowedRequest, HoldRequest, JointTrajectory, MotionStatus, Pose, Vector3
from common.robot.model import RobotModel
from common.transport.bus import Bus, Reader
from tests.harness import until
from tests.simulated.intruder import Intruder, watched_cell
from tests.simulated.sees_more import SEEN
from tests.simulated.visited import SimulatedCell


@pytest.mark.parametrize(("name", "overrides"), [
    ("panda", ["world.count=1"]), pytest.param("ur5", [], marks=pytest.mark.campaign),
])
@pytest.mark.slow
def test_added_obstacle_is_never_touched_and_the_task_is_done(name: str, overrides: list[str]) -> None:
    intruder = Intruder(seed=1, most=2)
    cell = SimulatedCell(watched_cell(name, overrides), seed=1, visit=intruder.visit)
    assert cell.outcome.state == "DONE" and len(intruder.found) == 2
    assert min(one.nearest for one in intruder.found) > 0.0
    assert max(one.latency for one in intruder.found) < 0.1
    assert cell.summary["failures"] == sum(one.given_up for one in intruder.found) > 0


class ObstructedPath:
    """The path of the running motion, and a ball in the middle of the rest of it."""

    def __init__(self, cell: SimulatedCell, bus: Bus) -> None:
        SEEN.clear()
        self.seen: dict[str, CollisionObject] = {}
        self.motion: Reader[MotionStatus] = bus.reader(topics.MOTION_STATUS)
        self._robot, self._followed = RobotModel.load(cell.cell.robot), bus.client(topics.MOTION_FOLLOWED)

    async def block(self) -> MotionStatus:
        """Obstruct a long motion early on its path and return its status once it is held."""
        while True:
            status = await until(self.motion, lambda m: m.state == "active" and 0.05 < m.progress < 0.3)
            try:
                trajectory = (await self._followed.call(FollowedRequest(id=status.id))).trajectory
            except RequestFailed:
                continue
            if trajectory.points[-1].time_from_start > 1.5:
                break
            await until(self.motion, lambda m, goal=status.id: m.id != goal or m.state != "active")
        self.seen = {"ball": self._ball(trajectory)}
        SEEN.update(self.seen)
        held = await until(self.motion, lambda m: "scene_monitor" in m.held_by and m.message.startswith("held"), 2.0)
        assert held.id == status.id and held.progress < 0.6 and held.plan and held.scene_stamp
        assert "ball obstructs panda_" in held.message
        return held

    def _ball(self, trajectory: JointTrajectory) -> CollisionObject:
        end = trajectory.points[-1].time_from_start
        q = min(trajectory.points, key=lambda p: abs(p.time_from_start - 0.75 * end)).positions
        x, y, z = (float(v) for v in self._robot.fk(q)[:3, 3])
        return CollisionObject(id="ball", role="fixture", shape="sphere", dimensions=[0.02],
                               pose=Pose(position=Vector3(x=x, y=y, z=z)))


def test_removed_obstacle_resumes_the_motion_unless_an_operator_holds_the_arm() -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        path, hold = ObstructedPath(cell, bus), bus.client(topics.MOTION_HOLD)
        held = await path.block()
        await hold.call(HoldRequest(hold=True, owner="anna"))
        SEEN.clear()
        left = await until(path.motion, lambda m: m.held_by == ["operator"], 2.0)
        await asyncio.sleep(2.0)
        assert path.motion.latest is not None and path.motion.latest.progress == left.progress
        SEEN.update(path.seen)
        await until(path.motion, lambda m: "scene_monitor" in m.held_by, 2.0)
        await hold.call(HoldRequest(hold=False, owner="anna"))
        assert (await until(path.motion, lambda m: "operator" not in m.held_by)).held
        SEEN.clear()
        assert (await until(path.motion, lambda m: m.progress > 0.9, 10.0)).id == held.id

    summary = SimulatedCell(watched_cell("panda", ["world.count=1"]), visit=visit).summary
    assert (summary["state"], summary["failures"]) == ("DONE", 0)


@pytest.mark.parametrize("stays", [False, True])
@pytest.mark.slow
def test_restarted_planner_rechecks_the_motion_it_held(stays: bool) -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        path = ObstructedPath(cell, bus)
        held = await path.block()
        cell.kill("motion_planner")
        await until(path.motion, lambda m: "watchdog" in m.held_by, 5.0)
        if not stays:
            SEEN.clear()
        await bus.alive.wait("motion_planner")
        over = await until(path.motion, lambda m: m.id != held.id or m.state != "active" or m.progress > 0.9, 20.0)
        assert (over.id == held.id and over.progress > 0.9) is not stays
        if stays:
            assert over.state == "cancelled" and not (await until(path.motion, lambda m: not m.held, 2.0)).held
            SEEN.clear()

    cell = SimulatedCell(watched_cell("panda", ["world.count=1"]), visit=visit)
    assert (cell.outcome.state, cell.summary["failures"]) == ("DONE", int(stays))
    assert cell.outcome.restarts == {"motion_planner": 1}
