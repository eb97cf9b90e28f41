"""How a person has the arm moved: jogged, or to a goal of their own: the marker, numbers, or a pose with a name."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Coroutine, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import viser

from common import topics
from common.messages import (
    JointGoal,
    JointTrajectory,
    MotionOwner,
    MotionStatus,
    PlanResponse,
    Pose,
    PoseGoal,
    TaskStatus,
)
from common.robot.transforms import matrix_to_pose, pose_to_matrix, rpy_to_matrix, transform
from page import words
from page.arm_numbers import ArmNumbers, Numbers
from page.console import Console, assign
from page.hand_panel import HandPanel
from page.jog import Jogger, JogPanel
from page.markup import block, buttons, press, span, text
from page.taught_panel import TaughtPanel
from page.words import plan, problem

if TYPE_CHECKING:
    from common.robot.model import RobotModel

PIPELINE, NOTHING = "pipeline", "nothing"
MARKER, TOOL, JOINTS = "goal marker", "tool: numbers", "joints: numbers"
SETTLED = 0.5  # [s] for which the marker rests before it is looked for why it cannot be reached, which takes longer
RESTARTS = 20  # of the search for joint positions


class Motions(Protocol):
    """Plans and moves for a person; with no planner named, by the cell's pipeline."""

    async def plan(self, goal: PoseGoal | JointGoal, *, planner: str = "") -> PlanResponse:
        """A plan to a goal; nothing moves."""

    async def move(
        self, goal: PoseGoal | JointGoal, *, planner: str = "", acknowledged: int | None = None
    ) -> MotionStatus:
        """The end of a motion to a goal; what was said later than `heard` keeps the arm."""

    async def follow(self, trajectory: JointTrajectory, *, plan: PlanResponse | None = None) -> MotionStatus:
        """The end of following what was planned."""

    async def require_free(self) -> MotionStatus:
        """How the arm is, when it is nobody else's."""


class Goal(Protocol):
    """Where the goal marker is in the scene."""

    def goal_marker(self, on: bool) -> None:
        """Show or hide it."""

    def goal_reached(self, reached: bool | None) -> None:
        """Show whether the arm can be there."""

    @property
    def goal_pose(self) -> Pose:
        """Its pose in world."""

    def play(self, plan: JointTrajectory) -> None:
        """Show a plan as a motion of the ghost."""

    def compare(self, plan: JointTrajectory | None) -> None:
        """Show another beside it; None: none any more."""


