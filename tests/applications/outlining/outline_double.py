"""An outlining cell without a network: answers the task's requests at once."""

from __future__ import annotations

from collections.abc import Callable

from applications.outlining.task import Config, Outline, OutlineView
from applications.outlining.topics import OutlinePoints, OutlineStatus
from common import messages as m
from common.config import RobotConfig, Run, check, find_file, read_robot

ROBOT = check(RobotConfig, read_robot(find_file("robots", "ur5")))
HOME = ROBOT.named_poses["home"]
AWAY = [0.5, *HOME[1:]]
SQUARE = [(0.45, -0.05), (0.55, -0.05), (0.55, 0.05), (0.45, 0.05)]
TOP = 1.1


def outline_of(points: list[tuple[float, float]], stamp: int, name: str = "Object_1") -> OutlinePoints:
    poses = [m.Pose(position=m.Vector3(x=x, y=y, z=TOP)) for x, y in points]
    return OutlinePoints(header=m.Header(stamp=stamp, frame_id="world"), poses=poses, object=name, invalid_depth=2)


def prism(name: str, x: float, y: float, half: float) -> m.CollisionObject:
    return m.CollisionObject(
        id=name, role="target", shape="prism", dimensions=[0.1],
        outline=[(-half, -half), (half, -half), (half, half), (-half, half)],
        pose=m.Pose(position=m.Vector3(x=x, y=y, z=TOP - 0.05)),
    )


