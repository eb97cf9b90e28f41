"""Motion sequences that take one ball to the container, as goals of the tool center point."""

from __future__ import annotations

import math
from dataclasses import dataclass

from applications.pick_place.choice import Pick, PickPlaceView
from applications.pick_place.grasping import RELEASED, Config
from common import messages as m
from common.config import GripperConfig
from common.planning.ik import FULL_POSE_DOF
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, tool_down, transform
from common.tasks.stages import Grip, Move, Place, Stage

OFF_WALLS = 0.003  # [m] between the walls and a falling object
ANY_YAW = 3.1  # [rad] a yaw tolerance this large allows any yaw


@dataclass(frozen=True)
class MotionSequences:
    """Creates sequences of stages from heights and tolerances; has no state."""

    p: Config
    gripper: GripperConfig

    def pick_and_place(self, cycle: Pick) -> list[Stage]:
        """Return above the ball, descend, close, lift, across, release; uses up one yaw of the cycle."""
        yaw = cycle.yaw = cycle.yaws.pop(0)
        x, y, z = cycle.target.position
        low = self.grasp_height(z)
        grasp = self._at((x, y, low), yaw)
        if self._takes_any and cycle.target.size is None:
            grasp = self._at((x, y, low), *next(
                (each for each in cycle.ranges if abs(math.remainder(yaw - each[0], 2 * math.pi)) <= each[1]),
                (yaw, 0.0)))
        above = self._region((x, y, low + self.p.grasp.approach_clearance), yaw)
        approach: list[Stage] = [
            Move("pre-grasp", "GRASPING", cycle, needs_full_plan=True, needs_fresh_image=True, goal=above),
            Move("descend", "GRASPING", cycle, goal=grasp, straight=True, needs_fresh_image=not self.p.world.on_hand),
        ]
        lifted = self._region((x, y, low + self.p.grasp.lift_height), yaw)
        carry: list[Stage] = [Move("lift", "GRASPING", cycle, goal=lifted, carries=True), self.across(cycle, yaw)]
        if self.p.joined:
            across = self.across(cycle, yaw)
            across.goal = _through(lifted, across.goal, self.p.grasp.lift_height / 2)
            across.fallback, carry = carry, [across]
        # A suction cup touches what it takes. After a failed joint plan each yaw is tried by itself.
        if self.p.joined and self.gripper.cup is None and (cycle.target.size is not None or not cycle.apart):
            grasps = self._grasps(cycle, (x, y, low))
            over: m.PoseGoal | m.GoalSet = above
            if cycle.target.size is not None:  # rotate the gripper to the box's yaw before descending around it
                over = m.GoalSet(goals=[each.model_copy(update={
                    "pose": each.pose.model_copy(update={"position": above.pose.position}),
                    "position_tolerance": above.position_tolerance}) for each in _each(grasps)])
            goal = _through(over, grasps, self.p.grasp.approach_clearance / 2)
            approach = [Move("pre-grasp", "GRASPING", cycle, needs_full_plan=True, needs_fresh_image=True, goal=goal,
                             fallback=approach)]
        cycle.apart = True
        return [*approach, self._close(cycle, yaw), *carry, self._release(cycle)]

    def _grasps(self, cycle: Pick, at: Place) -> m.PoseGoal | m.GoalSet:
        """Return the allowed grasps: clear yaws for a round object, else both rotations by half a turn."""
        ranges = [(cycle.yaw, 0.0), (cycle.yaw + math.pi, 0.0)]
        if cycle.ranges and (self.p.orient_yaw_tol_rad > ANY_YAW or self._takes_any):
            ranges = cycle.ranges
        goals = [self._at(at, middle, half) for middle, half in ranges]
        return goals[0] if len(goals) == 1 else m.GoalSet(goals=goals)

    def _at(self, at: Place, yaw: float, either_way: float = 0.0) -> m.PoseGoal:
        """Return the tool at a position, pointing down, at a yaw with a tolerance to either side [rad]."""
        return m.PoseGoal(pose=matrix_to_pose(tool_down(*at, yaw + self.turn)), yaw_tolerance=either_way,
                          tilt_tolerance=self.p.grasp.tilt(len(self.p.robot.joints)))

    @property
    def _takes_any(self) -> bool:
        """Whether the arm has too few joints to choose the tool's yaw, so that any clear yaw must do."""
        return len(self.p.robot.joints) < FULL_POSE_DOF

    def _close(self, cycle: Pick, yaw: float) -> Grip:
        cup = self.gripper.cup is not None
        return Grip("close", "GRASPING", cycle, width=0.0, holds=True, early=not cup, effort=cycle.target.grip_effort,
                    expected_width=self.gripper.held_width if cup else cycle.target.width(yaw),
                    width_tolerance=self.p.width_tolerance, mass=cycle.target.mass)

    def place_held(self, cycle: Pick, tcp: Place) -> list[Stage]:
        """Return the remaining stages for a ball that is held at `tcp`."""
        x, y, z = tcp
        height = self.grasp_height(self.p.world.table_height + self.p.world.ball_radius) + self.p.grasp.lift_height
        lift = Move("lift", "GRASPING", cycle, goal=self._region((x, y, height), 0.0), carries=True)
        return [*([lift] if z < height - 0.01 else []), self.across(cycle, 0.0), self._release(cycle)]

    def across(self, cycle: Pick, yaw: float) -> Move:
        """Return the motion above the lowest column of the container, with anywhere above it as the fallback."""
        box, wide = self.p.world.container, self.p.place_pos_tol
        anywhere = Move("across", "PLACING", cycle, goal=self._above((box.x, box.y), yaw, wide), carries=True)
        if cycle.over is None:
            return anywhere
        radius = max(self.p.world.ball_radius, cycle.target.radius)
        room = box.half_side - box.wall_thickness - radius - OFF_WALLS - wide / 4
        x, y = (middle + min(max(at - middle, -room), room) if room > 0 else middle
                for at, middle in zip(cycle.over, (box.x, box.y), strict=True))
        goal = self._above((x, y), yaw, wide / 2)
        goal.position_tolerance.z = wide
        return Move("across", "PLACING", cycle, goal=goal, carries=True, fallback=[anywhere])

    def _above(self, at: tuple[float, float], yaw: float, side: float) -> m.PoseGoal:
        above = self._region((*at, self.p.grasp.drop_z), yaw, side)
        if self._takes_any:
            above.tilt_tolerance = max(above.tilt_tolerance, RELEASED)
        return above

    def _release(self, cycle: Pick) -> Grip:
        return Grip("release", "PLACING", cycle, width=self.gripper.max_width, carries=True, holds=False,
                    early=self.gripper.cup is None)

    def open(self) -> Grip:
        """Return the stage that opens the fingers."""
        return Grip("open", "GRASPING", width=self.gripper.max_width)

    def retreat(self, view: PickPlaceView, contact: tuple[str, str] | None = None) -> Move:
        """Return a motion straight up; the fingers may touch the balls next to them."""
        x, y, z = view.tool
        reach = 4 * self.p.world.ball_radius
        near = [b.id for b in view.balls() if abs(b.position[0] - x) < reach and abs(b.position[1] - y) < reach]
        touches = [(link, ball) for link in self.gripper.links for ball in near]
        return Move("retreat", "GRASPING", goal=self._region((x, y, z + self.p.grasp.approach_clearance), 0.0),
                    carries=view.holding, touches=[*touches, *([contact] if contact else [])])

    def attach_pose(self, cycle: Pick) -> m.Pose:
        """Return the pose of the ball in the tool frame, whose z axis points down."""
        z = cycle.target.position[2]
        # Seen along the tool, which points down.
        turn = cycle.yaw + self.turn - cycle.target.yaw if cycle.target.size else 0.0
        T_tcp_object = transform(rpy_to_matrix(math.pi, 0.0, turn), (0.0, 0.0, self.grasp_height(z) - z))
        return matrix_to_pose(T_tcp_object) if cycle.target.size else m.Pose(
            position=m.Vector3(z=self.grasp_height(z) - z))

    @property
    def turn(self) -> float:
        """Rotation of the tool at yaw 0, where the fingers close along world y [rad]."""
        return math.pi / 2 if self.gripper.closing_axis == "x" else 0.0

    def grasp_height(self, z: float) -> float:
        """Return the height of the tool center point to grasp an object centered at z [m]; a cup takes its top."""
        if self.gripper.cup is not None:
            return 2 * z - self.p.world.table_height
        return self.p.grasp.height(z)

    def _region(self, at: Place, yaw: float, side: float | None = None) -> m.PoseGoal:
        """Return a region around a position with the tool pointing down, as wide as the parameters allow."""
        side = self.p.grasp_pos_tol if side is None else side
        return m.PoseGoal(
            pose=matrix_to_pose(tool_down(*at, yaw + self.turn)), position_tolerance=m.Vector3(x=side, y=side, z=side),
            tilt_tolerance=max(self.p.orient_tol_rad, self.p.grasp.tilt(len(self.p.robot.joints))),
            yaw_tolerance=math.pi if self._takes_any else self.p.orient_yaw_tol_rad,
        )


def _each(goal: m.PoseGoal | m.GoalSet) -> list[m.PoseGoal]:
    goals = goal.goals if isinstance(goal, m.GoalSet) else [goal]
    return [each for each in goals if isinstance(each, m.PoseGoal)]


def _through(first: m.PoseGoal | m.GoalSet, then: m.AnyGoal, radius: float) -> m.SequenceGoal:
    """Return both goals as one motion that blends the corner within a radius [m]."""
    assert isinstance(then, m.PoseGoal | m.GoalSet)
    return m.SequenceGoal(items=[m.SequenceItem(goal=first, blend_radius=radius), m.SequenceItem(goal=then)])
