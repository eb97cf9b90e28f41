"""Obstacles of the planner: camera points for plans, and a hold while an object obstructs the running motion."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

from common import topics
from common.config import RobotConfig
from common.errors import Refused, RemoteError, RequestFailed
from common.messages import CameraInfo, FollowedRequest, HoldRequest, Image, MotionStatus, PlanningScene, PointCloud2
from common.planning.camera_obstacles import Camera, CameraMessages, CameraObstacles, JointHistory, PointsOptions
from common.planning.point_obstacles import PointObstacle
from common.planning.robot_geometry import RobotGeometry
from common.planning.scene_monitor import NotMonitored, SceneMonitor
from common.robot.model import RobotModel
from common.transport.bus import Bus
from common.transport.reader import Reader


class ObstacleReader:
    """The newest messages of each camera, and the joint positions of the last seconds."""

    _obstacles: CameraObstacles  # set by `load`
    _joints: JointHistory

    def __init__(self, bus: Bus, options: PointsOptions) -> None:
        self._bus, self._options = bus, options
        self._readers = [_readers(bus, camera) for camera in options.cameras]
        self._poses, self._states = bus.reader(topics.TF_STATIC), bus.reader(topics.JOINT_STATES)

    def load(self, robot: RobotModel, geometry: RobotGeometry) -> None:
        """Set the robot, whose model the functions of `snapshot` use."""
        self._obstacles = CameraObstacles(robot, geometry, self._options)
        self._joints = JointHistory(robot)

    async def follow(self) -> None:
        """Record joint states until cancelled."""
        async for state in self._states:
            self._joints.add(state)

    def snapshot(self, scene: PlanningScene, stage: str) -> Callable[[], list[PointObstacle]]:
        """Return a function for a thread that computes the obstacles of the messages received until now.

        The function raises Refused with the stage and the reason if the messages of a camera cannot be used.
        """
        now, poses = self._bus.clock.now_ns(), self._poses.latest
        seen = [
            CameraMessages(camera, images.latest, None if infos is None else infos.latest)
            for camera, (images, infos) in zip(self._options.cameras, self._readers, strict=True)
        ]

        def obstacles() -> list[PointObstacle]:
            try:
                return self._obstacles.obstacles(seen, poses, self._joints, scene, now)
            except Refused as error:
                raise Refused(error.code, f"{stage}: {error}") from None

        return obstacles


def _readers(
    bus: Bus, camera: Camera
) -> tuple[Reader[PointCloud2] | Reader[Image], Reader[CameraInfo] | None]:
    if camera.points:
        return bus.reader(replace(topics.DEPTH_CAMERA_POINTS, key=camera.points)), None
    depths = bus.reader(replace(topics.DEPTH_CAMERA_DEPTH, key=camera.depth))
    return depths, bus.reader(replace(topics.DEPTH_CAMERA_INFO, key=camera.info))


HOLDER: Literal["scene_monitor"] = "scene_monitor"
REQUEST_TIMEOUT = 0.2  # [s] wall; the request is repeated after that
RETRY_DELAY = 0.05  # [s] wall


class ObstructionWatchdog:
    """Checks the running motion on every scene message, and requests a hold from the executor or releases it.

    It computes on the event loop, for about a millisecond if an object has moved; planning runs in threads.
    """

    monitor: SceneMonitor  # set by `load`

    def __init__(self, bus: Bus, scenes: Reader[PlanningScene]) -> None:
        self._bus, self._scenes, self._motion = bus, scenes, bus.reader(topics.MOTION_STATUS)
        self._hold, self._followed = bus.client(topics.MOTION_HOLD), bus.client(topics.MOTION_FOLLOWED)
        self._changed = asyncio.Event()
        self._answer: MotionStatus | None = None  # to the newest hold request

    async def load(self, robot: RobotConfig, padding: float) -> None:
        """Load the robot; new perceived objects get `padding` [m] more distance."""
        self.monitor = await asyncio.to_thread(SceneMonitor, robot, padding)

    async def run(self) -> None:
        """Check until cancelled."""
        async with asyncio.TaskGroup() as group:
            for reader in (self._scenes, self._motion):
                group.create_task(self._trigger_on(reader))
            while True:
                await self._changed.wait()
                self._changed.clear()
                try:
                    await self._check()
                except NotMonitored as error:
                    self._bus.log.warning("the running motion is not checked for obstructions: %s", error)
                except RequestFailed as error:
                    self._bus.log.warning("%s", error)
                    group.create_task(self._retry())

    async def _trigger_on(self, reader: Reader[Any]) -> None:
        async for _ in reader:
            self._changed.set()

    async def _retry(self) -> None:
        await asyncio.sleep(RETRY_DELAY)
        self._changed.set()

    async def _check(self) -> None:
        status, scene = self._motion.latest, self._scenes.latest
        if status is not None and self._answer is not None and self._answer.header.stamp > status.header.stamp:
            status = self._answer
        if status is None or scene is None or status.state != "active" or not status.id:
            self.monitor.unfollow()
            return
        if status.id != self.monitor.goal:
            await self._follow(status)
        problem, held = self.monitor.find_obstruction(scene, status.progress), HOLDER in status.held_by
        if bool(problem) == held:
            return
        request = HoldRequest(hold=bool(problem), reason=problem, by=HOLDER, goal=status.id)
        self._answer = await self._hold.call(request, REQUEST_TIMEOUT)
        if problem and HOLDER not in self._answer.held_by:
            self._changed.set()  # the motion ended meanwhile: check the one that runs now
        elif problem:
            self._bus.log.warning("the arm is held: %s", problem)
        else:
            self._bus.log.info("the hold is released: nothing obstructs the motion any more")

    async def _follow(self, status: MotionStatus) -> None:
        if self.monitor.has_plan(status.plan):
            self.monitor.follow(status.id, status.plan)
            return
        try:
            execution = await self._followed.call(FollowedRequest(id=status.id), REQUEST_TIMEOUT)
        except RemoteError as error:  # the motion has ended meanwhile
            self.monitor.unfollow(status.id)
            raise NotMonitored(str(error)) from None
        self.monitor.follow(status.id, execution.plan, execution.trajectory)
