"""Planning on the page, and executing what was planned."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import pytest
import viser

from common.config import load_cell
from common.messages import JointTrajectory, JointTrajectoryPoint, MotionStatus, PlanResponse
from common.robot.model import RobotModel
from page.move_panel import MovePanel
from page.saved_poses import SavedPoses, save_taught, taught_file
from tests.page.test_through import Nowhere, Silent


class Motions:
    """Plans once it is let, and moves at once."""

    def __init__(self) -> None:
        self.asked, self.plans, self.followed = asyncio.Event(), asyncio.Event(), 0

    async def require_free(self) -> MotionStatus:
        return MotionStatus()

    async def plan(self, _goal: Any, *, planner: str = "") -> PlanResponse:
        self.asked.set()
        await self.plans.wait()
        point = JointTrajectoryPoint(time_from_start=0.0, positions=[0.1], velocities=[0.0], accelerations=[0.0])
        return PlanResponse(id="1", ok=True, trajectory=JointTrajectory(joint_names=["a"], points=[point]))

    async def follow(self, _trajectory: JointTrajectory, *, plan: PlanResponse | None = None) -> MotionStatus:
        self.followed += 1
        return MotionStatus()


async def test_plan_that_comes_when_another_goal_has_been_chosen_is_not_executed(
    server: viser.ViserServer, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZENCELL_STATE", str(tmp_path))
    motions, told = Motions(), list[str]()
    robot = RobotModel.load(load_cell("ur5").robot)
    save_taught(taught_file("cell"), SavedPoses(poses={"one": dict.fromkeys(robot.joint_names, 0.1)}))
    panel = MovePanel(
        server.gui, cast(Any, Silent()), cast(Any, motions), cast(Any, Nowhere()), robot, [], cell="cell",
        planner="", marker=False, tell=lambda line, _kind: told.append(line))
    panel._set_kind("one")
    planning = asyncio.create_task(panel._plan_it())
    await motions.asked.wait()
    panel._set_kind("home")
    motions.plans.set()
    await planning
    assert "not kept" in told[-1]
    await panel._execute()
    assert (motions.followed, told[-1]) == (0, "Plan first.")
    for press in (panel._plan_it, panel._execute):
        await press()
    assert (motions.followed, told[-1]) == (1, "There")
