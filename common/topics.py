"""Every key that the platform knows, said once: its message and its kind. Applications add their own.

A key on the wire is `<cell>/<topic>`, for example `cell/camera/image_raw`. Who writes it follows from
the services of the cell: `zencell topic info`. What ends in `<service>` each service has for itself.
"""

from __future__ import annotations

import warnings
from dataclasses import InitVar, dataclass, field, replace
from typing import Any, Generic, Literal, TypeVar

from common import messages as m

Kind = Literal["stream", "event", "state", "request"]
PublishedKind = Literal["stream", "event", "state"]
M = TypeVar("M", bound=m.Message)
Q = TypeVar("Q", bound=m.Message)
A = TypeVar("A", bound=m.Message)
T = TypeVar("T", bound="Topic[Any] | Request[Any, Any]")

SERVICE = "<service>"  # in a key: the name of whoever writes or serves it


@dataclass(frozen=True)
class Topic(Generic[M]):
    """A key that is published.

    stream: the newest counts, older ones are dropped and counted; event: every one counts, in order; state: the
    last value can be asked for at any time and is repeated each second. A signed one has a key for each service, and
    `service` of its message says whose it is: readers read all of them and refuse what comes under another's key.
    """

    key: str
    message: type[M]
    kind: PublishedKind
    doc: str
    former: InitVar[str | None] = None
    signed: bool = field(default=False, kw_only=True)
    plain: bool = field(default=True, kw_only=True)  # whether readers of a signed one read its plain key of before too

    @property
    def expression(self) -> str:
        """Key expression that covers it, without the cell; of a signed one also the plain key that it had before."""
        return self.key.replace(f"/{SERVICE}", "/**" if self.plain else "/*")

    def __post_init__(self, former: str | None) -> None:
        _leave_out_writer(self, former)


@dataclass(frozen=True)
class Request(Generic[Q, A]):
    """A key that answers: a request of type `message` gets an `answer`."""

    key: str
    message: type[Q]
    answer: type[A]
    doc: str
    former: InitVar[str | None] = None
    kind: Literal["request"] = field(default="request", init=False)
    signed: Literal[False] = field(default=False, init=False)

    @property
    def expression(self) -> str:
        """Key expression that covers it, without the cell."""
        return self.key.replace(SERVICE, "*")

    def __post_init__(self, former: str | None) -> None:
        _leave_out_writer(self, former)


def _leave_out_writer(topic: Topic[Any] | Request[Any, Any], former: str | None) -> None:
    """Take the form of before, which named a writer ahead of the description: who writes is for the cell to say."""
    if former is not None:
        warnings.warn(f"{topic.key}: leave {topic.doc!r} out: a topic names no writer any more, the cell does",
                      DeprecationWarning, stacklevel=4)
        object.__setattr__(topic, "doc", former)


SCENE_OBJECT_UPDATES = Topic("scene_object_updates", m.SceneUpdate, "event",
                             "remove:ID when grasped, add:ID when it lies still again")
CAMERA_IMAGE = Topic("camera/image_raw", m.Image, "stream", "what the camera sees, 10 Hz")
CAMERA_INFO = Topic("camera/camera_info", m.CameraInfo, "state", "intrinsics of the camera")
PLANNING_SCENE = Topic("planning_scene", m.PlanningScene, "state",
                       "fixtures and perceived objects with ids, attached object, allowed collisions")
JOINT_STATES = Topic("joint_states", m.JointState, "stream", "joint positions, 100 Hz")
TF = Topic("tf", m.TFMessage, "stream", "poses of the robot's links")
TF_STATIC = Topic("tf_static", m.TFMessage, "state", "poses that never change: base, camera")
GRIPPER_STATE = Topic("gripper/state", m.GripperState, "state", "width, whether it holds something, newest command")
MOTION_STATUS = Topic("motion/status", m.MotionStatus, "state", "newest goal: state, progress, error, source")
MOTION_OWNER = Topic("motion/owner", m.MotionOwner, "state", "whose the motion is: nobody else's begins")
MOTION_JOG = Topic("motion/jog", m.JogCommand, "stream",
                   "velocities of joints or tool: the arm moves while they come, at least every 0.1 s; anybody's key")
ROBOT_STATUS = Topic("robot/status", m.RobotStatus, "state",
                     "what the arm's own controller says: mode, why it cannot be moved, speed slider")
