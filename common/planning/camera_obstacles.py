"""From the newest messages of cameras to obstacles: camera poses, robot positions and age limits."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from common.config import Section
from common.config.basics import Key
from common.errors import Refused, ZencellError
from common.messages import CameraInfo, Image, JointState, PlanningScene, PointCloud2, TFMessage
from common.perception.camera_input import FrameError
from common.perception.depth import Depth, check_depth, depth_of
from common.perception.pinhole import CameraError, Pinhole
from common.planning.obstacles import InvalidShape
from common.planning.point_obstacles import CameraView, KnownShapeFilter, PointObstacle, depth_points, occluded_spheres
from common.planning.robot_geometry import RobotGeometry
from common.robot.finger_joints import measured_width
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix

Array = npt.NDArray[np.float64]
Corner = tuple[float, float, float]

_WORLD = "world"
_HISTORY = 1000  # joint states, at 100 Hz
_MAX_GAP = 0.1  # [s] between an image and the joint states before and after it


class Camera(Section):
    """A camera: the key of its point clouds, or of its depth images and their intrinsics."""

    points: Key | Literal[""] = Field("", description="key of a PointCloud2, such as depth_camera/points")
    depth: Key | Literal[""] = Field("", description="key of a depth Image, such as depth_camera/depth/image_raw")
    info: Key | Literal[""] = Field("", description="key of its CameraInfo, such as depth_camera/camera_info")

    @property
    def key(self) -> str:
        """Key of the point clouds or depth images."""
        return self.points or self.depth

    @model_validator(mode="after")
    def _has_one_kind(self) -> Camera:
        if bool(self.points) == bool(self.depth) or bool(self.depth) != bool(self.info):
            raise ValueError("a camera needs either points, or depth and info")
        return self


class Box(Section):
    """A box in the world, along its axes."""

    low: Corner = Field(description="[m]")
    high: Corner = Field(description="[m]")

    @model_validator(mode="after")
    def _has_volume(self) -> Box:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"low {self.low} must be less than high {self.high} in x, y and z")
        return self


class PointsOptions(Section):
    """Obstacles that cameras see and the planning scene does not have."""

    cameras: list[Camera] = Field(min_length=1, max_length=16)
    voxel: float = Field(0.01, gt=0, le=0.2, description="side of the cubes whose points become one sphere [m]")
    stride: int = Field(1, ge=1, le=32, description="use every n-th row and column of a depth image")
    margin: float = Field(0.03, ge=0, le=0.3, description="points this close to the robot belong to it [m]")
    object_margin: float = Field(0.02, ge=0, le=0.3, description="the same for objects of the planning scene [m]")
    max_age: float = Field(2.0, gt=0, le=3600, description="largest age of a camera's newest image, cell time [s]")
    unknown: Literal["free", "occupied"] = Field("free", description="space in the box that no depth image shows")
    box: Box | None = Field(None, description="in which unknown space is occupied")
    unknown_voxel: float = Field(0.03, gt=0, le=0.5, description="side of its cubes [m]")

    @model_validator(mode="after")
    def _box_fits(self) -> PointsOptions:
        if (self.unknown == "occupied") != (self.box is not None):
            raise ValueError("unknown: occupied needs a box, and a box needs unknown: occupied")
        if self.box is not None:
            sides = np.subtract(self.box.high, self.box.low) / self.unknown_voxel
            if np.prod(np.ceil(sides)) > 1e6:
                raise ValueError(f"the box has more than a million cubes of {self.unknown_voxel:g} m")
            if any(camera.points for camera in self.cameras):
                raise ValueError("unknown: occupied needs depth and info of every camera; clouds show no free space")
        return self


@dataclass(frozen=True)
class CameraMessages:
    """The newest messages of one camera."""

    camera: Camera
    image: Image | PointCloud2 | None
    info: CameraInfo | None = None


class CameraObstacles:
    """Turns camera messages into obstacles. Not thread-safe."""

    def __init__(self, robot: RobotModel, geometry: RobotGeometry, options: PointsOptions) -> None:
        self._robot = robot
        self._known = KnownShapeFilter(geometry)
        self._options = options

    def obstacles(
        self, seen: list[CameraMessages], poses: TFMessage | None, joints: JointHistory, scene: PlanningScene,
        now_ns: int,
    ) -> list[PointObstacle]:
        """Return an obstacle for each camera, and one for unknown space.

        Args:
            seen: newest messages of every camera.
            poses: of the cameras' frames, in the world or in a link of the robot.
            joints: where the robot was; scene: known objects; now_ns: cell time.

        Raises:
            Refused: one line that names the camera and what is missing, too old or invalid.
        """
        options, found, images = self._options, [], []
        latest = max((one.image.header.stamp for one in seen if one.image is not None), default=0)
        try:
            for one in seen:
                view, image = self._view(one, poses, joints, now_ns)
                if image is not None:
                    images.append(image)
                margins = {"margin": options.margin, "object_margin": options.object_margin}
                found.append(self._known.obstacle(view, scene, side=options.voxel, **margins))
            if options.box is not None:
                q = self._q(joints, latest, "unknown space")
                low, high = np.array(options.box.low), np.array(options.box.high)
                spheres = occluded_spheres(images, low, high, options.unknown_voxel)
                width = joints.width(latest)
                found.append(self._known.unknown("unknown space", spheres, scene, q, width=width, **margins))
        except InvalidShape as error:
            raise Refused("bad_scene", str(error)) from None
        return found

    def _view(
        self, seen: CameraMessages, poses: TFMessage | None, joints: JointHistory, now_ns: int
    ) -> tuple[CameraView, tuple[Depth, Pinhole] | None]:
        """Return what one camera saw, in the world, and its depth image if it sends depth."""
        name, image = seen.camera.key, seen.image
        if image is None:
            raise Refused("no_points", f"{name}: no image received yet, so obstacles there are unknown")
        age = (now_ns - image.header.stamp) / 1e9
        if age > self._options.max_age:
            raise Refused("old_points", f"{name}: the newest image is {age:.2f} s old; the limit points.max_age "
                                        f"is {self._options.max_age:g} s")
        q, width = self._q(joints, image.header.stamp, name), joints.width(image.header.stamp)
        try:
            T = frame_pose(image.header.frame_id, poses, self._robot, q)
            if isinstance(image, PointCloud2):
                points = cloud_points(image)
                return CameraView(f"points of {name}", points @ T[:3, :3].T + T[:3, 3], q, width), None
            if seen.info is None:
                raise Refused("no_points", f"{seen.camera.info}: no message received yet, so {name} cannot be used")
            camera = Pinhole.from_info(seen.info, T)
            depth = depth_of(image)
            if (depth > 0).any():  # an image without any depth shows no points and no free space
                check_depth(depth, camera.width, camera.height)
            step = self._options.stride
            coarse = Pinhole(
                camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step, camera.width, camera.height, T
            )
            points = depth_points(depth[::step, ::step], coarse)
            return CameraView(f"points of {name}", points, q, width), (depth, camera)
        except (FrameError, CameraError) as error:
            raise Refused("bad_points", f"{name}: {error}") from None
        except ZencellError as error:
            if isinstance(error, Refused):
                raise
            raise Refused("bad_points", f"{name}: {error}") from None

    def _q(self, joints: JointHistory, stamp: int, name: str) -> Array:
        q = joints.at(stamp)
        if q is None:
            raise Refused("no_state", f"{name}: no joint state at the time of this image")
        return q


class JointHistory:
    """Joint positions and gripper width of the last seconds."""

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._states: deque[tuple[int, Array, float | None]] = deque(maxlen=_HISTORY)

    def add(self, state: JointState) -> None:
        """Add a joint state, unless it lacks joints or is older than the newest."""
        q = self._robot.order(state.name, state.position)
        if q is not None and (not self._states or state.header.stamp > self._states[-1][0]):
            width = measured_width(self._robot.config.gripper, state.name, state.position)
            self._states.append((state.header.stamp, q, width))

    def at(self, stamp: int) -> Array | None:
        """Return (dof,) [rad] at a time [ns], interpolated between joint states; None if too far from any."""
        near = self._about(stamp)
        if len(near) < 2:
            return near[0][1] if near else None
        (t0, q0, _), (t1, q1, _) = near
        return np.asarray(q0 + (stamp - t0) / (t1 - t0) * (q1 - q0))

    def width(self, stamp: int) -> float | None:
        """Return the gripper width [m] at a time [ns], the wider of the states before and after; None if unknown."""
        return max((width for _, _, width in self._about(stamp) if width is not None), default=None)

    def _about(self, stamp: int) -> list[tuple[int, Array, float | None]]:
        states = list(self._states)
        after = next((i for i, (at, _, _) in enumerate(states) if at >= stamp), len(states))
        return [state for state in states[max(after - 1, 0) : after + 1] if abs(state[0] - stamp) <= _MAX_GAP * 1e9]


def frame_pose(frame: str, poses: TFMessage | None, robot: RobotModel, q: Array) -> Array:
    """Return the (4, 4) world pose of a frame whose chain of parents ends at world or at a link of the robot at q.

    Raises:
        FrameError: its chain of parents does not.
    """
    known = {t.child_frame_id: t for t in (poses.transforms if poses is not None else [])}
    links = set(robot.link_names)
    T, at = np.eye(4), frame
    for _ in range(len(known) + 1):
        if at == _WORLD:
            return T
        if at in links:
            return np.asarray(robot.link_poses(q)[at] @ T)
        if at not in known:
            break
        T = pose_to_matrix(known[at].transform) @ T
        at = known[at].header.frame_id
    raise FrameError("unknown_frame", f"tf_static has no pose of frame {frame!r}; its frames: "
                                    f"{', '.join(known) or 'none'}")


def cloud_points(cloud: PointCloud2) -> Array:
    """Return (N, 3) finite points [m] of a cloud in its frame.

    Raises:
        FrameError: it lacks x, y or z, or its size does not match its layout.
    """
    missing = [name for name in ("x", "y", "z") if name not in cloud.fields]
    if missing:
        raise FrameError("fields", f"the cloud has no {missing[0]}; its fields are {', '.join(cloud.fields) or 'none'}")
    at = [cloud.fields.index(name) for name in ("x", "y", "z")]
    row = cloud.width * cloud.point_step
    if cloud.point_step % 4 or 4 * (max(at) + 1) > cloud.point_step or cloud.row_step < row:
        raise FrameError("step", f"point_step {cloud.point_step} and row_step {cloud.row_step} do not fit "
                               f"{len(cloud.fields)} fields of {cloud.width} points")
    if len(cloud.data) < cloud.row_step * (cloud.height - 1) + row:
        raise FrameError("truncated", f"{len(cloud.data)} bytes are too few for {cloud.width}x{cloud.height} points")
    data = np.frombuffer(cloud.data, np.uint8)
    rows = np.lib.stride_tricks.as_strided(data, (cloud.height, row), (cloud.row_step, 1), writeable=False)
    values = np.ascontiguousarray(rows).view("<f4").reshape(-1, cloud.point_step // 4)[:, at]
    return np.asarray(values[np.isfinite(values).all(axis=1)], dtype=float)
