"""The insertion cell for benchmarks: its executor over its physics in cycles of 10 ms, and its planner."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import load_cell
from common.control.executor import Executor
from common.control.force_sensing import ForceSensing
from common.control.wrench import Payload
from common.hardware.interface import Limits
from common.messages import (
    ExecuteRequest,
    ForceMotion,
    GripperCommand,
    Header,
    JointTrajectory,
    MotionStatus,
    PlanningScene,
    PlanRequest,
    PoseGoal,
)
from common.planning.pipeline import PlanningPipeline
from common.robot.model import RobotModel
from common.robot.tool_mass import described_tool
from common.robot.transforms import matrix_to_pose, tool_down
from common.scene.fixtures import fixed_objects
from common.sim.interface import load_world
from common.sim.simulated_cell import SimulatedCell
from drivers.mujoco.world import PhysicsWorld

Array = NDArray[np.float64]

PERIOD = 0.01  # [s] of control
PEG, MASS, GRASP = (0.48, -0.15), 0.12, 0.040  # [m] its place, [kg], [m] from its foot to the TCP
HALF_LENGTH = 0.035  # [m] of the peg
LONGEST = 120.0  # [s] of cell time for one motion


class Rig:
    """The executor of the cell, driven by hand. Nothing that decides reads the world.

    Attributes:
        after_cycle: called after each cycle.
        after_step: called with the time after each step of physics.
    """

    def __init__(self) -> None:
        """Start with the arm at home."""
        cell = load_cell("insertion")
        self.robot = robot = RobotModel.load(cell.robot)
        limits = Limits(tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration, None,
                        robot.jerk)
        start = robot.named("home")
        world = load_world(cell.world, cell.world.objects, None, cell.robot.gripper)
        assert isinstance(world, PhysicsWorld)
        arm = world.hardware(robot, limits, start)
        self.model, self.data = world.simulation[0].model, world.simulation[1]
        self.cell = world.simulation[0]
        tool = described_tool(robot)
        assert tool is not None and cell.robot.gripper is not None
        self.executor = Executor(
            arm, limits, start, gripper=cell.robot.gripper, kinematics=robot, period=PERIOD,
            world=SimulatedCell(world, arm, robot, simulator="mujoco", persisted=None, saver=None),
            force=ForceSensing(arm, robot, cell.robot.tcp_link, cell.robot.gripper, cell.robot.wrench,
                               Payload(tool[0], *tool[1].tolist())))
        self.executor.force_motions.task_present = True
        self.pipeline = PlanningPipeline(robot, cell.motion, cell.pipeline, seed=1)
        self.scene = PlanningScene(header=Header(stamp=1), objects=fixed_objects(cell.world))
        self.width = cell.robot.gripper.max_width  # of the fingers in plans [m]
        self.now, self._ids = 1.0, 0
        self.after_cycle: Callable[[], None] | None = None
        self.after_step: Callable[[float], None] | None = None
        self._observe(arm)
        self.wait(0.1)

    def _observe(self, arm: Any) -> None:
        """Call `after_step` after each step of physics, which the arm measures."""
        measure = arm.measure

        def measured() -> None:
            measure()
            if self.after_step is not None:
                self.after_step(self.data.time)

        arm.measure = measured

    # --- time -----------------------------------------------------------------------------------------------------

    def cycle(self) -> None:
        """Do one cycle of control."""
        self.now += PERIOD
        self.executor.cycle(Header(stamp=round(self.now * 1e9), frame_id="world"))
        if self.after_cycle is not None:
            self.after_cycle()

    def wait(self, seconds: float) -> None:
        """Let time pass [s]."""
        for _ in range(round(seconds / PERIOD)):
            self.cycle()

    # --- motions --------------------------------------------------------------------------------------------------

    def move(self, T: Array, straight: bool = False) -> None:
        """Move the TCP to a pose (4, 4) in world."""
        request = ExecuteRequest(id=self._id(), trajectory=self._plan(T, straight))
        status = self._finish(self.executor.execute(request, self.now))
        assert status.state == "succeeded", status.message

    def move_by_force(self, **fields: Any) -> MotionStatus:
        """Move by force straight down; the gripper and what it holds may touch everything."""
        end = self.robot.fk(self.executor.arm.set_point)
        end[2, 3] -= fields["max_distance"] + 1e-4
        touches = [(link, each.id) for link in self.robot.link_names for each in self.scene.objects]
        request = ForceMotion(id=self._id(), trajectory=self._plan(end, True, touches), frame="world", **fields)
        return self._finish(self.executor.move_by_force(request, self.now))

    def grip(self, width: float, mass: float = 0.0) -> None:
        """Move the fingers, and press with 70 N."""
        gripper = self.executor.gripper
        assert gripper is not None
        self.executor.command_gripper(GripperCommand(id=self._id(), width=width, effort=70.0, mass=mass), self.now)
        self.wait(0.1)
        while gripper.state.state == "active":
            self.cycle()

    def zero(self) -> None:
        """Zero the wrench at rest."""
        self.wait(0.5)
        self.executor.force.zero()

    def pick(self) -> None:
        """Grip and lift the peg, which is where the world file puts it."""
        self.grip(0.05)
        down = tool_down(*PEG, GRASP)
        above = down.copy()
        above[2, 3] += 0.1
        self.move(above)
        self.move(down, straight=True)
        self.grip(0.0, MASS)
        self.move(above, straight=True)
        self.width = 0.02

    def _plan(self, T: Array, straight: bool, touches: Sequence[tuple[str, str]] = ()) -> JointTrajectory:
        request = PlanRequest(id=self._id(), goal=PoseGoal(pose=matrix_to_pose(T)), straight=straight,
                              allowed_collisions=list(touches))
        found = self.pipeline.plan(request, self.scene, self.executor.arm.set_point, width=self.width)
        assert found.trajectory is not None, found.message
        return found.trajectory

    def _finish(self, status: MotionStatus) -> MotionStatus:
        assert status.state == "active", status.message
        end = self.now + LONGEST
        while self.executor.arm.goal:
            self.cycle()
            assert self.now < end, "the motion does not end"
        return self.executor.arm.status

    def _id(self) -> str:
        self._ids += 1
        return f"g{self._ids}"

    # --- truth ----------------------------------------------------------------------------------------------------

    def foot(self) -> Array:
        """Centre (3,) of the lower end of the peg [m], by the world."""
        T = self.cell.pose_of(self.data, "peg")
        return np.asarray(T[:3, 3] - HALF_LENGTH * T[:3, 2])

    def push_on(self, prefix: str, by_peg: bool) -> tuple[float, float]:
        """Sum of the normal forces on such fixtures [N], and the deepest penetration [m], of the peg or the gripper."""
        peg = self.cell.objects["peg"].body
        total, deepest, wrench = 0.0, 0.0, np.zeros(6)
        for index, contact in enumerate(self.data.contact):
            names = [self.model.geom(geom).name for geom in contact.geom]
            if any(name.startswith(f"fixture:{prefix}") for name in names) and by_peg == (
                    peg in self.model.geom_bodyid[contact.geom]):
                mujoco.mj_contactForce(self.model, self.data, index, wrench)
                total, deepest = total + float(wrench[0]), max(deepest, -float(contact.dist))
        return total, deepest

    def tcp_height(self) -> float:
        """Height of the TCP [m], by the world."""
        q = self.data.qpos[[self.cell.joints[name] for name in self.robot.joint_names]]
        return float(self.robot.fk(q)[2, 3])
