"""The Move tab: jogging, gripper, planned motions to a goal, saved poses."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Sequence
from typing import TYPE_CHECKING, Protocol

import viser

from common import topics
from common.messages import (
    JointGoal,
    JointTrajectory,
    MotionOwner,
    MotionStatus,
    PlanResponse,
    PoseGoal,
    TaskStatus,
)
from page.console import Console
from page.goal_fields import JOINTS, MARKER, TOOL, Goal, GoalFields, GoalScene, Report
from page.manual_control import ArmReadout, GripperPanel, Jogger, JogPanel
from page.markup import Html, block, buttons, press, span, text
from page.saved_poses import SavedPosesPanel
from page.status_text import USER_ERRORS, arm_blocked, error_text, jog_blocked, plan_text, wrench_text

if TYPE_CHECKING:
    from common.robot.model import RobotModel

PIPELINE, NONE = "pipeline", "none"


class Motions(Protocol):
    """Plans and executes motions of an operator; without a named planner by the cell's pipeline."""

    async def plan(self, goal: Goal, *, planner: str = "") -> PlanResponse:
        """Return a plan to a goal."""

    async def move(self, goal: Goal, *, planner: str = "", acknowledged: int | None = None) -> MotionStatus:
        """Move to a goal; interlocks newer than `acknowledged` prevent it."""

    async def follow(self, trajectory: JointTrajectory, *, plan: PlanResponse | None = None) -> MotionStatus:
        """Execute a trajectory that was planned before."""

    async def require_free(self) -> MotionStatus:
        """Return the motion status; raise if another client controls the arm."""