ROBOT_DESCRIPTION = Topic("robot/description", m.RobotDescription, "state",
                          "what the arm is: joints, limits, named poses, tool frame")
DISPLAY_TRAJECTORY = Topic("display_trajectory", m.JointTrajectory, "state", "newest plan")
SCENE_OBJECTS = Topic("scene_objects", m.WorldObjects, "state",
                      "the truth: where every object is; simulated hardware only")
DEPTH_CAMERA_IMAGE = Topic("depth_camera/image_raw", m.Image, "stream", "colour picture")
DEPTH_CAMERA_DEPTH = Topic("depth_camera/depth/image_raw", m.Image, "stream",
                           "depth along the optical axis [m], 32FC1, NaN where there is none")
DEPTH_CAMERA_POINTS = Topic("depth_camera/points", m.PointCloud2, "stream",
                            "coloured points, only while somebody listens")
DEPTH_CAMERA_INFO = Topic("depth_camera/camera_info", m.CameraInfo, "state", "intrinsics")
SUPERVISOR_STATUS = Topic("supervisor/status", m.SupervisorStatus, "state", "all processes")
LOG = Topic("log/<service>", m.LogLine, "event", "log lines of a service; all of them: `topic echo log`; "
                                                 "deprecated: the supervisor repeats them under `log`", signed=True)
COUNTERS = Topic("counters/<service>", m.ServiceCounters, "state",
                 "received, dropped and refused messages of a service, each second; "
                 "deprecated: the supervisor repeats them under `counters`", signed=True)

MOTION_PLAN = Request("motion/plan", m.PlanRequest, m.PlanResponse, "plan a trajectory")
MOTION_EXECUTE = Request("motion/execute", m.ExecuteRequest, m.MotionStatus,
                         "follow a trajectory; the result appears on motion/status")
MOTION_FOLLOWED = Request("motion/followed", m.FollowedRequest, m.ExecuteRequest, "what the goal is that is followed")
MOTION_STOP = Request("motion/stop", m.StopRequest, m.MotionStatus, "bring the robot to rest")
MOTION_HOLD = Request("motion/hold", m.HoldRequest, m.MotionStatus, "pause the robot on its path, or let it go on")
MOTION_OWN = Request("motion/own", m.OwnRequest, m.MotionOwner, "take the motion of the robot, or give it back")
GRIPPER_COMMAND = Request("gripper/command", m.GripperCommand, m.GripperState,
                          "move the fingers; the result appears on gripper/state")
ROBOT_COMMAND = Request("robot/command", m.RobotCommand, m.RobotStatus,
                        "enable, recover, freedrive, payload, output: what the arm's own controller does beside motion")
SCENE_EDIT = Request("scene/edit", m.SceneEdit, m.SceneEditReply,
                     "add a solid that nobody perceives to the planning scene, or remove it")
WORLD_EDIT = Request("world/edit", m.WorldEdit, m.WorldEditReply, "add, move, remove, reset; simulated hardware only")
TASK_COMMAND = Request("task/command", m.TaskCommand, m.TaskStatus, "start, pause, resume or stop the task")
PARAMETERS = Request("param/<service>", m.ParameterRequest, m.ParameterReply,
                     "parameters of a service: what there is, and changing it while it runs")

AnyTopic = Topic[m.Message] | Request[m.Message, m.Message]


def parameters_of(service: str) -> Request[m.ParameterRequest, m.ParameterReply]:
    """The request that a service answers for its own parameters."""
    return of_service(PARAMETERS, service)


def of_service(topic: T, service: str) -> T:
    """A topic or request under the key of one service; as it is where all have the same."""
    return replace(topic, key=topic.key.replace(SERVICE, service)) if SERVICE in topic.key else topic


def general_key(key: str) -> str:
    """`log/<service>` for that of a service, or for plain `log`, as it was called before; other keys as they are."""
    first, _, service = key.partition("/")
    found = _OF_EACH.get(first)
    return found.key if found is not None and (service.isidentifier() or (found.signed and not service)) else key


_OF_EACH: dict[str, Topic[Any] | Request[Any, Any]] = {
    topic.key.partition("/")[0]: topic for topic in (LOG, COUNTERS, PARAMETERS)
}


def platform_topics() -> dict[str, AnyTopic]:
    """Every topic of this file by key, in its order."""
    return {value.key: value for value in globals().values() if isinstance(value, Topic | Request)}
