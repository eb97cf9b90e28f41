"""Pinhole cameras with a rigid pose: the only conversion between pixels and world; outlines of spheres in an image.

Spheres: a ray with unit direction d from the optical center touches a sphere with center c (relative to the optical
center) and radius r exactly if its distance from c, |c - (c . d) d|, is r. The image is a conic, not a circle about the
projected center; hence centroids are slightly biased and outlines are not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import numpy.typing as npt

from common.config.world import TCP, CameraConfig, Surroundings
from common.errors import ConfigError, ZencellError
from common.messages import CameraInfo, Header
from common.robot.transforms import matrix_to_rpy, rpy_to_matrix, transform

Array = npt.NDArray[np.float64]


class CameraError(ZencellError):
    """An invalid camera: the pose is not rigid, or the distortion is not supported."""


@dataclass(frozen=True, eq=False)
class Pinhole:
    """Intrinsics [px], image size [px] and the (4, 4) pose of the optical frame in world."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    T_world_optical: Array
    _rotation: Array = field(init=False, repr=False)
    _position: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        T = np.asarray(self.T_world_optical, dtype=float)
        R = T[:3, :3]
        if T.shape != (4, 4) or not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            raise CameraError("the camera pose is not rigid: its rotation must be orthonormal with determinant +1")
        object.__setattr__(self, "T_world_optical", T)
        object.__setattr__(self, "_rotation", R)
        object.__setattr__(self, "_position", T[:3, 3])

    @classmethod
    def from_config(cls, camera: CameraConfig) -> Pinhole:
        """Return a camera that is fixed in world.

        Raises:
            CameraError: it is mounted on the robot: use `MountedCamera`.
        """
        if camera.mount:
            raise CameraError(f"{camera.frame} is mounted on {camera.mount}: its pose follows from the joints")
        T = transform(rpy_to_matrix(*camera.rpy), camera.position)
        return cls(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, T)

    @classmethod
    def from_info(cls, info: CameraInfo, T_world_optical: Array) -> Pinhole:
        """Return the camera of a camera_info message, at a (4, 4) pose of its optical frame.

        Raises:
            CameraError: the image is distorted (rectify it first) or skewed.
        """
        if any(abs(value) > 1e-12 for value in info.d):
            raise CameraError(f"distortion {list(info.d)} is not supported: rectify the image first")
        fx, skew, cx, s10, fy, cy, s20, s21, s22 = info.k
        if skew or s10 or s20 or s21 or s22 != 1:
            raise CameraError(f"intrinsic matrix {list(info.k)} is not of the form [fx 0 cx; 0 fy cy; 0 0 1]")
        return cls(fx, fy, cx, cy, info.width, info.height, T_world_optical)

    @property
    def position(self) -> Array:
        """Optical center in world, (3,) [m]."""
        return self._position

    def info(self, header: Header, *, without_robot: bool = False) -> CameraInfo:
        """Return the camera_info message; `without_robot` declares that its images omit the robot."""
        k = [self.fx, 0.0, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0]
        return CameraInfo(header=header, height=self.height, width=self.width, d=[0.0] * 5, k=k,
                          without_robot=without_robot)

    def to_camera(self, points: npt.ArrayLike) -> Array:
        """Transform points from world to the optical frame: (..., 3) [m]."""
        return (np.asarray(points, dtype=float) - self._position) @ self._rotation

    def project(self, points: npt.ArrayLike) -> Array:
        """Pixels (u, v) of points in world: (..., 2) [px]; nan for points that are not in front of the camera."""
        p = self.to_camera(points)
        z = np.where(p[..., 2] > 1e-9, p[..., 2], np.nan)
        return np.stack([self.fx * p[..., 0] / z + self.cx, self.fy * p[..., 1] / z + self.cy], axis=-1)

    def directions(self, pixels: npt.ArrayLike) -> Array:
        """Unit vectors in world along the rays through pixels: (..., 3)."""
        p = np.asarray(pixels, dtype=float)
        d = np.stack([(p[..., 0] - self.cx) / self.fx, (p[..., 1] - self.cy) / self.fy, np.ones(p.shape[:-1])], axis=-1)
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        return d @ self._rotation.T

    def ray(self, pixel: Sequence[float] | Array) -> tuple[Array, Array]:
        """Origin (3,) [m] and unit direction (3,) in world of the ray through a pixel (u, v)."""
        u, v = pixel
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        length = math.sqrt(x * x + y * y + 1)
        return self._position, self._rotation @ (x / length, y / length, 1 / length)

    def on_plane(self, pixels: npt.ArrayLike, z: float) -> Array:
        """Intersections of pixel rays with the horizontal plane at z [m]: (..., 2) [m]; nan without one."""
        d = self.directions(pixels)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (z - self._position[2]) / d[..., 2]
        t = np.where(np.isfinite(t) & (t > 0), t, np.nan)
        return self._position[:2] + t[..., None] * d[..., :2]

    def in_image(self, pixels: npt.ArrayLike, margin: float = 0.0) -> npt.NDArray[np.bool_]:
        """Mask of pixels inside the image, at least `margin` [px] from its border: (...)."""
        p = np.asarray(pixels, dtype=float)
        u, v = p[..., 0], p[..., 1]
        low, right, bottom = margin - 0.5, self.width - 0.5 - margin, self.height - 0.5 - margin
        inside: npt.NDArray[np.bool_] = (u >= low) & (u <= right) & (v >= low) & (v <= bottom)
        return inside


