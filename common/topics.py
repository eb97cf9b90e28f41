"""Every key that the platform knows, said once: its message, its kind and who writes it. Applications add their own.

A key on the wire is `<cell>/<topic>`, for example `panda/camera/image_raw`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Generic, Literal, TypeVar

from common import messages as m
from common.moved import moved_to_applications

Kind = Literal["stream", "event", "state", "request"]
PublishedKind = Literal["stream", "event", "state"]
M = TypeVar("M", bound=m.Message)
Q = TypeVar("Q", bound=m.Message)
A = TypeVar("A", bound=m.Message)


@dataclass(frozen=True)
class Topic(Generic[M]):
    """A key that is published.

    stream: the newest counts, older ones are dropped and counted; event: every one counts, in order; state: the
    last value can be asked for at any time and is repeated each second.
    """

    key: str
    message: type[M]
    kind: PublishedKind
    writer: str
    doc: str

    @property
    def writers(self) -> list[str]:
        """Services that write it, of which a cell has one."""
        return self.writer.split(", ")


@dataclass(frozen=True)
class Request(Generic[Q, A]):
    """A key that answers: a request of type `message` gets an `answer`."""

    key: str
    message: type[Q]
    answer: type[A]
    writer: str
    doc: str
    kind: Literal["request"] = "request"

    @property
    def writers(self) -> list[str]:
        """Services that answer it, of which a cell has one."""
        return self.writer.split(", ")


SCENE_OBJECT_UPDATES = Topic("scene_object_updates", m.SceneUpdate, "event", "trajectory_executor",
                             "remove:ball_3 when grasped, add:ball_3 when it lies still again")
CAMERA_IMAGE = Topic("camera/image_raw", m.Image, "stream", "camera_simulator", "what the camera sees, 10 Hz")
CAMERA_INFO = Topic("camera/camera_info", m.CameraInfo, "state", "camera_simulator", "intrinsics of the camera")
PLANNING_SCENE = Topic("planning_scene", m.PlanningScene, "state", "scene_manager, outline_scene",
                       "fixtures and perceived objects with ids, attached object, allowed collisions")
JOINT_STATES = Topic("joint_states", m.JointState, "stream", "trajectory_executor", "joint positions, 100 Hz")
TF = Topic("tf", m.TFMessage, "stream", "robot_state_publisher", "poses of the robot's links")
TF_STATIC = Topic("tf_static", m.TFMessage, "state", "robot_state_publisher", "poses that never change: base, camera")
GRIPPER_STATE = Topic("gripper/state", m.GripperState, "state", "trajectory_executor",
                      "width, whether it holds something, newest command")
MOTION_STATUS = Topic("motion/status", m.MotionStatus, "state", "trajectory_executor",
                      "newest goal: state, progress, error, source")
DISPLAY_TRAJECTORY = Topic("display_trajectory", m.JointTrajectory, "state", "motion_planner", "newest plan")
SCENE_OBJECTS = Topic("scene_objects", m.WorldObjects, "state", "trajectory_executor",
                      "the truth: where every object is; simulated hardware only")
DEPTH_CAMERA_IMAGE = Topic("depth_camera/image_raw", m.Image, "stream", "depth_camera", "colour picture")
DEPTH_CAMERA_DEPTH = Topic("depth_camera/depth/image_raw", m.Image, "stream", "depth_camera",
                           "depth along the optical axis [m], 32FC1, NaN where there is none")
DEPTH_CAMERA_POINTS = Topic("depth_camera/points", m.PointCloud2, "stream", "depth_camera",
                            "coloured points, only while somebody listens")
DEPTH_CAMERA_INFO = Topic("depth_camera/camera_info", m.CameraInfo, "state", "depth_camera", "intrinsics")
SUPERVISOR_STATUS = Topic("supervisor/status", m.SupervisorStatus, "state", "supervisor", "all processes")
LOG = Topic("log", m.LogLine, "event", "everyone", "log lines")
COUNTERS = Topic("counters", m.ServiceCounters, "event", "everyone",
                 "received, dropped and refused messages of each service, each second")

MOTION_PLAN = Request("motion/plan", m.PlanRequest, m.PlanResponse, "motion_planner", "plan a trajectory")
MOTION_EXECUTE = Request("motion/execute", m.ExecuteRequest, m.MotionStatus, "trajectory_executor",
                         "follow a trajectory; the result appears on motion/status")
MOTION_STOP = Request("motion/stop", m.StopRequest, m.MotionStatus, "trajectory_executor", "bring the robot to rest")
MOTION_HOLD = Request("motion/hold", m.HoldRequest, m.MotionStatus, "trajectory_executor",
                      "pause the robot on its path, or let it go on")
GRIPPER_COMMAND = Request("gripper/command", m.GripperCommand, m.GripperState, "trajectory_executor",
                          "move the fingers; the result appears on gripper/state")
WORLD_EDIT = Request("world/edit", m.WorldEdit, m.WorldEditReply, "trajectory_executor",
                     "add, move, remove, reset; simulated hardware only")
TASK_COMMAND = Request("task/command", m.TaskCommand, m.TaskStatus, "smart_pick_place, contour_tracer",
                       "start, pause, resume or stop the task")
PARAMETERS = Request("param/<service>", m.ParameterRequest, m.ParameterReply, "everyone",
                     "parameters of a service: what there is, and changing it while it runs")

AnyTopic = Topic[m.Message] | Request[m.Message, m.Message]


def parameters_of(service: str) -> Request[m.ParameterRequest, m.ParameterReply]:
    """The request that a service answers for its own parameters."""
    return replace(PARAMETERS, key=f"param/{service}", writer=service)


def platform_topics() -> dict[str, AnyTopic]:
    """Every topic of this file by key, in its order."""
    return {value.key: value for value in globals().values() if isinstance(value, Topic | Request)}


if not TYPE_CHECKING:  # which would take any name for one that is there
    __getattr__ = moved_to_applications(__name__, "topics")
