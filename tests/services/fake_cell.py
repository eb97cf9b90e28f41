"""A fake cell around services under test: camera, arm, gripper, planner and executor on a network without ports."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Sequence
from contextlib import AbstractAsyncContextManager
from types import ModuleType
from typing import Any

import numpy.typing as npt

from common import messages as m
from common import topics
from common.clock import Clock
from common.config import RobotConfig
from common.errors import Refused
from common.perception.image import array_to_image
from common.perception.pinhole import Pinhole
from common.process.in_process import running_service
from common.robot.transforms import matrix_to_pose
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from common.transport.reader import Reader

PATIENCE = 20.0  # [s]


def name_of(module: ModuleType) -> str:
    """Return the name of a service in a cell file."""
    return module.__name__.rpartition(".")[2]


async def until(reader: Reader[Any], wanted: Callable[[Any], object] = lambda _: True) -> Any:
    """Return the next message that satisfies a condition."""
    async with asyncio.timeout(PATIENCE):
        while not wanted(message := await reader.next()):
            pass
        return message


async def latest(reader: Reader[Any], wanted: Callable[[Any], object] = lambda _: True) -> Any:
    """Return the newest message if it satisfies a condition, otherwise the next one that does."""
    return reader.latest if reader.latest is not None and wanted(reader.latest) else await until(reader, wanted)


async def settle() -> None:
    """Let services take the messages that were just published."""
    for _ in range(20):
        await asyncio.sleep(0)


def camera_transform(camera: Pinhole, frame: str) -> m.TFMessage:
    """Return the pose of a camera in world."""
    header, pose = m.Header(frame_id="world"), matrix_to_pose(camera.T_world_optical)
    return m.TFMessage(transforms=[m.TransformStamped(header=header, child_frame_id=frame, transform=pose)])


def at(x: float, y: float, z: float) -> m.Pose:
    """Return a pose without rotation."""
    return m.Pose(position=m.Vector3(x=x, y=y, z=z))


def ball(name: str, x: float, y: float, z: float = 0.03) -> m.CollisionObject:
    """Return a target, by default on the table."""
    return m.CollisionObject(id=name, role="target", shape="sphere", dimensions=[0.03], pose=at(x, y, z))


def trajectory(joints: Sequence[str], *times: float) -> m.JointTrajectory:
    """Return a trajectory of all joints, whose positions [rad] are the times [s]."""
    zeros = [0.0] * len(joints)
    return m.JointTrajectory(joint_names=list(joints), points=[m.JointTrajectoryPoint(
        time_from_start=t, positions=[t] * len(joints), velocities=zeros, accelerations=zeros) for t in times])


class FakeCell:
    """The neighbours of a service: publishes what they publish, and answers what they serve."""

    def __init__(self, clock: Clock | None = None, net: LocalNetwork | None = None) -> None:
        self.net, self.clock = net or LocalNetwork(), clock or Clock()
        self.bus = self.net.bus("tester", clock=self.clock)
        self.reader = self.bus.reader
        self.client = self.bus.client
        self._writers: dict[str, Any] = {}

    def running(
        self, module: ModuleType, config: Any, run: Callable[..., Awaitable[None]] | None = None
    ) -> AbstractAsyncContextManager[Bus]:
        """Run a service under its own name."""
        return running_service(self.net, run or module.run, config, name=name_of(module), clock=self.clock)

    def put(self, topic: topics.Topic[Any], message: m.Message) -> None:
        """Publish a message."""
        if topic.key not in self._writers:
            self._writers[topic.key] = self.bus.writer(topic)
        self._writers[topic.key].put(message)

    def calibrate(self, camera: Pinhole, frame: str, info: topics.Topic[m.CameraInfo] = topics.CAMERA_INFO) -> None:
        """Publish intrinsics and pose of a camera."""
        self.put(topics.TF_STATIC, camera_transform(camera, frame))
        self.put(info, camera.info(self.bus.header(frame)))

    def put_image(
        self, topic: topics.Topic[m.Image], pixels: npt.NDArray[Any], encoding: str, stamp: int, frame: str
    ) -> None:
        """Publish an image."""
        self.put(topic, array_to_image(pixels, encoding, m.Header(stamp=stamp, frame_id=frame)))

    def put_joints(self, names: Sequence[str], q: Iterable[float], stamp: int | None = None) -> None:
        """Publish joint positions of now, or of a time [ns]."""
        header = self.bus.header() if stamp is None else m.Header(stamp=stamp)
        self.put(topics.JOINT_STATES, m.JointState(header=header, name=list(names), position=list(q)))

    def put_robot(
        self, robot: RobotConfig, *objects: m.CollisionObject, width: float = 0.0, age: float = 0.0
    ) -> m.Header:
        """Publish an arm at home with its gripper and planning scene, and return their header, of some age [s]."""
        header = m.Header(stamp=self.clock.now_ns() - int(age * 1e9), frame_id="world")
        self.put(topics.GRIPPER_STATE, m.GripperState(header=header, width=width))
        self.put(topics.MOTION_STATUS, m.MotionStatus(header=header))
        self.put_joints(robot.joints, robot.named_poses["home"], header.stamp)
        self.put(topics.PLANNING_SCENE, m.PlanningScene(header=header, objects=list(objects)))
        return header

    def serve_planner(
        self, found: Callable[[m.PlanRequest], m.JointTrajectory] | m.JointTrajectory | None = None,
        error: str = "no_ik", unreachable: str = "", **fields: Any,
    ) -> asyncio.Queue[m.PlanRequest]:
        """Answer plan requests with a trajectory, or with an error in one stage; return the queue of requests.

        Args:
            found: the trajectory, or a function of the request; None: the error.
            error: code of the error; no_scene: the request is refused.
            unreachable: stage whose requests fail.
            fields: of the response.
        """
        asked: asyncio.Queue[m.PlanRequest] = asyncio.Queue()

        async def plan(request: m.PlanRequest) -> m.PlanResponse:
            asked.put_nowait(request)
            if error == "no_scene":
                raise Refused(error, "no planning scene received yet")
            if found is None or (unreachable and request.stage == unreachable):
                failed = {"id": request.id, "ok": False, "error": error, "message": "not today", **fields}
                return m.PlanResponse.model_validate(failed)
            way = found(request) if callable(found) else found
            return m.PlanResponse(id=request.id, ok=True, trajectory=way, fraction=1.0, **fields)

        self.bus.serve(topics.MOTION_PLAN, plan)
        return asked

    def serve_executor(self, state: str = "rejected") -> asyncio.Queue[m.ExecuteRequest]:
        """Answer every trajectory with a state, and return the queue of requests."""
        asked: asyncio.Queue[m.ExecuteRequest] = asyncio.Queue()

        async def execute(request: m.ExecuteRequest) -> m.MotionStatus:
            asked.put_nowait(request)
            return m.MotionStatus.model_validate({"id": request.id, "state": state, "message": "not today"})

        self.bus.serve(topics.MOTION_EXECUTE, execute)
        return asked
