"""The marker for a goal of the tool."""

from __future__ import annotations

import numpy as np
import pytest

from common.robot.transforms import matrix_to_pose, pose_to_matrix, rpy_to_matrix, transform
from tests.page.scene_cell import Stage, in_world

GOAL = matrix_to_pose(transform(rpy_to_matrix(3.0, 0.2, 0.5), (0.5, 0.1, 0.4)))


def test_marker_appears_where_the_tool_is(panda: Stage) -> None:
    q = panda.robot.named("home") + 0.2
    panda.joints(q)
    assert not panda.view.goal.visible
    panda.view.goal_marker(True)
    assert panda.view.goal.visible
    np.testing.assert_allclose(pose_to_matrix(panda.view.goal_pose), panda.robot.fk(q), atol=1e-6)


def test_marker_stays_where_it_was_put(panda: Stage) -> None:
    panda.view.goal_marker(True)
    panda.view.goal.pose = GOAL
    panda.view.goal_marker(True)
    np.testing.assert_allclose(pose_to_matrix(panda.view.goal_pose), pose_to_matrix(GOAL), atol=1e-9)


def test_gripper_in_the_marker_is_where_it_would_be(panda: Stage) -> None:
    panda.view.goal_marker(True)
    panda.view.goal.pose = matrix_to_pose(panda.robot.fk(panda.robot.named("home")))
    links = panda.robot.link_poses(panda.robot.named("home"))
    shown = [node for name, node in panda.server.scene._handle_from_node_name.items() if name.startswith("/goal/")]
    poses = [in_world(panda.server, node) for node in shown]
    assert any(np.allclose(pose, links["panda_hand"], atol=1e-5) for pose in poses)
    assert not any(np.allclose(pose, links["panda_link5"], atol=1e-5) for pose in poses)


@pytest.mark.parametrize(
    ("position", "wxyz"),
    [((1e9, 0, 0), (1, 0, 0, 0)), ((0, 0, 0.5), (0, 0, 0, 0)), ((np.nan, 0, 0), (1, 0, 0, 0))],
)
def test_marker_that_a_browser_gave_no_pose_goes_back(
    panda: Stage, position: tuple[float, ...], wxyz: tuple[float, ...]
) -> None:
    panda.view.goal_marker(True)
    panda.view.goal.pose = GOAL
    before = panda.view.goal_pose
    node = panda.view.goal._node
    node._impl.position[:], node._impl.wxyz[:] = position, wxyz  # as a message of a browser does
    assert panda.view.goal_pose == before
    np.testing.assert_allclose(node.position, (0.5, 0.1, 0.4))
