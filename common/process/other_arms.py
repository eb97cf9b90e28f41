"""The other arms of a cell as a planner sees them: boxes around their links at their present posture."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common import topics
from common.arms import arms_topic
from common.config import Arms, RobotConfig
from common.messages import CollisionObject, Color, JointState, PlanningScene
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose, pose_to_matrix, transform
from common.tasks.handover import Partner
from common.topics import Topic
from common.transport.bus import Bus

Array = NDArray[np.float64]

GREY = Color(r=0.6, g=0.6, b=0.65, a=0.8)
THINNEST = 0.001  # [m] of a box
SILENT = 0.5  # [s] wall: without joint states for longer, what an arm holds is unknown


@dataclass(frozen=True)
class Box:
    """A box around a shape of a link: its sides [m], and its center (4, 4) in the frame of the joint."""

    link: str
    joint: int
    T_joint_box: Array
    sides: list[float]


class ArmBoxes:
    """Boxes around the links of an arm."""

    def __init__(self, name: str, robot: RobotModel) -> None:
        """Measure the collision shapes of an arm.

        Raises:
            ConfigError: a mesh is missing.
        """
        self._name, self._robot = name, robot
        self._data = robot.model.createData()
        geometry = robot.reduced(robot.full_geometry())[1]
        self._boxes: list[Box] = []
        for item in geometry.geometryObjects:
            item.geometry.computeLocalAABB()
            low, high = np.array(item.geometry.aabb_local.min_), np.array(item.geometry.aabb_local.max_)
            self._boxes.append(Box(
                robot.model.frames[item.parentFrame].name, item.parentJoint,
                item.placement.homogeneous @ transform(np.eye(3), (low + high) / 2),
                np.maximum(high - low, THINNEST).tolist()))

    def at(self, joints: JointState, scene: PlanningScene | None) -> list[CollisionObject]:
        """Return its links, and what it carries in its own scene, at a joint state; nothing if that is incomplete."""
        q = self._robot.order(joints.name, joints.position)
        if q is None:
            return []
        pin.forwardKinematics(self._robot.model, self._data, q)
        found = [self._object(f"{box.link}/{number}", self._data.oMi[box.joint].homogeneous @ box.T_joint_box,
                              shape="box", dimensions=box.sides) for number, box in enumerate(self._boxes)]
        poses = self._robot.link_poses(q)
        for held in scene.attached if scene is not None else ():
            if held.link in poses:
                one = held.object
                found.append(self._object(one.id, poses[held.link] @ pose_to_matrix(one.pose), shape=one.shape,
                                          dimensions=one.dimensions, outline=one.outline))
        return found

    def _object(self, name: str, T_world_object: Array, **shape: object) -> CollisionObject:
        return CollisionObject.model_validate({
            "id": f"{self._name}/{name}", "role": "fixture", "pose": matrix_to_pose(T_world_object), "color": GREY,
            **shape})


class OtherArm:
    """Reads what another arm of the cell does and holds, in world."""

    def __init__(self, bus: Bus, name: str, robot: RobotConfig, status: Topic[Any] | None = None) -> None:
        """Subscribe to its state, and to the status of its task."""
        own = bus.of_arm(name)
        self.name, self._robot, self._clock = name, RobotModel.load(robot), bus.clock
        self._joints, self._scene = own.reader(topics.JOINT_STATES), own.reader(topics.PLANNING_SCENE)
        self._gripper, self._motion = own.reader(topics.GRIPPER_STATE), own.reader(topics.MOTION_STATUS)
        self._status = None if status is None else bus.reader(arms_topic(status, name))

    def now(self) -> Partner | None:
        """Return its newest state; None while something is unknown or its joint states are missing."""
        joints, gripper, motion = self._joints.latest, self._gripper.latest, self._motion.latest
        q = None if joints is None else self._robot.order(joints.name, joints.position)
        if joints is None or q is None or gripper is None or motion is None or (
                self._clock.now() - joints.header.stamp * 1e-9 > SILENT * self._clock.speed):
            return None
        poses = self._robot.link_poses(q)
        attached = () if self._scene.latest is None else self._scene.latest.attached
        held = [each.object.model_copy(update={
            "pose": matrix_to_pose(poses[each.link] @ pose_to_matrix(each.object.pose))})
            for each in attached if each.link in poses]
        return Partner(self.name, self._robot.fk(q), gripper, motion, held[0] if held else None,
                       None if self._status is None else self._status.latest)


class OtherArms:
    """Reads where the other arms of a cell are."""

    def __init__(self, bus: Bus, arms: Arms) -> None:
        """Subscribe to joint states, motions and scenes of the arms that are not the service's own."""
        self._robots: Mapping[str, RobotConfig] = {
            name: robot for name, robot in arms.robots.items() if arms.own and name != arms.own}
        views = {name: bus.of_arm(name) for name in self._robots}
        self._states = {name: view.reader(topics.JOINT_STATES) for name, view in views.items()}
        self._motions = {name: view.reader(topics.MOTION_STATUS) for name, view in views.items()}
        self._scenes = {name: view.reader(topics.PLANNING_SCENE) for name, view in views.items()}
        self._boxes: dict[str, ArmBoxes] = {}

    async def load(self) -> None:
        """Load the models of the other arms.

        Raises:
            ConfigError: a robot file does not fit its description.
        """
        for name, robot in self._robots.items():
            model = await asyncio.to_thread(RobotModel.load, robot)
            self._boxes[name] = await asyncio.to_thread(ArmBoxes, name, model)

    def obstacles(self) -> list[CollisionObject]:
        """Return the links of the arms that follow no goal: of one that moves, the coordinator proves each motion."""
        found: list[CollisionObject] = []
        for name, boxes in self._boxes.items():
            state, motion = self._states[name].latest, self._motions[name].latest
            if state is not None and (motion is None or motion.state != "active"):
                found += boxes.at(state, self._scenes[name].latest)
        return found
