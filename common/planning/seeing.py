"""From the newest messages of cameras to obstacles: which camera, where it was, where the robot was, and how old."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from common.config import Section
from common.errors import Refused, ZencellError
from common.messages import CameraInfo, Image, JointState, PlanningScene, PointCloud2, TFMessage
from common.perception.camera_input import FrameError
from common.perception.depth import Depth, check_depth, depth_of
from common.perception.pinhole import CameraError, Pinhole
from common.planning.obstacles import BadShape
from common.planning.points import KnownShapes, PointObstacle, View, depth_points, unseen
from common.planning.robot_geometry import RobotGeometry
from common.robot.finger_joints import measured_width
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix

Array = npt.NDArray[np.float64]
Corner = tuple[float, float, float]

_WORLD = "world"
_KEPT = 1000  # joint states, of which there are 100 each second
_BETWEEN = 0.1  # [s] by which joint states that say where the robot was may lie before or after a picture


class Camera(Section):
    """Whose points count: of a topic of point clouds, or of one of depth pictures with that of its intrinsics."""

    points: str = Field("", description="key of a PointCloud2, such as depth_camera/points")
    depth: str = Field("", description="key of a depth Image, such as depth_camera/depth/image_raw")
    info: str = Field("", description="key of its CameraInfo, such as depth_camera/camera_info")

    @property
    def key(self) -> str:
        """The topic that says what was seen."""
        return self.points or self.depth

    @model_validator(mode="after")
    def _has_one_kind(self) -> Camera:
        if bool(self.points) == bool(self.depth) or bool(self.depth) != bool(self.info):
            raise ValueError("a camera has either points, or depth and info")
        return self


class Box(Section):
    """A box in the world, along its axes."""

    low: Corner = Field(description="[m]")
    high: Corner = Field(description="[m]")

    @model_validator(mode="after")
    def _has_volume(self) -> Box:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"low {self.low} has to be less than high {self.high} in x, y and z")
        return self


class PointsOptions(Section):
    """What cameras see and the planning scene does not have, as obstacles."""

    cameras: list[Camera] = Field(min_length=1, max_length=16)
    voxel: float = Field(0.01, gt=0, le=0.2, description="side of the cubes whose points become one sphere [m]")
    stride: int = Field(1, ge=1, le=32, description="of a depth picture every n-th row and column")
    margin: float = Field(0.03, ge=0, le=0.3, description="from the robot within which points are its own [m]")
    object_margin: float = Field(0.02, ge=0, le=0.3, description="the same from objects of the planning scene [m]")
    max_age: float = Field(2.0, gt=0, le=3600, description="of what a camera saw last, in cell time [s]")
    unknown: Literal["free", "occupied"] = Field("free", description="space in the box that no depth picture shows")
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
                raise ValueError("unknown: occupied needs depth and info of every camera: clouds do not tell it")
        return self


@dataclass(frozen=True)
class Seen:
    """The newest messages of one camera."""

    camera: Camera
    picture: Image | PointCloud2 | None
    info: CameraInfo | None = None


class Seeing:
    """Makes obstacles of what cameras saw. Not for several threads at once."""

    def __init__(self, robot: RobotModel, geometry: RobotGeometry, options: PointsOptions) -> None:
        self._robot = robot
        self._known = KnownShapes(geometry)
        self._options = options

    def obstacles(
        self, seen: list[Seen], poses: TFMessage | None, joints: JointHistory, scene: PlanningScene, now_ns: int
    ) -> list[PointObstacle]:
        """An obstacle for each camera, and one for space that is unknown.

        Args:
            seen: newest messages of every camera.
            poses: of the cameras' frames, in the world or in a link of the robot.
            joints: where the robot was; scene: what is known; now_ns: cell time.

        Raises:
            Refused: one line that names the camera and what is missing, too old or wrong.
        """
        options, found, pictures = self._options, [], []
        latest = max((one.picture.header.stamp for one in seen if one.picture is not None), default=0)
        try:
            for one in seen:
                view, picture = self._view(one, poses, joints, now_ns)
                if picture is not None:
                    pictures.append(picture)
                margins = {"margin": options.margin, "object_margin": options.object_margin}
                found.append(self._known.obstacle(view, scene, side=options.voxel, **margins))
            if options.box is not None:
                q = self._q(joints, latest, "unknown space")
                spheres = unseen(pictures, np.array(options.box.low), np.array(options.box.high), options.unknown_voxel)
                width = joints.width(latest)
                found.append(self._known.unknown("unknown space", spheres, scene, q, width=width, **margins))
        except BadShape as error:
            raise Refused("bad_scene", str(error)) from None
        return found

    def _view(
        self, seen: Seen, poses: TFMessage | None, joints: JointHistory, now_ns: int
    ) -> tuple[View, tuple[Depth, Pinhole] | None]:
        """What one camera saw, in the world; its depth picture where that is what it sends."""
        name, picture = seen.camera.key, seen.picture
        if picture is None:
            raise Refused("no_points", f"{name}: nothing came yet, so what stands there is not known")
        age = (now_ns - picture.header.stamp) / 1e9
        if age > self._options.max_age:
            raise Refused("old_points", f"{name}: the newest is {age:.2f} s old; points.max_age is "
                                        f"{self._options.max_age:g} s")
        q, width = self._q(joints, picture.header.stamp, name), joints.width(picture.header.stamp)
        try:
            T = frame_pose(picture.header.frame_id, poses, self._robot, q)
            if isinstance(picture, PointCloud2):
                points = cloud_points(picture)
                return View(f"points of {name}", points @ T[:3, :3].T + T[:3, 3], q, width), None
            if seen.info is None:
                raise Refused("no_points", f"{seen.camera.info}: nothing came yet, so {name} cannot be measured")
            camera = Pinhole.from_info(seen.info, T)
            depth = depth_of(picture)
            if (depth > 0).any():  # a picture without any depth shows no points, and nothing that is free
                check_depth(depth, camera.width, camera.height)
            step = self._options.stride
            coarse = Pinhole(
                camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step, camera.width, camera.height, T
            )
            return View(f"points of {name}", depth_points(depth[::step, ::step], coarse), q, width), (depth, camera)
        except (FrameError, CameraError) as error:
            raise Refused("bad_points", f"{name}: {error}") from None
        except ZencellError as error:
            if isinstance(error, Refused):
                raise
            raise Refused("bad_points", f"{name}: {error}") from None

    def _q(self, joints: JointHistory, stamp: int, name: str) -> Array:
        q = joints.at(stamp)
        if q is None:
            raise Refused("no_state", f"{name}: where the robot was when this was seen is not known")
        return q


class JointHistory:
    """Where the robot was in the last seconds."""

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._states: deque[tuple[int, Array, float | None]] = deque(maxlen=_KEPT)

    def note(self, state: JointState) -> None:
        """Take over joint states; those without all joints, or older than the newest, are left out."""
        q = self._robot.order(state.name, state.position)
        if q is not None and (not self._states or state.header.stamp > self._states[-1][0]):
            width = measured_width(self._robot.config.gripper, state.name, state.position)
            self._states.append((state.header.stamp, q, width))

    def at(self, stamp: int) -> Array | None:
        """(dof,) [rad] at a time [ns], between the states before and after it; None when too far from any."""
        near = self._about(stamp)
        if len(near) < 2:
            return near[0][1] if near else None
        (t0, q0, _), (t1, q1, _) = near
        return np.asarray(q0 + (stamp - t0) / (t1 - t0) * (q1 - q0))

    def width(self, stamp: int) -> float | None:
        """Between the fingers at a time [ns], the wider of the states before and after it [m]; None when not known."""
        return max((width for _, _, width in self._about(stamp) if width is not None), default=None)

    def _about(self, stamp: int) -> list[tuple[int, Array, float | None]]:
        states = list(self._states)
        after = next((i for i, (at, _, _) in enumerate(states) if at >= stamp), len(states))
        return [state for state in states[max(after - 1, 0) : after + 1] if abs(state[0] - stamp) <= _BETWEEN * 1e9]


def frame_pose(frame: str, poses: TFMessage | None, robot: RobotModel, q: Array) -> Array:
    """(4, 4) pose in the world of a frame that hangs, over others, on the world or on a link of the robot at q.

    Raises:
        FrameError: it does.
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
    raise FrameError("unknown_frame", f"tf_static does not say where frame {frame!r} is; it has: "
                                    f"{', '.join(known) or 'none'}")


def cloud_points(cloud: PointCloud2) -> Array:
    """(N, 3) points [m] of a cloud in its frame, without those that are no number.

    Raises:
        FrameError: it has no x, y and z, or its bytes do not add up.
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
