"""A fake pick-and-place cell without a network: answers requests at once and simulates its world."""

from __future__ import annotations

import math

from applications.pick_place.choice import PickPlaceView
from applications.pick_place.grasping import Config
from applications.pick_place.task import PickPlace
from applications.pick_place.topics import PickPlaceStatus
from common import messages as m
from common.config import Surroundings, load_cell

CELL = load_cell("panda")
SEVEN = [tuple(spot) for spot in CELL.world.spots[:7]]
MOTION, FINGERS, LEAD = 0.45, 0.25, 0.1  # [s] durations, and lead of the fingers before standstill


class CellDouble:
    """Balls on a table; plans succeed, motions take five steps, fingers hold what lies at the tool."""

    def __init__(self, balls: list[tuple[float, float]], **parameters: object) -> None:
        sections = {"robot": CELL.robot, "run": CELL.run, "world": CELL.section(Surroundings), "grasp": CELL.grasp}
        config = Config.model_validate({**sections, **parameters})
        self.task = PickPlace(config, PickPlaceStatus(), "t")
        self.balls = {f"track_{k}": (x, y, 0.03) for k, (x, y) in enumerate(balls)}
        self.unreachable: list[tuple[float, float]] = []
        self.held: str = ""
        self.contained = 0
        self.beneath = 0  # more of them, occluded
        self.fell: list[tuple[float, float, float]] = []  # where the first of them lie, of those that fell
        self.now = 100.0
        self.tcp = (0.3, 0.0, 0.5)
        self.motion = m.MotionStatus()
        self.gripper = m.GripperState(width=0.08)
        self.requests: list[m.Message] = []
        self.unplannable = lambda request: ""  # noqa: E731 - replaced by tests
        self.slips = 0  # closes that will hold nothing
        self.outliers = 0  # closes that will hold something wider than it was seen
        self.camera_on = True
        self.camera_ahead = 0.0  # [s] its clock
        self.late = 0  # motions that will reach the controller too late
        self._stamp = self.now
        self._arrival = 0.0
        self._ends: list[m.ExecuteRequest] = []
        self._waiting: m.GripperCommand | None = None  # for the arm
        self._fingers: tuple[m.GripperCommand, float] | None = None  # their command and its end
        self._goals: dict[str, m.Pose] = {}

    def restart(self) -> None:
        """The task ends, and another one begins."""
        self.task = CellDouble([]).task
        self.task.prefix = f"again{self.now:.1f}"

    def view(self) -> PickPlaceView:
        if self.camera_on:
            self._stamp = self.now + self.camera_ahead
        objects = [self._sphere(name, "target", p) for name, p in self.balls.items()]
        fell = [*self.fell, *[(0.55, 0.25, 0.035)] * (self.contained - len(self.fell))]
        objects += [self._sphere(f"slot_{k}", "contained", fell[k]) for k in range(self.contained)]
        objects += [self._sphere(f"beneath_{k}", "contained", (0.55, 0.25, 0.035), unseen=True)
                    for k in range(self.beneath)]
        attached = []
        if self.held:
            attached = [m.AttachedObject(link="panda_hand_tcp", object=self._sphere(self.held, "attached", (0, 0, 0)))]
        header = m.Header(stamp=int(self._stamp * 1e9), frame_id="world")
        reachable = [p for p in self.balls.values() if p[:2] not in self.unreachable]
        scene = m.PlanningScene(header=header, objects=objects, attached=attached)
        seen = m.PoseArray(header=header, poses=[m.Pose(position=m.Vector3(x=x, y=y, z=z)) for x, y, z in reachable])
        tcp = m.Pose(position=m.Vector3(x=self.tcp[0], y=self.tcp[1], z=self.tcp[2]))
        return PickPlaceView(self.now, scene, self.gripper, self.motion, [0.0], tcp, seen=seen)

    @staticmethod
    def _sphere(name: str, role: str, p: tuple[float, float, float], unseen: bool = False) -> m.CollisionObject:
        return m.CollisionObject.model_validate({
            "id": name, "role": role, "shape": "sphere", "dimensions": [0.03],
            "pose": m.Pose(position=m.Vector3(x=p[0], y=p[1], z=p[2])), "unseen": unseen,
        })

    def command(self, command: str) -> list[m.Message]:
        """Say something to the task; what it asks for is answered."""
        asked: list[m.Message] = list(self.task.command(command, self.view()))
        for request in asked:
            self.answer(request)
        return asked

    def step(self) -> list[m.Message]:
        """One step of the task; every request is answered before the next."""
        self.now += 0.1
        if self._waiting is not None and self.motion.state != "active":
            self.gripper = self.gripper.model_copy(update={
                "header": m.Header(stamp=int(self.now * 1e9)), "id": self._waiting.id, "state": "cancelled"})
            self._waiting = None
        if self.motion.held:
            self._arrival += 0.1
        elif self._waiting is not None and self.now >= self._arrival - LEAD:
            self._let_begin(self._waiting)
        elif self._ends and self.now >= self._arrival:
            self._arrive(self._ends.pop())
        if self._fingers is not None and self.now >= self._fingers[1]:
            done, self._fingers = self._fingers[0], None
            self._grip(done)
        asked: list[m.Message] = list(self.task.step(self.view()))
        for request in asked:
            self.answer(request)
        return asked

    def answer(self, request: m.Message) -> None:
        self.requests.append(request)
        header = m.Header(stamp=int(self.now * 1e9))
        if isinstance(request, m.PlanRequest):
            error = self.unplannable(request)
            goal = request.goal
            if isinstance(goal, m.SequenceGoal):
                goal = goal.items[-1].goal
            if isinstance(goal, m.GoalSet):
                goal = goal.goals[0]
            if isinstance(goal, m.PoseGoal):
                self._goals[request.id] = goal.pose
            point = m.JointTrajectoryPoint(
                time_from_start=MOTION, positions=[0.0], velocities=[0.0], accelerations=[0.0])
            trajectory = m.JointTrajectory(header=m.Header(frame_id=request.id), joint_names=["j"], points=[point])
            self.task.on_plan(m.PlanResponse(id=request.id, ok=not error, trajectory=None if error else trajectory,
                                             error=error, message=error and f"{request.stage}: {error}",
                                             planner="double", seconds=0.01, fraction=1.0), self.view())
        elif isinstance(request, m.ExecuteRequest) and self.late:
            self.late -= 1
            refused = m.MotionStatus(id=request.id, state="rejected", error="stale_request", message="it is 10 s old")
            self.task.on_goal(refused, self.view())
        elif isinstance(request, m.ExecuteRequest):
            self.motion = m.MotionStatus(header=header, id=request.id, state="active", held=self.motion.held)
            self.task.on_goal(self.motion, self.view())
            self._ends.append(request)
            self._arrival = self.now + MOTION
        elif isinstance(request, m.GripperCommand):
            if self._ends:
                assert request.after == self._ends[-1].id
                self._waiting = request
                self.task.on_goal(m.GripperState(header=header, id=request.id, state="active"), self.view())
            else:
                self._grip(request)
                self.task.on_goal(self.gripper, self.view())
        elif isinstance(request, m.StopRequest):
            if self.motion.state == "active":
                self._ends.clear()
                self.motion = self.motion.model_copy(update={"header": header, "state": "cancelled"})
        elif isinstance(request, m.HoldRequest):
            self.motion = self.motion.model_copy(update={"header": header, "held": request.hold})

    def _let_begin(self, request: m.GripperCommand) -> None:
        self._waiting, self._fingers = None, (request, self.now + FINGERS)
        self._go_to_end(self._ends[-1])
        self.gripper = self.gripper.model_copy(update={
            "header": m.Header(stamp=int(self.now * 1e9)), "id": request.id, "state": "active", "moving": True})

    def _go_to_end(self, request: m.ExecuteRequest) -> None:
        pose = self._goals.get(request.trajectory.header.frame_id)
        if pose is not None:
            self.tcp = (pose.position.x, pose.position.y, pose.position.z)

    def _arrive(self, request: m.ExecuteRequest) -> None:
        self._go_to_end(request)
        self.motion = m.MotionStatus(header=m.Header(stamp=int(self.now * 1e9)), id=request.id, state="succeeded")

    def _grip(self, request: m.GripperCommand) -> None:
        if request.width > 0.06 and self.held:
            self._fall()
        elif request.width < 0.06 and not self.slips:
            for name, p in self.balls.items():
                if math.dist(p, self.tcp) < 0.01:
                    self.held = name
            self.balls.pop(self.held, None)
        elif request.width < 0.06:
            self.slips -= 1
        self.gripper = m.GripperState(
            header=m.Header(stamp=int(self.now * 1e9)), id=request.id, state="succeeded", holding=bool(self.held),
            width=0.06 if self.held else request.width)
        if self.held and self.outliers and request.width < 0.06:
            self.outliers -= 1
            self.gripper = self.gripper.model_copy(update={
                "state": "aborted", "outcome": "too_wide", "width": 0.075, "message": "the fingers closed on a brick"})

    def _fall(self) -> None:
        if max(abs(self.tcp[0] - 0.55), abs(self.tcp[1] - 0.25)) < 0.07:  # between its walls
            self.fell.append((*self.tcp[:2], 0.035 if self.contained < 4 else 0.095))
            self.contained += 1
        else:
            self.balls[self.held] = (*self.tcp[:2], 0.03)
        self.held = ""

    def drop(self) -> None:
        """The held ball falls on the table below, or into the container."""
        self._fall()
        self.gripper = self.gripper.model_copy(update={"holding": False, "width": 0.0})

    def until(self, condition: str, most: int = 2000) -> None:
        """Step until an expression about the status (a state, a stage) is true."""
        for _ in range(most):
            self.step()
            if condition in (self.task.status.state, self.task.status.stage):
                return
        raise AssertionError(f"never {condition}: {self.task.status}")

    def stages(self) -> list[str]:
        """Stages for which a plan was asked, in order."""
        return [r.stage for r in self.requests if isinstance(r, m.PlanRequest)]
