"""Publishes the robot's description and the poses of its links: tf from joint states, tf_static for fixed frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from pydantic import Field

from common import topics
from common.config import Parameters, RobotConfig, Surroundings, Tunable
from common.messages import JointState, RobotDescription, TFMessage, TransformStamped
from common.perception.pinhole import camera_in_mount, mount_links
from common.process.service import main
from common.robot.model import RobotModel
from common.robot.transforms import pose_fields
from common.transport.bus import Bus

MAX_RATE = 250.0  # per second of wall time
WORLD = "world"


class Config(Parameters):
    """Publication rate."""

    robot: RobotConfig
    surroundings: Surroundings
    rate: Tunable[float] = Field(50.0, ge=1, le=250, description="largest rate of tf messages, cell time [Hz]")


def stamped(parent: str, child: str, T_parent_child: NDArray[np.float64], stamp: int) -> TransformStamped:
    """Return the pose of child in parent as a message."""
    return TransformStamped.model_validate(_fields(parent, child, pose_fields(T_parent_child), stamp))


def _fields(parent: str, child: str, pose: dict[str, dict[str, float]], stamp: int) -> dict[str, object]:
    return {"header": {"stamp": stamp, "frame_id": parent}, "child_frame_id": child, "transform": pose}


class LinkFrames:
    """The robot's links as a tree of frames, each in the frame of its parent link."""

    def __init__(self, robot: RobotModel) -> None:
        """Determine which links move relative to their parents and which are fixed to them."""
        self._robot = robot
        model = robot.full_model
        joint = {frame.name: frame.parentJoint for frame in model.frames if frame.type == pin.FrameType.BODY}
        self.root = next(link for link in robot.link_names if link not in robot.link_parents)
        self.T_world_root = robot.link_poses(robot.named("home"))[self.root]
        self._fixed = [link for link, parent in robot.link_parents.items() if joint[link] == joint[parent]]
        self._moving = [link for link in robot.link_parents if link not in self._fixed]

    def fixed(self, stamp: int) -> list[TransformStamped]:
        """Return the transforms of links that are fixed to their parents, such as the tool centre point."""
        transforms = self._transforms(self._fixed, self._robot.named("home"), None, stamp)
        return TFMessage.model_validate({"transforms": transforms}).transforms

    def moving(self, state: JointState) -> TFMessage | None:
        """Return the transforms of moving links at a joint state; None if a joint of the arm is missing.

        For publication only: it is not validated, as its numbers are computed here, and contains plain fields.
        """
        q = self._robot.order(state.name, state.position)
        if q is None:
            return None
        locked = self._robot.config.locked_joints
        others = {name: value for name, value in zip(state.name, state.position, strict=True) if name in locked}
        unchecked: dict[str, Any] = {"transforms": self._transforms(self._moving, q, others, state.header.stamp)}
        return TFMessage.model_construct(**unchecked)

    def _transforms(
        self, links: list[str], q: NDArray[np.float64], others: dict[str, float] | None, stamp: int
    ) -> list[dict[str, object]]:
        poses = self._robot.poses_in_parents(links, q, others)
        return [
            _fields(self._robot.link_parents[link], link, {
                "position": {"x": px, "y": py, "z": pz}, "orientation": {"x": x, "y": y, "z": z, "w": w},
            }, stamp)
            for link, (px, py, pz, x, y, z, w) in zip(links, poses, strict=True)
        ]


def description(robot: RobotModel, stamp: int) -> RobotDescription:
    """Return the description of the arm for clients that move it."""
    config, gripper = robot.config, robot.config.gripper
    return RobotDescription.model_validate({
        "header": {"stamp": stamp}, "joints": robot.joint_names, "lower": robot.lower.tolist(),
        "upper": robot.upper.tolist(), "velocity": robot.velocity.tolist(), "tcp": config.tcp_link,
        "flange": robot.flange_link,
        "named_poses": {name: list(robot.named(name)) for name in config.named_poses},
        "gripper": gripper is not None, "fingers": gripper.links if gripper else [],
        "gripper_width": gripper.max_width if gripper else 0.0})


async def run(bus: Bus, config: Config) -> None:
    """Publish until cancelled."""
    joints = bus.reader(topics.JOINT_STATES)
    tf, tf_static = bus.writer(topics.TF), bus.writer(topics.TF_STATIC)
    robot, descriptions = RobotModel.load(config.robot), bus.writer(topics.ROBOT_DESCRIPTION)
    frames, stamp = LinkFrames(robot), bus.header().stamp
    descriptions.put(description(robot, stamp))
    base = stamped(WORLD, frames.root, frames.T_world_root, stamp)
    mounts = mount_links(config.surroundings, robot)
    cameras = [
        stamped(mounts.get(name, WORLD), camera.frame, camera_in_mount(camera), stamp)
        for name, camera in config.surroundings.cameras.items()
    ]
    fixed = [base, *cameras, *frames.fixed(stamp)]
    tf_static.put(TFMessage(transforms=fixed))
    await bus.ready()
    newest, warned = 0, False
    async for state in joints:
        # A message that is a little early still counts: otherwise jitter would halve the rate.
        least_ns = 0.75e9 * bus.clock.speed / bus.clock.wall_rate(config.rate, MAX_RATE)
        if 0 <= state.header.stamp - newest < least_ns:
            continue
        newest = state.header.stamp
        transforms = frames.moving(state)
        if transforms is not None:
            tf.put(transforms)
        elif not warned:
            bus.log.warning("joint_states has only %s: a joint of the arm is missing", ", ".join(state.name))
        warned = transforms is None


if __name__ == "__main__":
    main(run, Config)