class OutlineDouble:
    """A cube that was seen; plans succeed, motions take five steps and end where their plan does."""

    def __init__(self, started: bool = True, **parameters: object) -> None:
        run = Run(cell="ur5", autostart=started)
        config = Config.model_validate({"robot": ROBOT, "run": run} | parameters)
        self.task = Outline(config, OutlineStatus(), "t")
        self.now = 100.0
        self.path: OutlinePoints | None = outline_of(SQUARE, self.stamp)
        self.objects = [prism("Object_1", 0.5, 0.0, 0.05), prism("Object_2", 0.5, 0.3, 0.02)]
        self.motion = m.MotionStatus()
        self.gripper = m.GripperState(width=0.085)
        self.q = list(HOME)
        self.requests: list[m.Message] = []
        self.unplannable: Callable[[m.PlanRequest], str] = lambda request: ""
        self.colliding: tuple[str, str] | None = None
        self.fraction = 1.0
        self.abort = ""  # stage whose motion the controller gives up
        self.refuse = ""  # stage whose motion the controller does not begin
        self.unanswered = ""  # stage in whose motion the controller is started again before it answers
        self.camera_on = True
        self.camera_ahead = 0.0  # [s] its clock
        self.late = 0  # motions that will reach the controller too late
        self._arrival = 0.0
        self._ends: list[m.ExecuteRequest] = []

    @property
    def stamp(self) -> int:
        return int(self.now * 1e9)

    @property
    def status(self) -> OutlineStatus:
        return self.task.status

    def view(self) -> OutlineView:
        if self.camera_on and self.path is not None and self.q == HOME:
            stamp = self.stamp + int(self.camera_ahead * 1e9)
            self.path = self.path.model_copy(update={"header": m.Header(stamp=stamp, frame_id="world")})
        scene = m.PlanningScene(header=m.Header(stamp=self.stamp, frame_id="world"), objects=self.objects)
        tcp = m.Pose(position=m.Vector3(x=0.5, z=1.1))
        return OutlineView(self.now, scene, self.gripper, self.motion, list(self.q), tcp, path=self.path)

    def command(self, command: str) -> list[m.Message]:
        """Say something to the task; what it asks for is answered."""
        asked: list[m.Message] = list(self.task.command(command, self.view()))
        for request in asked:
            self.answer(request)
        return asked

    def step(self) -> list[m.Message]:
        self.now += 0.1
        if self.motion.held:
            self._arrival += 0.1
        elif self._ends and self.now >= self._arrival:
            self._arrive(self._ends.pop())
        asked: list[m.Message] = list(self.task.step(self.view()))
        for request in asked:
            self.answer(request)
        return asked

    def answer(self, request: m.Message) -> None:
        self.requests.append(request)
        header = m.Header(stamp=self.stamp)
        if isinstance(request, m.PlanRequest):
            error = self.unplannable(request)
            end = HOME if isinstance(request.goal, m.JointGoal) else AWAY
            points = [
                m.JointTrajectoryPoint(time_from_start=t, positions=q, velocities=[0.0] * 6, accelerations=[0.0] * 6)
                for t, q in ((0.0, request.start or self.q), (1.0, end))
            ]
            trajectory = m.JointTrajectory(header=m.Header(frame_id=request.stage), joint_names=ROBOT.joints,
                                           points=points)
            self.task.on_plan(m.PlanResponse(
                id=request.id, ok=not error, trajectory=None if error else trajectory, error=error,
                message=error and f"{request.stage}: {error}", planner="double", seconds=0.01,
                fraction=0.5 if error else self.fraction, colliding=self.colliding if error else None), self.view())
        elif isinstance(request, m.ExecuteRequest) and request.trajectory.header.frame_id == self.refuse:
            self.task.on_goal(m.MotionStatus(id=request.id, state="rejected", message="no"), self.view())
        elif isinstance(request, m.ExecuteRequest) and self.late:
            self.late -= 1
            refused = m.MotionStatus(id=request.id, state="rejected", error="stale_request", message="it is 10 s old")
            self.task.on_goal(refused, self.view())
        elif isinstance(request, m.ExecuteRequest) and request.trajectory.header.frame_id == self.unanswered:
            self.unanswered, self.q = "", [0.3, *HOME[1:]]  # restarted after its start, asked again
            self.restart_controller()
            refused = m.MotionStatus(id=request.id, state="rejected", error="start_mismatch", message="it is elsewhere")
            self.task.on_goal(refused, self.view())
        elif isinstance(request, m.ExecuteRequest):
            self.motion = m.MotionStatus(header=header, id=request.id, state="active", held=self.motion.held)
            self.q = [0.3, *HOME[1:]]
            self.task.on_goal(self.motion, self.view())
            self._ends.append(request)
            self._arrival = self.now + 0.45
        elif isinstance(request, m.GripperCommand):
            self.gripper = m.GripperState(header=header, id=request.id, state="succeeded", width=request.width)
            self.task.on_goal(self.gripper, self.view())
        elif isinstance(request, m.StopRequest):
            if self.motion.state == "active":
                self._ends.clear()
                self.motion = self.motion.model_copy(update={"header": header, "state": "cancelled"})
        elif isinstance(request, m.HoldRequest):
            self.motion = self.motion.model_copy(update={"header": header, "held": request.hold})

    def _arrive(self, request: m.ExecuteRequest) -> None:
        state, message = "succeeded", ""
        if request.trajectory.header.frame_id == self.abort:
            state, message, self.abort = "aborted", "path tolerance", ""
        else:
            self.q = list(request.trajectory.points[-1].positions)
        self.motion = m.MotionStatus.model_validate(
            {"header": m.Header(stamp=self.stamp), "id": request.id, "state": state, "message": message})

    def restart_controller(self) -> None:
        """Restart the controller: it knows no motion; the arm stays where it is."""
        self._ends.clear()
        self.motion = m.MotionStatus(header=m.Header(stamp=self.stamp + 1))

    def until(self, *wanted: str, most: int = 2000) -> None:
        """Step until the task is in one of these states or stages."""
        for _ in range(most):
            self.step()
            if {self.status.state, self.status.stage} & set(wanted):
                return
        raise AssertionError(f"never {wanted}: {self.status}")

    def plans(self) -> list[m.PlanRequest]:
        return [r for r in self.requests if isinstance(r, m.PlanRequest)]

    def moves(self) -> list[str]:
        """Stages of the motions that were executed, in order."""
        return [r.trajectory.header.frame_id for r in self.requests if isinstance(r, m.ExecuteRequest)]
