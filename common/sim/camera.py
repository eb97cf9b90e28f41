"""Simulated camera: rendering, lens distortion, motion blur, sensor, and mounting on the robot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field

from common.config import CameraConfig, Light, RobotConfig, Scenery, Surroundings, Tunable
from common.errors import ConfigError
from common.messages import CameraInfo, Header, JointState, Vector3, WorldObject, WorldObjects
from common.perception.camera_file import CameraFile, Rectifier
from common.perception.pinhole import MountedCamera, Pinhole, camera_in_mount
from common.robot.transforms import matrix_to_rpy, rpy_to_matrix, transform
from common.sim.interface import load_renderer
from common.sim.ray_caster import View
from common.sim.sensors import Sensor, SensorParameters

if TYPE_CHECKING:  # only cameras that show the arm, or are mounted on it, load the robot model
    from common.robot.model import RobotModel

Array = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]

MARGIN = 2  # [px] around the field of view of a lens
LARGEST = 2.0  # limit of the rendered size relative to the image
INVERSE_ERROR = 0.1  # [px] tolerance when checking the inverse distortion
MAX_AGE = 0.1  # [s] of the world state from which motion is extrapolated
MAX_INTERVAL = 0.25  # [s] between two world states from which a velocity is computed
MAX_SPEED = 5.0  # [m/s] a faster object was repositioned


class CameraParameters(SensorParameters):
    """Sensor and light of a simulated camera."""

    lights: Tunable[dict[str, Light]] = Field(
        {}, max_length=7, description="replaces world.lights: to move and dim them at runtime"
    )
    ambient: Tunable[float | None] = Field(None, ge=0, le=100_000, description="replaces world.ambient [lx]")
    pose_error: tuple[float, float, float, float, float, float] = Field(
        (0.0,) * 6, description="calibration error: the true optical frame in the configured one, x, y, z [m], roll, "
                                "pitch, yaw [rad]"
    )


class SimulatedCamera:
    """One camera of a simulated world. All calls but `info` may block.

    Attributes:
        moves: whether it is mounted on the robot.
        needs_joints: whether `capture` needs the joint state.
    """

    def __init__(
        self, around: Surroundings, scenery: Scenery, robots: Sequence[RobotConfig], config: CameraParameters,
        rng: np.random.Generator, *, plain: bool, lens: Lens | None = None, arm: bool = False,
    ) -> None:
        """Create the renderer and the sensor.

        Args:
            around: fixtures, containers and the camera.
            scenery: the simulator and the light.
            robots: loaded only if they are visible, or the first one carries the camera.
            config: light, exposure and noise, which may change at any time.
            rng: noise source.
            plain: see `common.sim.interface.load_renderer`.
            lens: of the camera; default: no distortion.
            arm: show the arms in plain images, too.

        Raises:
            ConfigError, UnknownName: the cell names something that does not exist.
        """
        self._lens = lens or Lens(around.camera)
        self._scenery, self._config = scenery, config
        self._robots: list[RobotModel] = []
        self._robot_configs = robots
        self._mounted = MountedCamera(displaced(self._lens.rendered, config.pose_error),
                                      self._models()[0] if around.camera.mount else None)
        self._camera = around.camera
        self._light = self._current_light()
        self._renderer = load_renderer(around, self._light, self._models, plain=plain, camera=self._mounted.at(),
                                       arm=arm)
        self._sensor, self._motion = Sensor(config, rng), ObjectMotion(current=bool(around.conveyors))
        self.moves = self._mounted.moves
        self.needs_joints = self.moves or self._renderer.needs_arm

    def _models(self) -> list[RobotModel]:
        if not self._robots:
            from common.robot.model import RobotModel

            self._robots = [RobotModel.load(config) for config in self._robot_configs]
        return self._robots

    def _current_light(self) -> Scenery:
        lights, ambient = self._config.lights, self._config.ambient
        return self._scenery.model_copy(update={
            "lights": lights or self._scenery.lights,
            "ambient": self._scenery.ambient if ambient is None else ambient,
        })

    @property
    def pinhole(self) -> Pinhole:
        """The camera of the output images, at its pose in the last one."""
        c = self._camera
        return Pinhole(c.fx, c.fy, c.cx, c.cy, c.width, c.height, self._renderer.camera.T_world_optical)

    def info(self, header: Header) -> CameraInfo:
        """Return the camera_info message."""
        info = self.pinhole.info(header, without_robot=not self._renderer.needs_arm)
        return info.model_copy(update={"d": self._lens.d, "distortion_model": self._lens.model})

    def is_at(self, joints: JointState | None) -> bool:
        """Whether the joint state determines the camera's pose: it is mounted, and no joint of the arm is missing."""
        return (self.moves and joints is not None
                and self._models()[0].order(joints.name, joints.position) is not None)

    def takes_long(self, truth: WorldObjects) -> bool:
        """Whether `capture` may take long."""
        return self._config.sub_exposures > 1 or self._renderer.takes_long(truth.objects)

    def capture(self, truth: WorldObjects, joints: Sequence[JointState | None], now: int) -> View:
        """Return the output image, and the noiseless depth at the end of the exposure.

        Args:
            truth: state of all objects.
            joints: state of each arm.
            now: end of the exposure, a stamp [ns].
        """
        light = self._current_light()
        if light != self._light:
            self._light = light
            self._renderer.set_light(light)
        self._motion.update(truth)
        views = []
        for ago in sample_times(self._sensor.exposure, self._config.sub_exposures):
            states = [joints_ago(state, ago) for state in joints]
            if self.moves and (state := states[0]) is not None:
                q = self._models()[0].order(state.name, state.position)
                if q is not None:
                    self._renderer.move_camera(self._mounted.at(q))
            views.append(self._renderer.render(self._motion.objects(ago, now), *states))
        images = [self._lens.distort(view.colour) for view in views]
        image = self._lens.rectify(self._sensor.expose(images, self._renderer.level))
        return View(image, views[-1].depth)


