"""A simulated camera from the world to the pixels: renderer, lens, sensor, and where it is while things move."""

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
from common.perception.pinhole import MountedCamera, Pinhole
from common.sim.interface import load_renderer
from common.sim.ray_caster import View
from common.sim.sensor import Sensor, SensorParameters

if TYPE_CHECKING:  # loaded for a camera that has the arm in its picture, or sits on it
    from common.robot.model import RobotModel


class CameraParameters(SensorParameters):
    """Sensor and light of a simulated camera."""

    lights: Tunable[dict[str, Light]] = Field(
        {}, max_length=7, description="in the place of world.lights: to move and dim them while it looks"
    )
    ambient: Tunable[float | None] = Field(
        None, ge=0, le=100_000, description="in the place of world.ambient [lx]"
    )


class SimulatedCamera:
    """One camera of a simulated world. All calls but `info` may block.

    Attributes:
        moves: whether it sits on the robot.
        needs_joints: whether it cannot tell what it sees without the state of the joints.
    """

    def __init__(
        self, around: Surroundings, scenery: Scenery, robot: RobotConfig, config: CameraParameters,
        rng: np.random.Generator, *, plain: bool, lens: Lens | None = None, arm: bool = False,
    ) -> None:
        """Look at the world of a simulator.

        Args:
            around: what is fixed, and the camera.
            scenery: the simulator and the light.
            robot: read only when it is in the picture or carries the camera.
            config: light, exposure and noise, which may change at any time.
            rng: where noise comes from.
            plain: see `common.sim.interface.load_renderer`.
            lens: of the camera; else a pinhole.
            arm: whether the arm is in plain pictures, too.

        Raises:
            ConfigError, UnknownName: something named in the cell is not there.
        """
        self._lens = lens or Lens(around.camera)
        self._scenery, self._config = scenery, config
        self._robot: RobotModel | None = None
        self._robot_config = robot
        self._mounted = MountedCamera(self._lens.drawn, self._model() if around.camera.mount else None)
        self._camera = around.camera
        self._lit = self._light()
        self._renderer = load_renderer(around, self._lit, self._model, plain=plain, camera=self._mounted.at(),
                                       arm=arm)
        self._sensor, self._movement = Sensor(config, rng), ObjectMotion()
        self.moves = self._mounted.moves
        self.needs_joints = self.moves or self._renderer.needs_arm

    def _model(self) -> RobotModel:
        if self._robot is None:
            from common.robot.model import RobotModel

            self._robot = RobotModel.load(self._robot_config)
        return self._robot

    def _light(self) -> Scenery:
        lights, everywhere = self._config.lights, self._config.ambient
        return self._scenery.model_copy(update={
            "lights": lights or self._scenery.lights,
            "ambient": self._scenery.ambient if everywhere is None else everywhere,
        })

    @property
    def pinhole(self) -> Pinhole:
        """The camera of the pictures that come out, where it looked from last."""
        c = self._camera
        return Pinhole(c.fx, c.fy, c.cx, c.cy, c.width, c.height, self._renderer.camera.T_world_optical)

    def info(self, header: Header) -> CameraInfo:
        """What it tells of itself."""
        info = self.pinhole.info(header, without_robot=not self._renderer.needs_arm)
        return info.model_copy(update={"d": self._lens.d, "distortion_model": self._lens.model})

    def is_at(self, joints: JointState | None) -> bool:
        """Whether joints tell where it is: it sits on the robot, and none of the arm's is missing."""
        return (self.moves and joints is not None
                and self._model().order(joints.name, joints.position) is not None)

    def takes_long(self, truth: WorldObjects) -> bool:
        """Whether to `capture` may take longer than a moment."""
        return self._config.sub_exposures > 1 or self._renderer.takes_long(truth.objects)

    def capture(self, truth: WorldObjects, joints: JointState | None, now: int) -> View:
        """The picture that comes out, and the depth of the world as it is at the end of the exposure, without noise.

        Args:
            truth: where everything is.
            joints: the state of the arm.
            now: the end of the exposure, a stamp [ns].
        """
        lit = self._light()
        if lit != self._lit:
            self._lit = lit
            self._renderer.set_light(lit)
        self._movement.take(truth)
        views = []
        for ago in times(self._sensor.exposure, self._config.sub_exposures):
            state = joints_ago(joints, ago)
            if self.moves and state is not None:
                q = self._model().order(state.name, state.position)
                if q is not None:
                    self._renderer.move_camera(self._mounted.at(q))
            views.append(self._renderer.render(self._movement.objects(ago, now), state))
        pictures = [self._lens.bend(view.colour) for view in views]
        picture = self._lens.come_out(self._sensor.expose(pictures, self._renderer.level))
        return View(picture, views[-1].depth)


# What a lens does to a picture: distortion, put in as a real one does and taken out again as its driver does.

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

MARGIN = 2  # [px] about what the lens sees
LARGEST = 2.0  # times the picture's width and height
UNDONE = 0.1  # [px]


