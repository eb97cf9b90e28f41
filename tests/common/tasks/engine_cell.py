"""A fake cell around the task engine, whose arm and gripper are controlled by the test."""

from __future__ import annotations

from typing import Any

from common import messages as m
from common.config import load_cell
from common.tasks.decisions import TaskConfig
from common.tasks.engine import Task
from common.tasks.stages import AwaitImage, Grip, Move, View
from tests.common.tasks.task_double import TaskDouble

CELL = load_cell("panda")
THERE = m.PoseGoal(pose=m.Pose(position=m.Vector3(x=0.4, z=0.3)))


class Fetch(Task[View]):
    """Take the object in front of the arm, once."""

    def decide(self, view: View) -> None:
        if not self.has_fresh_image(view):
            return
        if view.holding:
            self.end("DONE", "it is in the hand")
        else:
            self.queue += [Move("reach", "REACHING", goal=THERE), Grip("close", "REACHING", width=0.0, holds=True),
                         Move("lift", "LIFTING", goal=THERE, carries=True), AwaitImage()]


class Cell(TaskDouble):
    """Motions and grips start at once; the test ends them."""

    def __init__(self, task: type[Task[View]] = Fetch, **robot: Any) -> None:
        config = TaskConfig(robot=CELL.robot.model_copy(update=robot), run=CELL.run)
        super().__init__(task(config, m.TaskStatus(), "t"), gripper_width=0.08)
        self.objects = [thing("cube", 0.4)]

    def view(self) -> View:
        scene = m.PlanningScene(header=self.header, objects=self.objects)
        return View(self.now, scene, self.gripper, self.motion, [0.0] * 7, m.Pose(position=m.Vector3(x=0.3, z=0.2)))

    def trajectory(self, request: m.PlanRequest) -> m.JointTrajectory:
        point = m.JointTrajectoryPoint(
            time_from_start=1.0, positions=[len(self.requests)], velocities=[0.0], accelerations=[0.0])
        return m.JointTrajectory(joint_names=["j"], points=[point])

    def plan(self, request: m.PlanRequest) -> m.PlanResponse:
        return super().plan(request).model_copy(update={"scene_stamp": 7})

    def execute(self, request: m.ExecuteRequest) -> m.MotionStatus:
        self.motion = m.MotionStatus(header=self.header, id=request.id, state="active")
        return self.motion

    def grip(self, request: m.GripperCommand) -> m.GripperState:
        self.gripper = m.GripperState(header=self.header, id=request.id, state="active", moving=True)
        return self.gripper

    @property
    def status(self) -> m.TaskStatus:
        return self.task.status

    @property
    def stage(self) -> str:
        """Name of the running stage."""
        return self.task.running.stage.name if self.task.running else ""

    @property
    def grips(self) -> list[m.GripperCommand]:
        return [command for command in self.requests if isinstance(command, m.GripperCommand)]

    def steps(self, count: int) -> list[m.Message]:
        """Step; return the requests."""
        return [command for _ in range(count) for command in self.step()]

    def arm(self, state: str = "succeeded", **more: Any) -> None:
        """Change the state of the motion."""
        self.motion = self.motion.model_copy(update={"header": self.header, "state": state, **more})

    def fingers(self, width: float | None = None, state: str = "succeeded", **more: Any) -> None:
        """Change the state of the gripper."""
        self.gripper = self.gripper.model_copy(update={
            "header": self.header, "state": state, "moving": state == "active",
            "width": self.gripper.width if width is None else width, **more})

    def until(self, *wanted: str, most: int = 100) -> None:
        """Step until such a stage runs; every motion and grip before it succeeds."""
        for _ in range(most):
            self.step()
            if self.stage in wanted:
                return
            self.finish()
        raise AssertionError(f"never {wanted}: {self.status}")

    def finish(self, state: str = "succeeded") -> None:
        """End the running motion or grip."""
        running = self.task.running
        if running is not None and running.moves_arm:
            self.arm(state)
        elif running is not None:
            width = running.stage.width
            self.fingers(width, state, holding=width == 0.0)


def thing(name: str, x: float) -> m.CollisionObject:
    return m.CollisionObject(id=name, role="target", shape="box", dimensions=[0.05, 0.05, 0.05],
                             pose=m.Pose(position=m.Vector3(x=x, y=0.0, z=0.025)))


def stops(asked: list[m.Message]) -> list[str]:
    """Return the ids of the motions to stop."""
    return [command.id for command in asked if isinstance(command, m.StopRequest)]
