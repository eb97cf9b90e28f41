"""The kinematic world of one ball and the arm, stepped by hand: cell time passes only in `step`.

The same world, gripper, camera and layouts as a simulated cell, in one object and without processes.
"""

from functools import cache

import cv2
import numpy as np

from applications.policy.interface import Observation
from applications.policy.sources.settings import PolicyCell
from common.config import Cell, load_cell
from common.hardware.backends import load_hardware
from common.hardware.interface import Limits
from common.messages import Header, PlanningScene, PlanRequest, Vector3, WorldEdit
from common.perception.pinhole import Pinhole
from common.planning.pipeline import PlanningPipeline
from common.robot.model import RobotModel
from common.scene.fixtures import fixed_objects
from common.scene.workspace import configured_bounds
from common.sim.interface import GraspTolerances, load_renderer
from common.sim.simulated_cell import SimulatedCell, create_world

CYCLE = 0.01  # [s] between set-points, as of the executor
CAMERA_PERIOD = 0.1  # [s]
SIZE = 96  # [px] of the images
LIFTED = 0.10  # [m] that count as a success
CELL = "policy_panda"


@cache
def cell() -> Cell:
    """Return the resolved cell."""
    return load_cell(CELL)


@cache
def pipeline() -> PlanningPipeline:
    """Return the planners of the cell with their robot model."""
    return PlanningPipeline(RobotModel.load(cell().robot), cell().motion, cell().pipeline)


def policy_cell() -> PolicyCell:
    """Return what a source of a policy has to know about the cell."""
    robot = pipeline().robot
    return PolicyCell(robot.joint_names, ("camera",), (SIZE, SIZE), robot.config.gripper.max_width)


def scene() -> PlanningScene:
    """Return the planning scene that a policy's motions are checked against: the fixtures, not the ball."""
    return PlanningScene(header=Header(frame_id="world"), objects=fixed_objects(cell().world))


class SimulatedPick:
    """One ball on the table, and the arm.

    Attributes:
        now: cell time [s].
        robot: the model.
        q, dq: newest set-points (dof,) [rad], [rad/s].
        limits_broken: number of cycles with a position or velocity beyond a limit.
        contacts: number of cycles in which the arm touches itself or a fixture.
    """

    def __init__(self, seed: int, *, size: tuple[int, int] = (SIZE, SIZE)) -> None:
        """Lay out the ball by a seed, with the arm at rest at home; images have a `size` (width, height) [px]."""
        config, self.robot = cell(), pipeline().robot
        robot, self._size = self.robot, size
        start = robot.named("home")
        limits = Limits(tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration, None,
                        robot.jerk)
        bounds = configured_bounds({})
        self._world = create_world(config.world, seed, robot, config.grasp, bounds, GraspTolerances(),
                                   config.robot.gripper)
        self._hardware = load_hardware(config.robot, limits, start)
        self._cell = SimulatedCell(self._world, self._hardware, robot)
        self._renderer = load_renderer(config.world, config.world, lambda: [robot], plain=True,
                                       camera=Pinhole.from_config(config.world.camera))
        self.now, self.q, self.dq = 0.0, start.copy(), np.zeros(robot.dof)
        self.limits_broken = self.contacts = 0
        self._width = robot.config.gripper.max_width
        self._commanded = self._width
        self._start_height = self._ball.z
        self._check = pipeline().world(
            PlanRequest.model_validate({"id": "check", "goal": {"kind": "joints", "named": "home"}}), scene(), start)
        self._next_image, self._view = 0.0, None
        self._image = np.zeros((*size[::-1], 3), np.uint8)
        self.step(start)

    @property
    def width(self) -> float:
        """Measured width of the gripper [m]."""
        return self._width

    @property
    def _object(self):
        return self._world.objects(Header()).objects[0]

    @property
    def _ball(self) -> Vector3:
        return self._object.pose.position

    # --- ground truth: for the planner that demonstrates, and for the evaluation ---

    @property
    def ball(self) -> np.ndarray:
        """True center of the ball (3,) [m]."""
        return np.array([self._ball.x, self._ball.y, self._ball.z])

    @property
    def held(self) -> bool:
        """Whether the ball is in the fingers."""
        return self._object.state == "held"

    @property
    def lifted(self) -> bool:
        """Whether the ball is held, and higher by `LIFTED` than at the start."""
        return self.held and self._ball.z - self._start_height >= LIFTED

    def move_ball(self, x: float, y: float) -> None:
        """Put the ball somewhere else on the table [m]."""
        self._cell.edit(WorldEdit(op="move", id=self._object.id, position=Vector3(x=x, y=y, z=0.0)), self.now)
        self._start_height = self._ball.z

    # --- what a policy sees ---

    def observe(self) -> Observation:
        """Return the observation of this time with the newest image, which may be `CAMERA_PERIOD` old."""
        return Observation(round(self.now * 1e9), self.q.copy(), self.dq.copy(), self.robot.fk(self.q), self._width,
                           {"camera": self._image}, "pick the red ball")

    # --- what moves ---

    def command(self, width: float) -> None:
        """Command the fingers to a width [m], unless it is commanded already."""
        if width != self._commanded:
            self._commanded = width
            self._hardware.gripper.command(width, self.now, self.robot.config.gripper.effort)

    def place(self, q: np.ndarray, width: float) -> None:
        """Put the arm at rest at q (dof,) [rad], with fingers at a width [m]: another start of an episode."""
        self.q = np.asarray(q, float).copy()
        self._hardware.gripper.place(width)
        self._commanded = width
        self.step(self.q)

    def collides(self, q: np.ndarray) -> bool:
        """Return whether the arm touches itself or a fixture at q (dof,) [rad]."""
        return self._check.collides(q)

    def step(self, q: np.ndarray) -> None:
        """Write a set-point (dof,) [rad] and advance by one cycle."""
        robot, self.now = self.robot, self.now + CYCLE
        self.dq = (q - self.q) / CYCLE
        beyond = np.abs(self.dq) > 1.02 * robot.velocity
        self.limits_broken += bool(beyond.any()) or not robot.within_limits(q)
        if not np.array_equal(q, self.q):
            self.contacts += self.collides(q)
        self.q = q.copy()
        self._hardware.write(q, self.dq, self.now)
        self._cell.obstruct(q)
        reading = self._hardware.gripper.read(self.now)
        self._cell.step(self.now, q, reading)
        self._width = reading.width
        if self.now >= self._next_image:
            self._next_image = self.now + CAMERA_PERIOD
            view = self._renderer.render(self._world.objects(Header()).objects)
            if view is not self._view:  # an unchanged scene has the same view
                self._view = view
                self._image = cv2.resize(view.colour, self._size, interpolation=cv2.INTER_AREA)[..., ::-1].copy()