class MovePanel:
    """The Move tab.

    Attributes:
        planner: selected planner.
        readout: of the arm.
        jogger: handles held buttons.
    """

    def __init__(
        self, gui: viser.GuiApi, console: Console, motions: Motions, scene: GoalScene, robot: RobotModel,
        planners: Sequence[str], *, cell: str, planner: str, marker: bool, notify: Report,
    ) -> None:
        """Build the tab.

        Args:
            gui: of the server.
            console: runs the buttons.
            motions: plans and executes motions.
            scene: has the goal marker and the ghosts.
            robot: not used by another thread.
            planners: available planners.
            cell: name of the cell.
            planner: planner that is selected at first.
            marker: whether the goal marker is shown at first.
            notify: shows a line on every page.
        """
        self._console, self._motions, self._scene, self._notify_all = console, motions, scene, notify
        self.planner = planner if planner in planners else PIPELINE
        self._compared_planner = NONE
        self._plan: PlanResponse | None = None
        self._compared: PlanResponse | None = None
        self._planned_goal: Goal | None = None  # of both plans
        self._discarded = 0  # number of times that plans were discarded
        self._blocked = ""
        self.readout = ArmReadout(robot, console.latest)
        self._arm = Html(gui)
        console.on_press("home", self.go_home, "Go to home pose")
        self._jog = JogPanel(gui, console, robot.joint_names, robot.velocity.tolist())
        self.jogger = Jogger(console, self._jog.velocities, self._state, lambda: self._blocked)
        gripper, self._force_limit = robot.config.gripper, robot.config.force_limit
        self._gripper: GripperPanel | None = None
        if gripper is not None:
            with gui.add_folder("Gripper width and force", expand_by_default=False):
                self._gripper = GripperPanel(gui, console, gripper, motions.require_free)
        with gui.add_folder("Move to goal", expand_by_default=True):
            self._goal = GoalFields(
                gui, console, scene, robot, self.readout, marker=marker, on_change=self._discard, report=self._report,
                saved=self._saved_positions)
            self._add_planning(gui, planners)
        with gui.add_folder("Saved poses", expand_by_default=False):
            self._poses = SavedPosesPanel(
                gui, console, cell, robot.joint_names, self.readout.joints, self._offer, self._move_through,
                [MARKER, TOOL, JOINTS, *robot.config.named_poses])
        self._offer()

    def _add_planning(self, gui: viser.GuiApi, planners: Sequence[str]) -> None:
        """Add the selection of planners, the buttons, and a line for results."""
        names = gui.add_dropdown("Planner", [PIPELINE, *planners], initial_value=self.planner,
                                 hint="pipeline: the planners of the cell, in their order")
        self._console.on_change(names, self._set_planner)
        others = gui.add_dropdown("Compare with", [NONE, PIPELINE, *planners], initial_value=NONE,
                                  hint="Plan uses this planner too, and shows both plans")
        self._console.on_change(others, self._set_compared_planner)
        for name, action, label in (
            ("plan", self._plan_goal, "Plan"), ("execute", self._execute, "Execute"),
            ("go", self._plan_and_execute, "Plan and execute"),
            ("other", self._execute_compared, "Execute compared plan"),
            ("here", self._goal.copy_current, "Copy current pose"),
        ):
            self._console.on_press(f"move:{name}", action, label)
        self._buttons, self._result = Html(gui), Html(gui)
        self._result.set(_result("Select a goal, press Plan, check the ghost in the scene, then press Execute.", "dim"))

    @property
    def marker(self) -> bool:
        """Whether the goal marker is shown."""
        return self._goal.marker

    def show(self, task: TaskStatus | None, now: float) -> None:
        """Update buttons and goal marker at a wall time [s], monotonic."""
        available = self._console.is_available(topics.MOTION_STOP)
        motion = self._console.latest(topics.MOTION_STATUS) if available else None
        self._blocked = arm_blocked(task, motion)
        self._jog.show(self._blocked or jog_blocked(motion))
        if self._gripper is not None:
            self._gripper.show(self._blocked)
        home = press("Go home", "home", self._blocked, arm=True)
        force = wrench_text(self._console.latest(topics.WRENCH), self._force_limit) if available else ""
        self._arm.set(block('<div class="buttons">' + (
            f"{span('Gripper', 'dim')}{self._gripper.buttons}" if self._gripper is not None else "") + home + "</div>"
            + (f"<div>{span('Force at the tool', 'dim')} {text(force)}</div>" if force else ""), "arm"))
        self._poses.show(self._blocked)
        self._discard_if_marker_moved()

        def execute(label: str, name: str, plan: PlanResponse | None) -> str:
            return press(label, name, self._blocked or ("" if plan is not None else "press Plan first"), arm=True)

        shown = [press("Plan", "move:plan"), execute("Execute", "move:execute", self._plan)]
        if self._compared_planner != NONE:
            shown.append(execute("Execute compared plan", "move:other", self._compared))
        shown += [press("Plan and execute", "move:go", self._blocked, arm=True),
                  press("Copy current pose", "move:here", "" if self._goal.numeric else
                        "select a goal in numbers first: tool pose or joint positions")]
        self._buttons.set(block(buttons(*shown), "plan buttons"))
        if (line := self._goal.check_marker(now)) is not None:
            self._result.set(_result(*line))

    def _state(self) -> tuple[MotionStatus | None, MotionOwner | None]:
        return self._console.latest(topics.MOTION_STATUS), self._console.latest(topics.MOTION_OWNER)

    # --- operations ---

    async def go_home(self) -> None:
        """Move the arm to its home pose."""
        await self._run(self._move(JointGoal(named="home"), "", "Home pose reached"), "Moving to the home pose …")

    async def _plan_goal(self) -> None:
        if (goal := self._goal.goal()) is not None:
            await self._run(self._plan_to(goal), "Planning …")

    async def _plan_and_execute(self) -> None:
        if (goal := self._goal.goal()) is not None:
            await self._run(self._move(goal, self._planner, "Goal reached"), "Planning and executing …")

    async def _execute(self) -> None:
        if not self._discard_if_marker_moved():
            await self._execute_plan(self._plan)

    async def _execute_compared(self) -> None:
        if not self._discard_if_marker_moved():
            await self._execute_plan(self._compared)

    async def _execute_plan(self, plan: PlanResponse | None) -> None:
        if plan is None or plan.trajectory is None:
            self._report("Press Plan first.", "bad")
            return
        await self._run(self._follow(plan, plan.trajectory), "Executing the plan …")

    async def _move_through(self, names: list[str]) -> None:
        goals = [JointGoal(positions=self._poses.positions(name)) for name in names]

        async def move() -> None:
            acknowledged = (await self._motions.require_free()).newest  # a STOP between two poses ends the sequence
            for name, goal in zip(names, goals, strict=True):
                self._report(f"Moving to {name} …", "busy")
                await self._move(goal, self._planner, f"{name} reached", acknowledged)
                await asyncio.sleep(0)

        await self._run(move(), "Running the sequence …")

    async def _run(self, operation: Coroutine[None, None, None], line: str) -> None:
        """Await an operation; report its error."""
        self._report(line, "busy")
        try:
            await operation
        except USER_ERRORS as error:
            self._report(error_text(error), "bad")

    async def _plan_to(self, goal: Goal) -> None:
        self._discard()
        discarded = self._discarded
        planners = [self.planner] + ([self._compared_planner] if self._compared_planner != NONE else [])
        responses = [await self._motions.plan(goal, planner="" if name == PIPELINE else name) for name in planners]
        if discarded != self._discarded:
            self._report("Plan discarded: the goal was changed meanwhile.", "busy")
            return
        plans = [response if response.ok and response.trajectory is not None else None for response in responses]
        self._plan, self._compared = plans[0], plans[1] if len(plans) > 1 else None
        self._planned_goal = goal
        if self._compared is not None:
            self._scene.compare(self._compared.trajectory)
        if self._plan is not None and self._plan.trajectory is not None:
            self._scene.play(self._plan.trajectory)
        lines = [f"{name}: {plan_text(each)}" for name, each in zip(planners, responses, strict=True)]
        self._report(plan_text(responses[0]) if len(lines) == 1 else " — ".join(lines), "good" if plans[0] else "bad")

    async def _follow(self, plan: PlanResponse, trajectory: JointTrajectory) -> None:
        self._discard()
        await self._motions.follow(trajectory, plan=plan)
        self._report("Goal reached", "good")

    async def _move(self, goal: Goal, planner: str, done: str, acknowledged: int | None = None) -> None:
        self._discard()
        await self._motions.move(goal, planner=planner, acknowledged=acknowledged)
        self._report(done, "good")

    def _discard(self) -> None:
        """Discard the plans: they have another goal, or another start than the arm's present position."""
        self._discarded += 1
        self._plan = self._compared = None
        self._scene.compare(None)

    def _discard_if_marker_moved(self) -> bool:
        """Discard plans to a former pose of the goal marker; return whether there were any."""
        planned = self._planned_goal if self._plan is not None or self._compared is not None else None
        if self._goal.kind != MARKER or not isinstance(planned, PoseGoal) or planned.pose == self._scene.goal_pose:
            return False
        self._discard()
        self._report("The goal marker was moved: press Plan again.", "busy")
        return True

    # --- fields ---

    @property
    def _planner(self) -> str:
        return "" if self.planner == PIPELINE else self.planner

    def _offer(self) -> None:
        self._goal.offer(self._poses.names)

    def _saved_positions(self, name: str) -> list[float]:
        return self._poses.positions(name)

    def _set_planner(self, name: str) -> None:
        self.planner = name

    def _set_compared_planner(self, name: str) -> None:
        self._compared_planner = name
        self._compared = None
        self._scene.compare(None)

    def _report(self, line: str, kind: str) -> None:
        """Show a line in this tab and on every page."""
        self._result.set(_result(line, kind))
        self._notify_all(line, kind)


def _result(line: str, kind: str) -> str:
    return block(f"{span('●', kind + ' dot')} {text(line)}", "move", kind=kind)