def displaced(camera: CameraConfig, error: Sequence[float]) -> CameraConfig:
    """Return a camera moved by x, y, z [m] and turned by roll, pitch, yaw [rad] in its own optical frame."""
    if not any(error):
        return camera
    dx, dy, dz, roll, pitch, yaw = error
    T: Array = camera_in_mount(camera) @ transform(rpy_to_matrix(roll, pitch, yaw), (dx, dy, dz))
    x, y, z = T[:3, 3].tolist()
    return camera.model_copy(update={"position": (x, y, z), "rpy": matrix_to_rpy(T[:3, :3])})


class Lens:
    """The lens of a simulated camera: distorts rendered images, and rectifies sensor images as a driver does.

    A pinhole with a larger field of view is rendered; each output pixel samples it at the distorted position.

    Attributes:
        rendered: undistorted camera for which images are rendered.
        d: remaining distortion of the output images.
    """

    def __init__(self, camera: CameraConfig, *, distorted: bool = False, rectify: bool = True) -> None:
        """Compute the distortion map.

        Args:
            camera: its `d` is the distortion: k1, k2, p1, p2, k3, ...
            distorted: apply the distortion; False: act as a pinhole.
            rectify: remove the distortion again, as camera_opencv does.

        Raises:
            ConfigError: the distortion would need a too large rendered image.
        """
        self.rendered, self.d, self.model = camera, [0.0] * 5, "plumb_bob"
        self._maps: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]] | None = None
        self._rectify = None
        if not distorted or not any(camera.d):
            return
        file = CameraFile(**camera.model_dump())
        v, u = np.mgrid[0:camera.height, 0:camera.width]
        ideal = file.undistorted(np.column_stack([u.ravel(), v.ravel()])).reshape(camera.height, camera.width, 2)
        low = np.floor(np.minimum(ideal.min(axis=(0, 1)), 0)) - MARGIN
        high = np.ceil(np.maximum(ideal.max(axis=(0, 1)), (camera.width - 1, camera.height - 1))) + MARGIN
        width, height = (high - low + 1).tolist()
        if not _is_inverse(file, ideal) or width > LARGEST * camera.width or height > LARGEST * camera.height:
            raise ConfigError("world.camera.d", camera.d, f"distorts an image of {camera.width}x{camera.height} to "
                                                          f"more than {LARGEST:g} times its size")
        shifted = (ideal - low).astype(np.float32)
        self._maps = np.ascontiguousarray(shifted[..., 0]), np.ascontiguousarray(shifted[..., 1])
        self.rendered = camera.model_copy(update={
            "width": int(width), "height": int(height), "d": [],
            "cx": camera.cx - float(low[0]), "cy": camera.cy - float(low[1]),
        })
        if rectify:
            self._rectify = Rectifier(file)
        else:
            self.d, self.model = file.distortion.tolist(), file.distortion_model

    def distort(self, image: Pixels) -> Pixels:
        """Apply the distortion to a rendered image; the same object without distortion."""
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), np.uint8)

    def rectify(self, image: Pixels) -> Pixels:
        """Rectify a sensor image if the camera is configured to."""
        return image if self._rectify is None else self._rectify(image, "the lens")


