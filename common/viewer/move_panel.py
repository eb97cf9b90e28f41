"""The panel on which a person has the arm planned and moved to a goal of their own."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Sequence
from typing import Any, Protocol

import viser

from common.errors import ZencellError
from common.messages import JointGoal, JointTrajectory, MotionStatus, PlanResponse, Pose, PoseGoal
from common.viewer.desk import Desk, assign
from common.viewer.markup import block, span, text
from common.viewer.words import plan, problem

PIPELINE = "pipeline"
PLAN, GO = "Plan here", "Go there"


class Motions(Protocol):
    """Plans and moves for a person; with no planner named, by the cell's pipeline."""

    async def plan(self, goal: PoseGoal | JointGoal, *, planner: str = "") -> PlanResponse:
        """A plan to a goal; nothing moves."""

    async def move(self, goal: PoseGoal | JointGoal, *, planner: str = "") -> MotionStatus:
        """The end of a motion to a goal."""


class Goal(Protocol):
    """Where the goal marker is in the scene."""

    def goal_marker(self, on: bool) -> None:
        """Show or hide it."""

    @property
    def goal_pose(self) -> Pose:
        """Its pose in world."""


class MovePanel:
    """A tick for the goal marker, a list of planners, buttons to plan and go, and how it went."""

    def __init__(
        self, gui: viser.GuiApi, desk: Desk, motions: Motions, goal: Goal,
        planners: Sequence[str], *, planner: str, marker: bool, tell: Callable[[str, str], None],
        play: Callable[[JointTrajectory], None],
    ) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            desk: takes the orders.
            motions: carry them out.
            goal: the goal marker.
            planners: that may be asked.
            planner: that is asked at first.
            marker: whether the goal marker is shown at first.
            tell: called with a line about how it went, and whether that is good, busy or bad.
            play: shows a plan as a motion.
        """
        self._motions, self._goal, self._tell_all, self._play = motions, goal, tell, play
        self.planner = planner if planner in planners else PIPELINE
        self.marker = marker
        self._tick = gui.add_checkbox("Goal marker", marker, hint="drag it in the scene to where the tool should be")
        desk.on_change(self._tick, self.set_marker)
        names = gui.add_dropdown("Planner", [PIPELINE, *planners], initial_value=self.planner,
                                 hint="pipeline: the cell's planners, in their order")
        desk.on_change(names, self._set_planner)
        desk.on_choice(gui.add_button_group("Goal", (PLAN, GO)), self._go)
        if marker:
            goal.goal_marker(True)
        self._html = gui.add_html(_line("Show the goal marker, drag it, then plan or go there.", "dim"))

    def set_marker(self, on: bool) -> None:
        """Show or hide the goal marker."""
        self.marker = on
        assign(self._tick, on)
        self._goal.goal_marker(on)

    async def go_home(self) -> None:
        """Have the arm go home."""
        await self._do(self._move(JointGoal(named="home"), "", "At home"), "Going home …")

    async def _go(self, chosen: str) -> None:
        if not self.marker:
            self.set_marker(True)
            self._tell("Drag the goal marker to where the tool should be, then try again.", "busy")
            return
        planner = "" if self.planner == PIPELINE else self.planner
        there = PoseGoal(pose=self._goal.goal_pose)
        if chosen == PLAN:
            await self._do(self._plan(there, planner), "Planning …")
        elif chosen == GO:
            await self._do(self._move(there, planner, "There"), "Planning and going there …")

    async def _do(self, doing: Coroutine[Any, Any, None], line: str) -> None:
        self._tell(line, "busy")
        try:
            await doing
        except ZencellError as error:
            self._tell(problem(error), "bad")

    async def _plan(self, goal: PoseGoal, planner: str) -> None:
        response = await self._motions.plan(goal, planner=planner)
        self._tell(plan(response), "good" if response.ok else "bad")
        if response.ok and response.trajectory is not None:
            self._play(response.trajectory)

    async def _move(self, goal: PoseGoal | JointGoal, planner: str, there: str) -> None:
        await self._motions.move(goal, planner=planner)
        self._tell(there, "good")

    def _set_planner(self, name: str) -> None:
        self.planner = name

    def _tell(self, line: str, kind: str) -> None:
        self._html.content = _line(line, kind)
        self._tell_all(line, kind)


def _line(line: str, kind: str) -> str:
    return block(f"{span('●', kind + ' dot')} {text(line)}", "move", kind=kind)
