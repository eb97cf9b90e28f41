"""Planned motions of the Move tab, and sequences of saved poses."""

import asyncio
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
import viser

from common import topics
from common.client.operator_motion import MotionFailed
from common.messages import (
    Interlock,
    JointTrajectory,
    JointTrajectoryPoint,
    MotionStatus,
    PlanResponse,
    Vector3,
    Wrench,
)
from common.saved_poses import SavedPoses, poses_file, save_poses
from page.console import ActionQueue
from page.move_panel import MovePanel
from tests.page.scene_cell import robot_of

STOP = MotionStatus(interlocks=[Interlock(kind="stopped", by="anna", since=8)])
POINT = JointTrajectoryPoint(time_from_start=0.0, positions=[0.1], velocities=[0.0], accelerations=[0.0])


class Motions:
    """Plans when the test allows it, and moves at once; an operator presses STOP when the first motion ends."""

    def __init__(self) -> None:
        self.planning, self.may_plan = asyncio.Event(), asyncio.Event()
        self.status, self.moves, self.follows = MotionStatus(), 0, 0

    async def require_free(self) -> MotionStatus:
        return self.status

    async def plan(self, _goal: Any, *, planner: str = "") -> PlanResponse:
        self.planning.set()
        await self.may_plan.wait()
        return PlanResponse(id="1", ok=True, trajectory=JointTrajectory(joint_names=["a"], points=[POINT]))

    async def move(self, _goal: Any, *, planner: str = "", acknowledged: int | None = None) -> MotionStatus:
        if acknowledged is not None and self.status.newest > acknowledged:
            raise MotionFailed("stopped", "the motion was rejected")
        self.moves, self.status = self.moves + 1, STOP
        return self.status

    async def follow(self, _trajectory: JointTrajectory, *, plan: PlanResponse | None = None) -> MotionStatus:
        self.follows += 1
        return MotionStatus()


class Panel:
    """The Move tab of a cell that publishes nothing, with two saved poses."""

    def __init__(self, gui: viser.GuiApi) -> None:
        robot, console = robot_of("ur5"), ActionQueue()
        console.latest = lambda _topic: None
        pose = dict.fromkeys(robot.joint_names, 0.1)
        save_poses(poses_file("cell"), SavedPoses(poses={"one": pose, "two": pose}))
        self.motions, self.notes = Motions(), list[tuple[str, str]]()
        self.panel: Any = MovePanel(
            gui, console, self.motions, MagicMock(), robot, [], cell="cell", planner="", marker=False,
            notify=lambda line, kind: self.notes.append((line, kind)))


@pytest.fixture
async def move(gui: viser.GuiApi, state_folder: Path) -> Panel:
    return Panel(gui)


async def test_plan_is_discarded_if_another_goal_is_selected_while_planning(move: Panel) -> None:
    panel, motions, notes = move.panel, move.motions, move.notes
    panel._goal._set_kind("one")
    planning = asyncio.create_task(panel._plan_goal())
    await motions.planning.wait()
    panel._goal._set_kind("home")
    motions.may_plan.set()
    await planning
    assert "Plan discarded" in notes[-1][0]
    await panel._execute()
    assert (motions.follows, notes[-1][0]) == (0, "Press Plan first.")
    for operation in (panel._plan_goal, panel._execute):
        await operation()
    assert (motions.follows, notes[-1][0]) == (1, "Goal reached")


async def test_stop_between_two_poses_ends_the_sequence(move: Panel) -> None:
    move.panel._poses._set_sequence("one, two")
    await move.panel._poses._run_sequence()
    assert move.motions.moves == 1
    assert move.notes[-2:] == [("Moving to two …", "busy"), ("the motion was rejected", "bad")]


async def test_force_at_the_tool_is_shown_with_its_limit(move: Panel) -> None:
    pushed = Wrench(force=Vector3(z=-4.0), zeroed=True)
    move.panel._console.latest = lambda topic: pushed if topic is topics.WRENCH else None
    move.panel._console.is_available = lambda _request: True
    move.panel.show(None, 0.0)
    assert "Force at the tool" in move.panel._arm.content and "4.0 N" in move.panel._arm.content
    move.panel._console.latest = lambda _topic: None
    move.panel.show(None, 0.3)
    assert "Force at the tool" not in move.panel._arm.content
