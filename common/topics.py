"""All keys of the platform with their messages and kinds. Applications add their own.

A key on the wire is `<cell>/<topic>`, for example `cell/camera/image_raw`. The services of the cell determine which one
writes it: `zencell topic info`. Each service has its own key for a topic that ends in `<service>`.
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

SERVICE = "<service>"  # in a key: the name of the service that writes or serves it


@dataclass(frozen=True)
class Topic(Generic[M]):
    """A published key.

    stream: readers get the newest message, older ones are dropped and counted. event: readers get all messages in
    order. state: a `get` returns the last message at any time, and it is repeated each second. A signed topic has a key
    for each service, which the message names in `service`: readers read all keys and refuse a message under another
    service's key.
    """

    key: str
    message: type[M]
    kind: PublishedKind
    doc: str
    former: InitVar[str | None] = None
    signed: bool = field(default=False, kw_only=True)
    plain: bool = field(default=True, kw_only=True)  # whether readers of a signed topic also read its former plain key
    commands: bool = field(default=False, kw_only=True)  # whether its messages make something move or switch

    @property
    def expression(self) -> str:
        """Key expression of all its keys, without the cell; of a signed topic with its former plain key."""
        return self.key.replace(f"/{SERVICE}", "/**" if self.plain else "/*")

    def __post_init__(self, former: str | None) -> None:
        _leave_out_writer(self, former)


@dataclass(frozen=True)
class Request(Generic[Q, A]):
    """A served key: a request of type `message` gets an `answer`."""

    key: str
    message: type[Q]
    answer: type[A]
    doc: str
    former: InitVar[str | None] = None
    kind: Literal["request"] = field(default="request", init=False)
    signed: Literal[False] = field(default=False, init=False)

    @property
    def expression(self) -> str:
        """Key expression of all its keys, without the cell."""
        return self.key.replace(SERVICE, "*")

    def __post_init__(self, former: str | None) -> None:
        _leave_out_writer(self, former)


def _leave_out_writer(topic: Topic[Any] | Request[Any, Any], former: str | None) -> None:
    """Accept the former signature, which named a writer before the description."""
    if former is not None:
        warnings.warn(f"{topic.key}: leave {topic.doc!r} out: a topic names no writer any more, the cell does",
                      DeprecationWarning, stacklevel=4)
        object.__setattr__(topic, "doc", former)


SCENE_OBJECT_UPDATES = Topic("scene_object_updates", m.SceneUpdate, "event",
                             "remove:ID when grasped, add:ID when at rest again")
CAMERA_IMAGE = Topic("camera/image_raw", m.Image, "stream", "camera image, 10 Hz")
CAMERA_INFO = Topic("camera/camera_info", m.CameraInfo, "state", "intrinsics of the camera")
PLANNING_SCENE = Topic("planning_scene", m.PlanningScene, "state",
                       "fixtures and perceived objects with ids, attached object, allowed collisions")
JOINT_STATES = Topic("joint_states", m.JointState, "stream", "joint positions, 100 Hz")
SET_POINTS = Topic("motion/set_points", m.SetPoints, "stream",
                   "commanded positions and gripper width, 100 Hz; only while there is a subscriber, as a recorder")
TF = Topic("tf", m.TFMessage, "stream", "poses of the robot's links")
TF_STATIC = Topic("tf_static", m.TFMessage, "state", "constant poses: base, camera")
WRENCH = Topic("robot/wrench", m.Wrench, "stream",
               "force and torque that the environment exerts on the tool, 100 Hz; why there is none, 1 Hz")
GRIPPER_STATE = Topic("gripper/state", m.GripperState, "state", "width, whether it holds an object, newest command")
MOTION_STATUS = Topic("motion/status", m.MotionStatus, "state", "newest goal: state, progress, error, source")
MOTION_OWNER = Topic("motion/owner", m.MotionOwner, "state", "current owner of motion: motions of others are refused")
MOTION_JOG = Topic("motion/jog", m.JogCommand, "stream",
                   "velocities of joints or tool: the arm moves while they are repeated, at least every 0.1 s; "
                   "any client writes it", commands=True)
ROBOT_STATUS = Topic("robot/status", m.RobotStatus, "state",
                     "state of the arm's own controller: mode, why it cannot move, speed slider")
ROBOT_DESCRIPTION = Topic("robot/description", m.RobotDescription, "state",
                          "the arm: joints, limits, named poses, tool frame")
IO_STATE = Topic("io/state", m.IoState, "state", "inputs and outputs: value, time of its change, quality")
IO_SENSED = Topic("io/sensed", m.IoState, "state",
                  "signals that the simulated world determines, as of a vacuum switch; simulated hardware only")
ARMS_STATUS = Topic("arms/status", m.ArmsStatus, "state", "motions of several arms: queue, holds")
CONVEYOR_STATE = Topic("conveyor/state", m.ConveyorState, "state", "belts: encoder, speed, light barrier, 50 Hz")
DISPLAY_TRAJECTORY = Topic("display_trajectory", m.JointTrajectory, "state", "newest plan")
SCENE_OBJECTS = Topic("scene_objects", m.WorldObjects, "state",
                      "ground truth: poses of all objects; simulated hardware only")
DEPTH_CAMERA_IMAGE = Topic("depth_camera/image_raw", m.Image, "stream", "color image")
DEPTH_CAMERA_DEPTH = Topic("depth_camera/depth/image_raw", m.Image, "stream",
                           "depth along the optical axis [m], 32FC1, NaN where unknown")
DEPTH_CAMERA_POINTS = Topic("depth_camera/points", m.PointCloud2, "stream",
                            "colored points, only while there is a subscriber")
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
MOTION_FOLLOWED = Request("motion/followed", m.FollowedRequest, m.ExecuteRequest, "the goal that is being followed")
MOTION_FORCE = Request("motion/force", m.ForceMotion, m.MotionStatus,
                       "move by the wrench at the tool: until contact, compliant, insert; the result appears on "
                       "motion/status")
MOTION_STOP = Request("motion/stop", m.StopRequest, m.MotionStatus, "bring the robot to rest")
MOTION_HOLD = Request("motion/hold", m.HoldRequest, m.MotionStatus, "hold the robot on its path, or release it")
MOTION_OWN = Request("motion/own", m.OwnRequest, m.MotionOwner, "take the ownership of motion, or give it back")
GRIPPER_COMMAND = Request("gripper/command", m.GripperCommand, m.GripperState,
                          "move the fingers; the result appears on gripper/state")
ROBOT_COMMAND = Request("robot/command", m.RobotCommand, m.RobotStatus,
                        "enable, recover, freedrive, payload, output: commands to the arm's own controller")
WRENCH_ZERO = Request("robot/zero_wrench", m.ZeroWrench, m.Wrench,
                      "take the present wrench as zero; only while the arm is at rest")
RESERVE = Request("arms/reserve", m.ReserveRequest, m.ReserveReply,
                  "permission to move next to the other arms of the cell")
IO_SET = Request("io/set", m.IoSet, m.IoReply, "set a digital or analog output")
CONVEYOR_SET = Request("conveyor/set", m.ConveyorSet, m.ConveyorState, "start or stop a belt, or change its speed")
SCENE_EDIT = Request("scene/edit", m.SceneEdit, m.SceneEditReply,
                     "add a solid that no camera perceives to the planning scene, or remove it")
WORLD_EDIT = Request("world/edit", m.WorldEdit, m.WorldEditReply, "add, move, remove, reset; simulated hardware only")
TASK_COMMAND = Request("task/command", m.TaskCommand, m.TaskStatus, "start, pause, resume or stop the task")
PARAMETERS = Request("param/<service>", m.ParameterRequest, m.ParameterReply,
                     "read the parameters of a service, and change them while it runs")

AnyTopic = Topic[m.Message] | Request[m.Message, m.Message]


def parameters_of(service: str) -> Request[m.ParameterRequest, m.ParameterReply]:
    """Return the request that a service serves for its parameters."""
    return of_service(PARAMETERS, service)


def of_service(topic: T, service: str) -> T:
    """Return a topic or request under the key of one service; unchanged if all services share one key."""
    return replace(topic, key=topic.key.replace(SERVICE, service)) if SERVICE in topic.key else topic


def general_key(key: str) -> str:
    """Return `log/<service>` for the key of a service and for the former `log`; other keys unchanged."""
    first, _, service = key.partition("/")
    found = _PER_SERVICE.get(first)
    return found.key if found is not None and (service.isidentifier() or (found.signed and not service)) else key


_PER_SERVICE: dict[str, Topic[Any] | Request[Any, Any]] = {
    topic.key.partition("/")[0]: topic for topic in (LOG, COUNTERS, PARAMETERS)
}


def platform_topics() -> dict[str, AnyTopic]:
    """Return every topic of this file by key, in its order."""
    return {value.key: value for value in globals().values() if isinstance(value, Topic | Request)}