def _is_inverse(camera: CameraFile, ideal: Array) -> bool:
    """Whether distorting the undistorted positions (height, width, 2) [px] gives the original pixels back."""
    if not np.isfinite(ideal).all():
        return False
    focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    rays = np.concatenate([(ideal - center) / focal, np.ones((*ideal.shape[:2], 1))], axis=-1).reshape(-1, 1, 3)
    back, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    v, u = np.mgrid[0:camera.height, 0:camera.width]
    return bool(np.abs(back.reshape(-1, 2) - np.column_stack([u.ravel(), v.ravel()])).max() < INVERSE_ERROR)


class ObjectMotion:
    """Velocities of objects from the last two world states, for motion blur.

    World states are published less often than images are taken. `current` extrapolates to the time of the image: on
    a belt an object is up to 10 mm ahead of its last published position.
    """

    def __init__(self, *, current: bool = False) -> None:
        """Start without a world state."""
        self._current = current
        self._last: WorldObjects | None = None
        self._velocities: dict[str, Array] = {}

    def update(self, truth: WorldObjects) -> None:
        """Take a world state and compute velocities."""
        before, self._last = self._last, truth
        if before is truth or before is None:
            return
        seconds = (truth.header.stamp - before.header.stamp) * 1e-9
        self._velocities = {}
        if not 0 < seconds <= MAX_INTERVAL:
            return
        positions = {obj.id: obj.pose.position for obj in before.objects}
        for obj in truth.objects:
            if (was := positions.get(obj.id)) is not None and was != obj.pose.position:
                velocity = (_array(obj.pose.position) - _array(was)) / seconds
                if np.linalg.norm(velocity) < MAX_SPEED:
                    self._velocities[obj.id] = velocity

    def objects(self, ago: float, now: int) -> Sequence[WorldObject]:
        """Return the objects some time [s] before the last world state; `now` is a stamp [ns]."""
        if self._last is None:
            return []
        age = (now - self._last.header.stamp) * 1e-9
        ago -= max(age, 0.0) if self._current else 0.0
        if ago == 0 or not self._velocities or age > MAX_AGE:
            return self._last.objects
        return [self._moved(obj, ago) for obj in self._last.objects]

    def _moved(self, obj: WorldObject, ago: float) -> WorldObject:
        velocity = self._velocities.get(obj.id)
        if velocity is None:
            return obj
        x, y, z = (_array(obj.pose.position) - ago * velocity).tolist()
        return obj.model_copy(update={"pose": obj.pose.model_copy(update={"position": Vector3(x=x, y=y, z=z)})})


def joints_ago(state: JointState | None, ago: float) -> JointState | None:
    """Return a joint state extrapolated back by some time [s] with its velocities."""
    if state is None or ago == 0 or not any(state.velocity):
        return state
    position = [q - ago * dq for q, dq in zip(state.position, state.velocity, strict=True)]
    return state.model_copy(update={"position": position})


def sample_times(exposure: float, count: int) -> Iterator[float]:
    """Yield times before the end of an exposure [s], evenly spaced; a single one is the end."""
    for number in range(count):
        yield 0.0 if count == 1 else exposure * (count - 1 - number) / (count - 1)


def _array(point: Vector3) -> Array:
    return np.array([point.x, point.y, point.z])
