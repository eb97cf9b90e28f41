"""Read cameras and joint states, and turn the newest into obstacles for a plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from common import topics
from common.errors import Refused
from common.messages import CameraInfo, Image, PlanningScene, PointCloud2
from common.planning.camera_obstacles import Camera, CameraMessages, CameraObstacles, JointHistory, PointsOptions
from common.planning.pipeline import PlanningPipeline
from common.planning.point_obstacles import PointObstacle
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

    def load(self, pipeline: PlanningPipeline) -> None:
        """Load the robot's geometry."""
        self._obstacles = CameraObstacles(pipeline.robot, pipeline.geometry, self._options)
        self._joints = JointHistory(pipeline.robot)

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
