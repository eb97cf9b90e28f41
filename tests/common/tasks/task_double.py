"""A fake cell for any task, without a network: answers the task's requests at once."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from common import messages as m
from common.tasks.engine import Task

STEP, MOTION = 0.1, 0.45  # [s] of a step and of a motion


class TaskDouble(ABC):
    """Plans succeed, motions take five steps; tests change the attributes to cause faults."""

    def __init__(self, task: Task[Any], gripper_width: float) -> None:
        self.task = task
        self.now = 100.0
        self.motion, self.gripper = m.MotionStatus(), m.GripperState(width=gripper_width)
        self.requests: list[m.Message] = []
        self.unplannable: Callable[[m.PlanRequest], str] = lambda request: ""  # error of a plan
        self.colliding: tuple[str, str] | None = None  # pair of a failed plan
        self.fraction = 1.0  # of a path that can be planned
        self.camera_on = True
        self.camera_ahead = 0.0  # [s] lead of its clock
        self.late = 0  # motions that will reach the controller too late
        self.arrival = 0.0  # time at which the running motion ends
        self.running: list[m.ExecuteRequest] = []

    @property
    def stamp(self) -> int:
        return int(self.now * 1e9)

    @property
    def header(self) -> m.Header:
        return m.Header(stamp=self.stamp)

    @abstractmethod
    def view(self) -> Any:
        """Return what the task knows now."""

    @abstractmethod
    def trajectory(self, request: m.PlanRequest) -> m.JointTrajectory:
        """Return the planned motion."""

    @abstractmethod
    def grip(self, request: m.GripperCommand) -> m.GripperState:
        """Execute a gripper command and return the answer."""

    def arrive(self, request: m.ExecuteRequest) -> None:
        """End a motion."""
        self.motion = m.MotionStatus(header=self.header, id=request.id, state="succeeded")

    def command(self, command: str) -> list[m.Message]:
        """Send an operator's command to the task and answer its requests."""
        return self._answer_all(self.task.command(command, self.view()))

    def step(self) -> list[m.Message]:
        """Step the task once; every request is answered before the next."""
        self.now += STEP
        self.advance()
        return self._answer_all(self.task.step(self.view()))

    def _answer_all(self, requests: list[Any]) -> list[m.Message]:
        for request in requests:
            self.answer(request)
        return list(requests)

    def advance(self) -> None:
        """Move the arm for one step; a hold delays it."""
        if self.motion.held:
            self.arrival += STEP
        elif self.running and self.now >= self.arrival:
            self.arrive(self.running.pop())

    def answer(self, request: m.Message) -> None:
        self.requests.append(request)
        if isinstance(request, m.PlanRequest):
            self.task.on_plan(self.plan(request), self.view())
        elif isinstance(request, m.ExecuteRequest):
            self.task.on_goal(self.execute(request), self.view())
        elif isinstance(request, m.GripperCommand):
            self.task.on_goal(self.grip(request), self.view())
        elif isinstance(request, m.StopRequest) and self.motion.state == "active":
            self.running.clear()
            self.motion = self.motion.model_copy(update={"header": self.header, "state": "cancelled"})
        elif isinstance(request, m.HoldRequest):
            self.motion = self.motion.model_copy(update={"header": self.header, "held": request.hold})

    def plan(self, request: m.PlanRequest) -> m.PlanResponse:
        error = self.unplannable(request)
        return m.PlanResponse(
            id=request.id, ok=not error, trajectory=None if error else self.trajectory(request), error=error,
            message=error and f"{request.stage}: {error}", planner="double", seconds=0.01,
            fraction=0.5 if error else self.fraction, colliding=self.colliding if error else None)

    def execute(self, request: m.ExecuteRequest) -> m.MotionStatus:
        """Start a motion, or reject it as too late."""
        if self.late:
            self.late -= 1
            return m.MotionStatus(id=request.id, state="rejected", error="stale_request", message="it is 10 s old")
        self.motion = m.MotionStatus(header=self.header, id=request.id, state="active", held=self.motion.held)
        self.running.append(request)
        self.arrival = self.now + MOTION
        return self.motion

    def until(self, *wanted: str, most: int = 2000) -> None:
        """Step until the task is in one of these states or stages."""
        for _ in range(most):
            self.step()
            if {self.task.status.state, self.task.status.stage} & set(wanted):
                return
        raise AssertionError(f"never {wanted}: {self.task.status}")

    def plans(self) -> list[m.PlanRequest]:
        return [r for r in self.requests if isinstance(r, m.PlanRequest)]

    def stages(self) -> list[str]:
        """Stages of the plan requests, in order."""
        return [r.stage for r in self.plans()]
