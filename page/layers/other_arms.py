"""The other arms of a cell with several: each page is of one arm, and shows where the others are."""

from __future__ import annotations

from typing import Any

from common import topics
from common.arms import arms_topic
from common.config import Arms, RobotConfig
from common.topics import Topic
from page.layers import Layer, Layers


class OtherArm(Layer):
    """The visual shapes of another arm."""

    robot: RobotConfig  # set in a class for each arm

    def build(self) -> None:
        """Add the meshes at the home pose."""
        from common.robot.model import RobotModel
        from common.robot.visual_meshes import visual_pieces
        from page.figure import Figure, LinkPoses  # slow to import, and needed with a scene only

        model = RobotModel.load(self.robot)
        self.poses = LinkPoses(model)
        self.figure = Figure(self.scene, f"{self.root}/links", visual_pieces(model), self.poses)

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Follow the joint states."""
        self.poses.update(message.name, message.position)
        self.figure.follow()


def other_arms(arms: Arms) -> Layers:
    """Return a layer for each arm but the page's own, by name."""
    return {f"arm_{name}": type("OtherArm", (OtherArm,), {
        "NAME": f"arm_{name}", "LABEL": f"Arm {name}", "TOPICS": (arms_topic(topics.JOINT_STATES, name),),
        "robot": robot}) for name, robot in arms.robots.items() if arms.own and name != arms.own}
