"""A simulated camera from the world to the pixels: renderer, lens, sensor, and where it is while things move."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from common.config import Light, RobotConfig, Scenery, Surroundings, Tunable
from common.messages import CameraInfo, Header, JointState, WorldObjects
from common.perception.mounted import Mounted
from common.perception.pinhole import Pinhole
from common.sim.interface import load_renderer
from common.sim.lens import Lens
from common.sim.motion_blur import Movement, joints_before, times
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
        self._mounted = Mounted(self._lens.drawn, self._model() if around.camera.mount else None)
        self._camera = around.camera
        self._lit = self._light()
        self._renderer = load_renderer(around, self._lit, self._model, plain=plain, camera=self._mounted.at(),
                                       arm=arm)
        self._sensor, self._movement = Sensor(config, rng), Movement()
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
        """Whether to `shoot` may take longer than a moment."""
        return self._config.sub_exposures > 1 or self._renderer.takes_long(truth.objects)

    def shoot(self, truth: WorldObjects, joints: JointState | None, now: int) -> View:
        """The picture that comes out, and the depth of the world as it is at the end of the exposure, without noise.

        Args:
            truth: where everything is.
            joints: the state of the arm.
            now: the end of the exposure, a stamp [ns].
        """
        lit = self._light()
        if lit != self._lit:
            self._lit = lit
            self._renderer.light(lit)
        self._movement.take(truth)
        views = []
        for ago in times(self._sensor.exposure, self._config.sub_exposures):
            state = joints_before(joints, ago)
            if self.moves and state is not None:
                q = self._model().order(state.name, state.position)
                if q is not None:
                    self._renderer.look_from(self._mounted.at(q))
            views.append(self._renderer.see(self._movement.objects(ago, now), state))
        pictures = [self._lens.bend(view.colour) for view in views]
        picture = self._lens.come_out(self._sensor.expose(pictures, self._renderer.level))
        return View(picture, views[-1].depth)
