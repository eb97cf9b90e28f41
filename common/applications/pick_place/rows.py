"""The stages of taking one ball to the container, as goals for the tool centre point."""

from __future__ import annotations

from dataclasses import dataclass

from common import messages as m
from common.applications.pick_place.parameters import PickPlaceParameters
from common.applications.pick_place.stages import Cycle, Grip, Move, Place, Stage, View
from common.config import Grasp, GripperConfig, Surroundings
from common.robot.transforms import matrix_to_pose, tool_down


@dataclass(frozen=True)
class Rows:
    """Builds rows of stages; knows heights and tolerances, nothing of what happens."""

    grasp: Grasp
    around: Surroundings
    gripper: GripperConfig
    parameters: PickPlaceParameters

    def pick_and_place(self, cycle: Cycle) -> list[Stage]:
        """Above the ball, straight down, close, up, across, release; uses up one yaw of the cycle."""
        yaw = cycle.yaws.pop(0)
        x, y, z = cycle.target.position
        low = self.grasp_height(z)
        return [
            self._move("pre-grasp", (x, y, low + self.grasp.approach_clearance), yaw, cycle),
            Move("descend", "GRASPING", m.PoseGoal(pose=matrix_to_pose(tool_down(x, y, low, yaw))), cycle,
                 straight=True, touches_target=True),
            Grip("close", "GRASPING", 0.0, cycle),
            self._move("lift", (x, y, low + self.grasp.lift_height), yaw, cycle, carries=True),
            *self._across(cycle, yaw),
        ]

    def place_held(self, cycle: Cycle, tcp: Place) -> list[Stage]:
        """What is left to do with a ball that is in the hand at `tcp`."""
        x, y, z = tcp
        height = self.grasp_height(self.around.table_height + self.around.ball_radius) + self.grasp.lift_height
        lift = [self._move("lift", (x, y, height), 0.0, cycle, carries=True)] if z < height - 0.01 else []
        return [*lift, *self._across(cycle, 0.0)]

    def _across(self, cycle: Cycle, yaw: float) -> list[Stage]:
        box = self.around.container
        across = self._move("across", (box.x, box.y, self.grasp.drop_z), yaw, cycle, carries=True)
        across.state = "PLACING"
        return [across, Grip("release", "PLACING", self.gripper.max_width, cycle)]

    def open(self, cycle: Cycle | None) -> Grip:
        """Fingers apart."""
        return Grip("open", "GRASPING", self.gripper.max_width, cycle)

    def home(self, view: View) -> Move:
        """To the recovery pose, with whatever is held."""
        return Move("home", "HOMING", m.JointGoal(named="home"), carries=view.holding)

    def retreat(self, view: View, contact: tuple[str, str] | None = None) -> Move:
        """Up from where the hand is, whatever its fingers touch there now."""
        x, y, z = view.tcp or (0.0, 0.0, 0.0)
        reach = 4 * self.around.ball_radius
        near = [b.id for b in view.balls() if abs(b.position[0] - x) < reach and abs(b.position[1] - y) < reach]
        move = self._move("retreat", (x, y, z + self.grasp.approach_clearance), 0.0, None, carries=view.holding)
        move.allowed = [(link, ball) for link in self.gripper.links for ball in near]
        if contact is not None:
            move.allowed.append(contact)
        return move

    def attach_pose(self, cycle: Cycle) -> m.Pose:
        """Where the ball will lie in the tool frame, whose z axis points down."""
        z = cycle.target.position[2]
        return m.Pose(position=m.Vector3(z=self.grasp_height(z) - z))

    def grasp_height(self, z: float) -> float:
        """Height of the tool centre point at the grasp of a ball whose centre is at z [m]."""
        return max(z + self.grasp.grasp_clearance, self.grasp.min_grasp_z)

    def _move(self, name: str, at: Place, yaw: float, cycle: Cycle | None, *, carries: bool = False) -> Move:
        p = self.parameters
        side = p.place_pos_tol if name == "across" else p.grasp_pos_tol
        goal = m.PoseGoal(
            pose=matrix_to_pose(tool_down(*at, yaw)), position_tolerance=m.Vector3(x=side, y=side, z=side),
            tilt_tolerance=p.orient_tol_rad, yaw_tolerance=p.orient_yaw_tol_rad,
        )
        return Move(name, "GRASPING", goal, cycle, carries=carries)