# Cameras mounted on the robot: their pose follows from the joints


if TYPE_CHECKING:  # fixed cameras need no robot model
    from common.robot.model import RobotModel

S = TypeVar("S", bound=Surroundings)


def camera_in_mount(camera: CameraConfig) -> Array:
    """(4, 4) pose of the optical frame in its mount link, or in world without a mount."""
    return transform(rpy_to_matrix(*camera.rpy), camera.position)


def mount_link(camera: CameraConfig, robot: RobotModel, field: str = "world.camera") -> str:
    """Return the link that carries a camera, which a field of the cell configures.

    Raises:
        ConfigError: the robot has no such link; lists the choices.
    """
    link = robot.config.tcp_link if camera.mount == TCP else camera.mount
    if link not in robot.link_names:
        raise ConfigError(f"{field}.mount", camera.mount, f"is no link of {robot.config.name}; choices: "
                                                          f"{', '.join([TCP, *robot.link_names])}")
    return link


def mount_links(around: Surroundings, robot: RobotModel) -> dict[str, str]:
    """Return the mount link of each mounted camera, by camera name.

    Raises:
        ConfigError: the robot has no such link; lists the choices.
    """
    single = len(around.cameras) == 1
    return {name: mount_link(camera, robot, "world.camera" if single else f"world.cameras.{name}")
            for name, camera in around.cameras.items() if camera.mount}


class MountedCamera:
    """A camera that is fixed in world or mounted on the robot."""

    def __init__(self, camera: CameraConfig, robot: RobotModel | None = None) -> None:
        """Take the camera, and the robot if the camera is mounted.

        Raises:
            ConfigError: the robot has no such link.
        """
        self.moves = bool(camera.mount)
        self._camera, self._robot = camera, robot
        self._link = mount_link(camera, robot) if self.moves and robot is not None else ""

    def at(self, q: npt.ArrayLike | None = None) -> Pinhole:
        """Return the camera at joint positions (dof,) [rad]; by default at the home pose.

        Raises:
            CameraError: it is mounted, but no robot was passed.
        """
        c = self._camera
        if self._robot is None or not self._link:
            return Pinhole.from_config(c)
        T = self._robot.link_poses(self._robot.named("home") if q is None else q)[self._link] @ camera_in_mount(c)
        return Pinhole(c.fx, c.fy, c.cx, c.cy, c.width, c.height, T)


