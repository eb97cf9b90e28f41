"""The other arm as a planner sees it: boxes around its links, while it follows no goal."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from common import topics
from common.config import Arms, load_cell
from common.messages import Header, JointState, MotionStatus
from common.planning.robot_geometry import shape_corners
from common.process.other_arms import ArmBoxes, OtherArms
from common.robot.model import RobotModel
from common.robot.transforms import invert, pose_to_matrix
from common.transport.local import LocalNetwork

CELL = load_cell(str(Path(__file__).parents[2] / "data" / "two_arms.yaml"))
RIGHT = RobotModel.load(CELL.robots["right"])


def state(q: np.ndarray) -> JointState:
    zeros = [0.0] * len(q)
    return JointState(header=Header(), name=list(RIGHT.joint_names), position=q.tolist(), velocity=zeros, effort=zeros)


@pytest.mark.parametrize("seed", range(3))
def test_boxes_contain_every_corner_of_the_collision_shapes(seed: int) -> None:
    q = np.random.default_rng(seed).uniform(RIGHT.lower, RIGHT.upper)
    geometry = RIGHT.reduced(RIGHT.full_geometry())[1]
    data, placed = RIGHT.model.createData(), geometry.createData()
    pin.updateGeometryPlacements(RIGHT.model, data, geometry, placed, q)
    boxes = ArmBoxes("right", RIGHT).at(state(q), None)
    assert [box.id.split("/")[0] for box in boxes] == ["right"] * len(geometry.geometryObjects)
    for item, where, box in zip(geometry.geometryObjects, placed.oMg, boxes, strict=True):
        mesh = hasattr(item.geometry, "vertices")
        points = np.array(item.geometry.vertices()) if mesh else shape_corners(item.geometry, pin.SE3.Identity())
        corners = points @ where.rotation.T + where.translation
        T = invert(pose_to_matrix(box.pose))
        assert (np.abs(corners @ T[:3, :3].T + T[:3, 3]) <= np.array(box.dimensions) / 2 + 1e-6).all()


async def test_other_arm_is_an_obstacle_while_it_follows_no_goal() -> None:
    network = LocalNetwork()
    left, right = network.bus(service="left_motion_planner"), network.bus(service="executor").of_arm("right")
    others = OtherArms(left.of_arm("left"), Arms(robots=CELL.robots, own="left"))
    joints, motion = right.writer(topics.JOINT_STATES), right.writer(topics.MOTION_STATUS)
    await others.load()
    assert others.obstacles() == []
    joints.put(state(RIGHT.named("home")))
    await others._states["right"].next()
    assert others.obstacles()
    motion.put(MotionStatus(id="a", state="active"))
    await others._motions["right"].next()
    assert others.obstacles() == []
