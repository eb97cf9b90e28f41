"""All messages between services: SI units, quaternions x, y, z, w, names as in ROS where ROS has one.

All models refuse unknown fields and numbers that are not finite. A pose is that of the named object in
`header.frame_id`. Stamps are cell time in ns since the Unix epoch, taken once, when the frame is exposed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from common.messages.arms import ArmsStatus, ReserveReply, ReserveRequest
from common.messages.basics import (
    SCHEMA_VERSION,
    SELF_RELEASING,
    UNKNOWN_OPERATOR,
    Color,
    Finite,
    Fraction,
    Header,
    Message,
    Name,
    Pose,
    PoseArray,
    Positive,
    Quaternion,
    TFMessage,
    TransformStamped,
    Vector3,
)
from common.messages.camera import CameraInfo, Image, Marker, MarkerArray, PointCloud2, Rejection, Rejections
from common.messages.conveyor import BeltState, ConveyorSet, ConveyorState
from common.messages.execution import (
    CLOSED_BEFORE,
    ExecuteRequest,
    FollowedRequest,
    GoalState,
    GripperCommand,
    GripperState,
    Holder,
    HoldRequest,
    Interlock,
    JogCommand,
    MotionOwner,
    MotionStatus,
    OwnRequest,
    PlanFigure,
    StopRequest,
    TaskCommand,
    TaskStatus,
)
from common.messages.force import Wrench, ZeroWrench
from common.messages.force_motion import ForceMotion
from common.messages.io import IoReply, IoSet, IoSignal, IoState
from common.messages.planning import (
    AnyGoal,
    ArcGoal,
    Box,
    GoalSet,
    JointGoal,
    MovingGoal,
    PathConstraints,
    PathGoal,
    PlanAttempt,
    PlanRequest,
    PlanResponse,
    PoseGoal,
    SequenceGoal,
    SequenceItem,
)
from common.messages.processes import (
    LogLine,
    Notice,
    Parameter,
    ParameterReply,
    ParameterRequest,
    ServiceCounters,
    ServiceStatus,
    SupervisorStatus,
)
from common.messages.robot import (
    JointState,
    JointTrajectory,
    JointTrajectoryPoint,
    RobotCommand,
    RobotDescription,
    RobotMode,
    RobotStatus,
    SetPoints,
)
from common.messages.scene import (
    AttachedObject,
    CollisionObject,
    PlanningScene,
    SceneEdit,
    SceneEditReply,
    SceneUpdate,
    WorldEdit,
    WorldEditReply,
    WorldObject,
    WorldObjects,
)