def cameras_at_home(world: S, robot: RobotModel) -> S:
    """World with every mounted camera fixed at its pose for the robot's home pose.

    Raises:
        ConfigError: the robot has no link of that name.
    """
    mount_links(world, robot)

    def fixed(camera: CameraConfig) -> CameraConfig:
        if not camera.mount:
            return camera
        T = MountedCamera(camera, robot).at().T_world_optical
        x, y, z = T[:3, 3].tolist()
        return camera.model_copy(update={"mount": "", "position": (x, y, z), "rpy": matrix_to_rpy(T[:3, :3])})

    cameras = {name: fixed(camera) for name, camera in world.cameras.items()}
    return world.model_copy(update={"cameras": cameras, "camera": fixed(world.camera)})


def silhouettes(camera: Pinhole, centers: npt.ArrayLike, radius: float, count: int = 64) -> Array:
    """Return pixels (k, count, 2) around the outlines of spheres [px].

    Args:
        camera: the camera.
        centers: (k, 3) in world [m].
        radius: [m].
        count: points per outline.

    Returns:
        nan for spheres that are not completely in front of the optical center.
    """
    positions = np.asarray(centers, dtype=float).reshape(-1, 3)
    c = positions - camera.position
    distance = np.sqrt(np.einsum("ij,ij->i", c, c))[:, None]
    sine = np.clip(radius / np.maximum(distance, 1e-12), 0, 1)
    axis = c / np.maximum(distance, 1e-12)
    # All tangent points lie on a circle in front of the center.
    ring_center = axis * distance * (1 - sine**2)
    around = radius * np.sqrt(1 - sine**2)
    x, y, z = axis.T
    o = np.zeros_like(x)
    first = np.where(np.abs(x)[:, None] < 0.9, np.column_stack([o, z, -y]), np.column_stack([-z, o, x]))
    first /= np.maximum(np.sqrt(np.einsum("ij,ij->i", first, first)), 1e-12)[:, None]
    fx, fy, fz = first.T
    second = np.column_stack([y * fz - z * fy, z * fx - x * fz, x * fy - y * fx])
    angle = np.linspace(0.0, 2 * math.pi, count, endpoint=False)[None, :, None]
    ring = ring_center[:, None] + around[:, None] * (np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None])
    pixels = camera.project(camera.position + ring)
    pixels[camera.to_camera(positions)[:, 2] <= radius] = np.nan
    return pixels


def silhouette(camera: Pinhole, center: npt.ArrayLike, radius: float, count: int = 64) -> Array:
    """Pixels (count, 2) on the outline of one sphere; empty (0, 2) unless it is completely in front of the camera."""
    pixels: Array = silhouettes(camera, center, radius, count)[0]
    return np.empty((0, 2)) if np.isnan(pixels).any() else pixels


def ray_distances(directions: Array, centers: Array) -> tuple[Array, Array]:
    """Compute distances between rays from the optical center and points.

    Args:
        directions: (n, 3) unit vectors.
        centers: (k, 3) relative to the optical center [m].

    Returns:
        (n, k) distances [m], and (n, k) lengths along each ray to the closest approach [m]. The gradient of a distance
        with respect to its center is the unit vector (center - along * direction) / distance.
    """
    along: Array = directions @ centers.T
    square = np.einsum("ij,ij->i", centers, centers) - along**2
    distance: Array = np.sqrt(np.maximum(square, 1e-18))
    return distance, along


def sphere_in_view(camera: Pinhole, center: npt.ArrayLike, radius: float, margin: float = 0.0) -> bool:
    """Whether the outline of a sphere lies in the image, at least `margin` [px] inside its border."""
    outline = silhouette(camera, center, radius, 32)
    return len(outline) > 0 and bool(camera.in_image(outline, margin).all())