class Lens:
    """The lens of a camera of the world.

    Attributes:
        drawn: the camera without distortion for which pictures are to be drawn.
        d: what is left of the distortion in the pictures that come out.
    """

    def __init__(self, camera: CameraConfig, *, distorted: bool = False, rectify: bool = True) -> None:
        """Compute what is looked up, once.

        Args:
            camera: its `d` is the distortion: k1, k2, p1, p2, k3, ...
            distorted: whether pictures are seen through the lens at all; else as by a pinhole.
            rectify: take the distortion out again, as camera_opencv does.

        Raises:
            ConfigError: a distortion that no picture of a reasonable size can be drawn for.
        """
        self.drawn, self.d, self.model = camera, [0.0] * 5, "plumb_bob"
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
        if not _is_undone(file, ideal) or width > LARGEST * camera.width or height > LARGEST * camera.height:
            raise ConfigError("world.camera.d", camera.d, f"bends a picture of {camera.width}x{camera.height} to more "
                                                          f"than {LARGEST:g} times its size")
        shifted = (ideal - low).astype(np.float32)
        self._maps = np.ascontiguousarray(shifted[..., 0]), np.ascontiguousarray(shifted[..., 1])
        self.drawn = camera.model_copy(update={
            "width": int(width), "height": int(height), "d": [],
            "cx": camera.cx - float(low[0]), "cy": camera.cy - float(low[1]),
        })
        if rectify:
            self._rectify = Rectifier(file)
        else:
            self.d, self.model = file.distortion.tolist(), file.distortion_model

    def bend(self, picture: Picture) -> Picture:
        """What the lens makes of a picture that was drawn: the same one where it has no distortion."""
        if self._maps is None:
            return picture
        return np.asarray(cv2.remap(picture, *self._maps, cv2.INTER_LINEAR), np.uint8)

    def come_out(self, picture: Picture) -> Picture:
        """What the camera sends of a picture that the sensor took: rectified, where it is to be."""
        return picture if self._rectify is None else self._rectify(picture, "the lens")


def _is_undone(camera: CameraFile, ideal: Array) -> bool:
    """Whether the lens shows the places (height, width, 2) [px] that were found at the pixels for which they stand."""
    if not np.isfinite(ideal).all():
        return False
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    rays = np.concatenate([(ideal - middle) / focal, np.ones((*ideal.shape[:2], 1))], axis=-1).reshape(-1, 1, 3)
    back, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    v, u = np.mgrid[0:camera.height, 0:camera.width]
    return bool(np.abs(back.reshape(-1, 2) - np.column_stack([u.ravel(), v.ravel()])).max() < UNDONE)


# Where everything was within an exposure, from what is known of how it moves now."""

OLDEST = 0.1  # [s] after which what was told of a thing says nothing about how it moves
LONGEST = 0.25  # [s] between two pictures that tell how fast a thing moves
FASTEST = 5.0  # [m/s]: what went farther was put elsewhere


class ObjectMotion:
    """How objects move, by the last two times that it was told where they are."""

    def __init__(self) -> None:
        """Nothing has moved yet."""
        self._last: WorldObjects | None = None
        self._velocities: dict[str, Array] = {}

    def take(self, truth: WorldObjects) -> None:
        """Look at where objects are now."""
        before, self._last = self._last, truth
        if before is truth or before is None:
            return
        seconds = (truth.header.stamp - before.header.stamp) * 1e-9
        self._velocities = {}
        if not 0 < seconds <= LONGEST:
            return
        places = {thing.id: thing.pose.position for thing in before.objects}
        for thing in truth.objects:
            if (was := places.get(thing.id)) is not None and was != thing.pose.position:
                velocity = (_array(thing.pose.position) - _array(was)) / seconds
                if np.linalg.norm(velocity) < FASTEST:
                    self._velocities[thing.id] = velocity

    def objects(self, ago: float, now: int) -> Sequence[WorldObject]:
        """Where they were some time before it was last told [s]; now is a stamp [ns]."""
        if self._last is None:
            return []
        if ago == 0 or not self._velocities or (now - self._last.header.stamp) * 1e-9 > OLDEST:
            return self._last.objects
        return [self._moved(thing, ago) for thing in self._last.objects]

    def _moved(self, thing: WorldObject, ago: float) -> WorldObject:
        velocity = self._velocities.get(thing.id)
        if velocity is None:
            return thing
        x, y, z = (_array(thing.pose.position) - ago * velocity).tolist()
        return thing.model_copy(update={"pose": thing.pose.model_copy(update={"position": Vector3(x=x, y=y, z=z)})})


def joints_ago(state: JointState | None, ago: float) -> JointState | None:
    """A state of joints as it was some time ago [s], by its velocities."""
    if state is None or ago == 0 or not any(state.velocity):
        return state
    position = [q - ago * dq for q, dq in zip(state.position, state.velocity, strict=True)]
    return state.model_copy(update={"position": position})


def times(exposure: float, count: int) -> Iterator[float]:
    """How long before the end of an exposure [s] each of so many pictures of it was; a single one is of the end."""
    for number in range(count):
        yield 0.0 if count == 1 else exposure * (count - 1 - number) / (count - 1)


def _array(point: Vector3) -> Array:
    return np.array([point.x, point.y, point.z])