class MovePanel:
    """Jogging, fingers, goals and taught poses, and how it went."""

    def __init__(
        self, gui: viser.GuiApi, console: Console, motions: Motions, scene: Goal, robot: RobotModel,
        planners: Sequence[str], *, cell: str, planner: str, marker: bool, tell: Callable[[str, str], None],
    ) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            console: takes the orders.
            motions: carry them out.
            scene: has the goal marker and the ghost.
            robot: not used by another thread.
            planners: that may be asked.
            cell: its name.
            planner: that is asked at first.
            marker: whether the goal marker is shown at first.
            tell: called with a line about how it went, and whether that is good, busy or bad.
        """
        self._console, self._motions, self._goal, self._robot, self._tell_all = console, motions, scene, robot, tell
        self.planner = planner if planner in planners else PIPELINE
        self.marker = marker
        self._kind = MARKER
        self._found: PlanResponse | None = None
        self._other: PlanResponse | None = None  # that it is compared with
        self._planned: PoseGoal | JointGoal | None = None  # the goal that both are for
        self._forgot = 0  # how often what was planned was forgotten
        self.compared = NOTHING
        self._reached: tuple[Pose, float, bool] | None = None  # goal, since when, whether it was looked for why not
        self.numbers = ArmNumbers(robot, console.latest)
        q = robot.named("home")
        self._xyz, self._rpy, self._q = self.numbers.of(q)
        with gui.add_folder("Jog", expand_by_default=True):
            fastest = robot.velocity.tolist()
            self._jog = JogPanel(gui, console, robot.joint_names, fastest)
        self.jogger = Jogger(console, self._jog.velocities, self._state, lambda: self._kept)
        self._kept = ""
        gripper = robot.config.gripper
        self._hand: HandPanel | None = None
        if gripper is not None:
            with gui.add_folder("Gripper", expand_by_default=True):
                self._hand = HandPanel(gui, console, gripper, motions.require_free)
        with gui.add_folder("Go to", expand_by_default=True):
            self._choice = gui.add_dropdown("Goal", [MARKER], initial_value=MARKER)
            console.on_change(self._choice, self._set_kind)
            self._tick = gui.add_checkbox("Goal marker", marker,
                                          hint="drag it in the scene to where the tool should be")
            console.on_change(self._tick, self.set_marker)
            self._at = gui.add_vector3("Tool at [mm]", self._xyz, step=1.0, visible=False, hint="x, y, z in world")
            self._turned = gui.add_vector3("Turned [°]", self._rpy, step=1.0, visible=False,
                                           hint="about x, y and z of world, in that order")
            console.on_change(self._at, self._set_xyz)
            console.on_change(self._turned, self._set_rpy)
            self._angles = [gui.add_number(f"{name} {unit}", value, step=0.1, visible=False)
                            for name, unit, value in zip(robot.joint_names, self.numbers.units, self._q, strict=True)]
            for number, field in enumerate(self._angles):
                console.on_change(field, self._setter(number))
            names = gui.add_dropdown("Planner", [PIPELINE, *planners], initial_value=self.planner,
                                     hint="pipeline: the cell's planners, in their order")
            console.on_change(names, self._set_planner)
            others = gui.add_dropdown("Compare with", [NOTHING, PIPELINE, *planners], initial_value=NOTHING,
                                      hint="Plan asks this one, too, and shows both")
            console.on_change(others, self._set_compared)
            for name, act, told in (
                ("plan", self._plan_it, "Plan"), ("execute", self._execute, "Execute"), ("go", self._go, "Go there"),
                ("other", self._execute_other, "Execute the other"),
                ("here", self._take_numbers, "Numbers from the arm"),
            ):
                console.on_press(f"move:{name}", act, told)
            self._buttons = gui.add_html("")
            self._html = gui.add_html(_line("Choose a goal, plan, look at the ghost, then execute.", "dim"))
        with gui.add_folder("Taught poses", expand_by_default=False):
            self._taught = TaughtPanel(
                gui, console, cell, robot.joint_names, self.numbers.joints, self._offer, self._through,
                [MARKER, TOOL, JOINTS, *robot.config.named_poses])
        self._offer()
        if marker:
            scene.goal_marker(True)

    # --- what is shown ---------------------------------------------------------------------------------------------

    def show(self, task: TaskStatus | None, now: float) -> None:
        """Bring buttons and marker up to date at a wall time [s], monotonic."""
        motion = self._console.latest(topics.MOTION_STATUS) if self._console.answers(topics.MOTION_STOP) else None
        self._kept = words.kept(task, motion)
        jogged = self._kept or words.not_jogged(motion)
        self._jog.show(jogged)
        if self._hand is not None:
            self._hand.show(self._kept)
        self._taught.show(self._kept)
        self._look_at_marker()
        found = "" if self._found is not None else "plan first"
        content = block(buttons(
            press("Plan", "move:plan"), press("Execute", "move:execute", self._kept or found, arm=True),
            *([press("Execute the other", "move:other", self._kept or (
                "" if self._other is not None else "plan first"), arm=True)] if self.compared != NOTHING else []),
            press("Go there", "move:go", self._kept, arm=True),
            press("Numbers from the arm", "move:here", "" if self._kind in (TOOL, JOINTS) else
                  "for goals in numbers")), "orders")
        if content != self._buttons.content:
            self._buttons.content = content
        self._reach(now)

    def _reach(self, now: float) -> None:
        """Look whether the arm can be at the marker, and once that rests why not."""
        from common.planning.ik import explain_ik_failure, solve_ik

        if not self.marker or (seed := self.numbers.joints()) is None:
            return
        pose, before = self._goal.goal_pose, self._reached
        if before is not None and before[0] == pose and (before[2] or now - before[1] < SETTLED):
            return
        target = pose_to_matrix(pose)
        if before is None or before[0] != pose:
            there = solve_ik(self._robot, target, seed, restarts=RESTARTS) is not None
            self._goal.goal_reached(there)
            self._reached = (pose, now, there)
            self._html.content = _line("The arm can be there; Plan tells what is in the way." if there
                                       else "The arm cannot be there.", "good" if there else "bad")
        else:
            self._reached = (pose, before[1], True)
            why = explain_ik_failure(self._robot, target, seed)
            self._html.content = _line(f"The arm cannot be there: {why}", "bad")

    def _state(self) -> tuple[MotionStatus | None, MotionOwner | None]:
        return self._console.latest(topics.MOTION_STATUS), self._console.latest(topics.MOTION_OWNER)

    # --- what a person does ----------------------------------------------------------------------------------------

    def set_marker(self, on: bool) -> None:
        """Show or hide the goal marker."""
        self.marker, self._reached = on, None
        assign(self._tick, on)
        self._goal.goal_marker(on)

    async def go_home(self) -> None:
        """Have the arm go home."""
        await self._do(self._move(JointGoal(named="home"), "", "At home"), "Going home …")

    def _target(self) -> PoseGoal | JointGoal | None:
        """What was chosen; None while the marker is not shown yet.

        Raises:
            ConfigError: a taught pose that is gone.
        """
        if self._kind == TOOL:
            rotation = rpy_to_matrix(*(math.radians(value) for value in self._rpy))
            x, y, z = (1e-3 * value for value in self._xyz)
            return PoseGoal(pose=matrix_to_pose(transform(rotation, (x, y, z))))
        if self._kind == JOINTS:
            return JointGoal(positions=(np.array(self._q) / self.numbers.scales).tolist())
        if self._kind in self._robot.config.named_poses:
            return JointGoal(named=self._kind)
        if self._kind != MARKER:
            return JointGoal(positions=self._taught.positions(self._kind))
        if self.marker:
            return PoseGoal(pose=self._goal.goal_pose)
        self.set_marker(True)
        self._tell("Drag the goal marker to where the tool should be, then try again.", "busy")
        return None

    @property
    def _asked(self) -> str:
        return "" if self.planner == PIPELINE else self.planner

    async def _plan_it(self) -> None:
        if (goal := self._target()) is not None:
            await self._do(self._plan(goal), "Planning …")

    async def _go(self) -> None:
        if (goal := self._target()) is not None:
            await self._do(self._move(goal, self._asked, "There"), "Planning and going there …")

    async def _execute(self) -> None:
        if self._look_at_marker():
            return
        found = self._found
        if found is None or found.trajectory is None:
            self._tell("Plan first.", "bad")
            return
        await self._do(self._follow(found, found.trajectory), "Executing the plan …")

    async def _execute_other(self) -> None:
        if self._look_at_marker():
            return
        self._found = self._other
        await self._execute()

    async def _do(self, doing: Coroutine[Any, Any, None], line: str) -> None:
        self._tell(line, "busy")
        try:
            await doing
        except words.UNDERSTOOD as error:
            self._tell(problem(error), "bad")

    async def _plan(self, goal: PoseGoal | JointGoal) -> None:
        self._forget()
        forgot = self._forgot
        asked = [self.planner] + ([self.compared] if self.compared != NOTHING else [])
        responses = [await self._motions.plan(goal, planner="" if name == PIPELINE else name) for name in asked]
        if forgot != self._forgot:
            self._tell("The plan is not kept: something else was asked for meanwhile.", "busy")
            return
        kept = [response if response.ok and response.trajectory is not None else None for response in responses]
        self._found, self._other = kept[0], kept[1] if len(kept) > 1 else None
        self._planned = goal
        if self._other is not None:
            self._goal.compare(self._other.trajectory)
        if self._found is not None and self._found.trajectory is not None:
            self._goal.play(self._found.trajectory)
        lines = [f"{name}: {plan(each)}" for name, each in zip(asked, responses, strict=True)]
        self._tell(plan(responses[0]) if len(lines) == 1 else " — ".join(lines), "good" if kept[0] else "bad")

    def _forget(self) -> None:
        """Forget what was planned: it is for another goal, or begins elsewhere than the arm is now."""
        self._forgot += 1
        self._found = self._other = None
        self._goal.compare(None)

    def _look_at_marker(self) -> bool:
        """Forget a plan to where the marker was, if it has been moved since, and say so; whether it has."""
        planned = self._planned if self._found is not None or self._other is not None else None
        if self._kind != MARKER or not isinstance(planned, PoseGoal) or planned.pose == self._goal.goal_pose:
            return False
        self._forget()
        self._tell("The goal marker was moved: plan again.", "busy")
        return True

    async def _follow(self, found: PlanResponse, trajectory: JointTrajectory) -> None:
        self._forget()
        await self._motions.follow(trajectory, plan=found)
        self._tell("There", "good")

    async def _move(
        self, goal: PoseGoal | JointGoal, planner: str, there: str, acknowledged: int | None = None
    ) -> None:
        self._forget()
        await self._motions.move(goal, planner=planner, acknowledged=acknowledged)
        self._tell(there, "good")

    async def _through(self, names: list[str]) -> None:
        goals = [JointGoal(positions=self._taught.positions(name)) for name in names]

        async def go() -> None:
            acknowledged = (await self._motions.require_free()).newest  # a STOP between two poses ends all of it
            for name, goal in zip(names, goals, strict=True):
                self._tell(f"Going to {name} …", "busy")
                await self._move(goal, self._asked, f"At {name}", acknowledged)
                await asyncio.sleep(0)

        await self._do(go(), "Going through the poses …")

    # --- fields ----------------------------------------------------------------------------------------------------

    def _offer(self) -> None:
        """Have the goals that there are chosen from."""
        options = [MARKER, TOOL, JOINTS, *self._robot.config.named_poses, *self._taught.names]
        self._choice.options = options
        if self._kind not in options:
            self._set_kind(MARKER)
        assign(self._choice, self._kind)

    def _set_kind(self, kind: str) -> None:
        self._kind = kind
        self._forget()
        self._tick.visible = kind == MARKER
        self._at.visible = self._turned.visible = kind == TOOL
        for number_field in self._angles:
            number_field.visible = kind == JOINTS
        if kind in (TOOL, JOINTS):
            self._take_numbers()
        elif kind == MARKER and not self.marker:
            self.set_marker(True)

    def _take_numbers(self) -> None:
        q = self.numbers.joints()
        if q is None:
            self._tell("Where the arm is is not known.", "bad")
            return
        self._forget()
        self._xyz, self._rpy, self._q = self.numbers.of(q)
        assign(self._at, self._xyz)
        assign(self._turned, self._rpy)
        for field, value in zip(self._angles, self._q, strict=True):
            assign(field, value)

    def _set_xyz(self, xyz: Numbers) -> None:
        self._xyz = xyz
        self._forget()

    def _set_rpy(self, rpy: Numbers) -> None:
        self._rpy = rpy
        self._forget()

    def _setter(self, number: int) -> Callable[[float], None]:
        def put(value: float) -> None:
            self._q[number] = value
            self._forget()

        return put

    def _set_planner(self, name: str) -> None:
        self.planner = name

    def _set_compared(self, name: str) -> None:
        self.compared = name
        self._other = None
        self._goal.compare(None)

    def _tell(self, line: str, kind: str) -> None:
        self._html.content = _line(line, kind)
        self._tell_all(line, kind)


def _line(line: str, kind: str) -> str:
    return block(f"{span('●', kind + ' dot')} {text(line)}", "move", kind=kind)
