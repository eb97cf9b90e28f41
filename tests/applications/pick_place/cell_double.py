"""Fake pick-and-place cell without a network."""

from __future__ import annotations

import math

from applications.pick_place.choice import PickPlaceView
from applications.pick_place.grasping import Config
from applications.pick_place.task import PickPlace
from applications.pick_place.topics import PickPlaceStatus
from common import messages as m
from common.config import Surroundings, load_cell
from tests.common.tasks.task_double import MOTION, TaskDouble

CELL = load_cell("panda")
SEVEN = [tuple(spot) for spot in CELL.world.spots[:7]]
FINGERS, LEAD = 0.25, 0.1  # [s] duration of a gripper command, and lead of the fingers before standstill


def _vector(place: tuple[float, float, float]) -> m.Vector3:
    return m.Vector3(x=place[0], y=place[1], z=place[2])


class CellDouble(TaskDouble):
    """Balls on a table; the fingers hold what is at the tool."""

    def __init__(self, balls: list[tuple[float, float]], **parameters: object) -> None:
        sections = {"robot": CELL.robot, "run": CELL.run, "world": CELL.section(Surroundings), "grasp": CELL.grasp}
        config = Config.model_validate({**sections, **parameters})
        super().__init__(PickPlace(config, PickPlaceStatus(), "t"), gripper_width=0.08)
        self.balls = {f"track_{k}": (x, y, 0.03) for k, (x, y) in enumerate(balls)}
        self.unreachable: list[tuple[float, float]] = []
        self.held: str = ""
        self.contained = 0
        self.beneath = 0  # more of them, occluded
        self.fell: list[tuple[float, float, float]] = []  # positions of the first of them
        self.tcp = (0.3, 0.0, 0.5)
        self.slips = 0  # grasps that will hold nothing
        self.outliers = 0  # grasps that will hold something wider than it was seen
        self._stamp = self.now
        self._waiting: m.GripperCommand | None = None  # for the arm
        self._fingers: tuple[m.GripperCommand, float] | None = None  # their command and its end
        self._goals: dict[str, m.Pose] = {}

    def restart(self) -> None:
        """Replace the task by a new process."""
        self.task = CellDouble([]).task
        self.task.prefix = f"again{self.now:.1f}"

    def steps(self, count: int) -> list[m.Message]:
        """Step several times and return all requests."""
        return [request for _ in range(count) for request in self.step()]

    def fail_motion(self, state: str = "aborted", message: str = "path tolerance") -> None:
        """End the running motion in another way than by arrival."""
        self.running.clear()
        self.motion = self.motion.model_copy(update={"state": state, "message": message})

    def view(self) -> PickPlaceView:
        if self.camera_on:
            self._stamp = self.now + self.camera_ahead
        objects = [self._sphere(name, "target", p) for name, p in self.balls.items()]
        fell = [*self.fell, *[(0.55, 0.25, 0.035)] * (self.contained - len(self.fell))]
        objects += [self._sphere(f"slot_{k}", "contained", fell[k]) for k in range(self.contained)]
        objects += [self._sphere(f"beneath_{k}", "contained", (0.55, 0.25, 0.035), unseen=True)
                    for k in range(self.beneath)]
        attached = [m.AttachedObject(link="panda_hand_tcp", object=self._sphere(held, "attached", (0, 0, 0)))
                    for held in filter(None, [self.held])]
        header = m.Header(stamp=int(self._stamp * 1e9), frame_id="world")
        reachable = [p for p in self.balls.values() if p[:2] not in self.unreachable]
        scene = m.PlanningScene(header=header, objects=objects, attached=attached)
        seen = m.PoseArray(header=header, poses=[m.Pose(position=_vector(place)) for place in reachable])
        tcp = m.Pose(position=_vector(self.tcp))
        return PickPlaceView(self.now, scene, self.gripper, self.motion, [0.0], tcp, seen=seen)

    @staticmethod
    def _sphere(name: str, role: str, p: tuple[float, float, float], unseen: bool = False) -> m.CollisionObject:
        return m.CollisionObject.model_validate({
            "id": name, "role": role, "shape": "sphere", "dimensions": [0.03],
            "pose": m.Pose(position=_vector(p)), "unseen": unseen})

    def advance(self) -> None:
        if self._waiting is not None and self.motion.state != "active":
            self.gripper = self.gripper.model_copy(update={
                "header": self.header, "id": self._waiting.id, "state": "cancelled"})
            self._waiting = None
        if self._waiting is not None and not self.motion.held and self.now >= self.arrival - LEAD:
            self._start_fingers(self._waiting)
        else:
            super().advance()
        if self._fingers is not None and self.now >= self._fingers[1]:
            done, self._fingers = self._fingers[0], None
            self._close_or_open(done)

    def trajectory(self, request: m.PlanRequest) -> m.JointTrajectory:
        point = m.JointTrajectoryPoint(time_from_start=MOTION, positions=[0.0], velocities=[0.0], accelerations=[0.0])
        return m.JointTrajectory(header=m.Header(frame_id=request.id), joint_names=["j"], points=[point])

    def plan(self, request: m.PlanRequest) -> m.PlanResponse:
        goal = request.goal
        if isinstance(goal, m.SequenceGoal):
            goal = goal.items[-1].goal
        if isinstance(goal, m.GoalSet):
            goal = goal.goals[0]
        if isinstance(goal, m.PoseGoal):
            self._goals[request.id] = goal.pose
        return super().plan(request)

    def grip(self, request: m.GripperCommand) -> m.GripperState:
        if not self.running:
            self._close_or_open(request)
            return self.gripper
        assert request.after == self.running[-1].id
        self._waiting = request
        return m.GripperState(header=self.header, id=request.id, state="active")

    def _start_fingers(self, request: m.GripperCommand) -> None:
        self._waiting, self._fingers = None, (request, self.now + FINGERS)
        self._go_to_end(self.running[-1])
        self.gripper = self.gripper.model_copy(update={
            "header": self.header, "id": request.id, "state": "active", "moving": True})

    def _go_to_end(self, request: m.ExecuteRequest) -> None:
        if pose := self._goals.get(request.trajectory.header.frame_id):
            self.tcp = (pose.position.x, pose.position.y, pose.position.z)

    def arrive(self, request: m.ExecuteRequest) -> None:
        self._go_to_end(request)
        super().arrive(request)

    def _close_or_open(self, request: m.GripperCommand) -> None:
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
            header=self.header, id=request.id, state="succeeded", holding=bool(self.held),
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
