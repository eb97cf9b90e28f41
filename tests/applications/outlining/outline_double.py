"""A fake outlining cell without a network."""

from __future__ import annotations

from applications.outlining.task import Config, Outline, OutlineView
from applications.outlining.topics import OutlinePoints, OutlineStatus
from common import messages as m
from common.config import RobotConfig, Run, check, find_file, read_robot
from tests.common.tasks.task_double import TaskDouble

ROBOT = check(RobotConfig, read_robot(find_file("robots", "ur5")))
HOME = ROBOT.named_poses["home"]
AWAY = [0.5, *HOME[1:]]
ON_THE_WAY = [0.3, *HOME[1:]]
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


class OutlineDouble(TaskDouble):
    """A detected cube; motions end where their plan does."""

    def __init__(self, started: bool = True, **parameters: object) -> None:
        run = Run(cell="ur5", autostart=started)
        config = Config.model_validate({"robot": ROBOT, "run": run} | parameters)
        super().__init__(Outline(config, OutlineStatus(), "t"), gripper_width=0.085)
        self.path: OutlinePoints | None = outline_of(SQUARE, self.stamp)
        self.objects = [prism("Object_1", 0.5, 0.0, 0.05), prism("Object_2", 0.5, 0.3, 0.02)]
        self.q = list(HOME)
        self.abort = ""  # stage whose motion the controller aborts
        self.refuse = ""  # stage whose motion the controller rejects
        self.unanswered = ""  # stage whose motion is interrupted by a controller restart before the answer

    @property
    def status(self) -> OutlineStatus:
        assert isinstance(self.task.status, OutlineStatus)
        return self.task.status

    def view(self) -> OutlineView:
        if self.camera_on and self.path is not None and self.q == HOME:
            stamp = self.stamp + int(self.camera_ahead * 1e9)
            self.path = self.path.model_copy(update={"header": m.Header(stamp=stamp, frame_id="world")})
        scene = m.PlanningScene(header=m.Header(stamp=self.stamp, frame_id="world"), objects=self.objects)
        tcp = m.Pose(position=m.Vector3(x=0.5, z=1.1))
        return OutlineView(self.now, scene, self.gripper, self.motion, list(self.q), tcp, path=self.path)

    def trajectory(self, request: m.PlanRequest) -> m.JointTrajectory:
        end = HOME if isinstance(request.goal, m.JointGoal) else AWAY
        points = [m.JointTrajectoryPoint(time_from_start=t, positions=q, velocities=[0.0] * 6, accelerations=[0.0] * 6)
                  for t, q in ((0.0, request.start or self.q), (1.0, end))]
        return m.JointTrajectory(header=m.Header(frame_id=request.stage), joint_names=ROBOT.joints, points=points)

    def execute(self, request: m.ExecuteRequest) -> m.MotionStatus:
        stage = request.trajectory.header.frame_id
        if stage == self.refuse:
            return m.MotionStatus(id=request.id, state="rejected", message="no")
        if stage == self.unanswered and not self.late:
            self.unanswered, self.q = "", ON_THE_WAY
            self.restart_controller()
            return m.MotionStatus(id=request.id, state="rejected", error="start_mismatch", message="it is elsewhere")
        self.q = self.q if self.late else ON_THE_WAY
        return super().execute(request)

    def grip(self, request: m.GripperCommand) -> m.GripperState:
        self.gripper = m.GripperState(header=self.header, id=request.id, state="succeeded", width=request.width)
        return self.gripper

    def arrive(self, request: m.ExecuteRequest) -> None:
        super().arrive(request)
        if request.trajectory.header.frame_id == self.abort:
            self.abort = ""
            self.motion = self.motion.model_copy(update={"state": "aborted", "message": "path tolerance"})
        else:
            self.q = list(request.trajectory.points[-1].positions)

    def restart_controller(self) -> None:
        """Restart the controller: it knows no motion; the arm stays where it is."""
        self.running.clear()
        self.motion = m.MotionStatus(header=m.Header(stamp=self.stamp + 1))

    def moves(self) -> list[str]:
        """Stages of the executed motions, in order."""
        return [r.trajectory.header.frame_id for r in self.requests if isinstance(r, m.ExecuteRequest)]
