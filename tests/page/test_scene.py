"""The complete scene: robot, objects, layers, goal marker; nothing is sent without a change or without a page."""

from typing import Any

import numpy as np
import pytest
import viser

from applications.outlining.topics import Contours, OutlinePoints
from applications.pick_place.topics import VALIDATED_TARGETS
from common import messages as m
from common import topics
from common.application import find_application
from common.errors import UnknownName
from common.robot.finger_joints import finger_positions
from common.robot.transforms import matrix_to_pose, pose_to_matrix, rpy_to_matrix, transform
from common.scene.fixtures import fixed_objects
from page.layers import find_layers
from tests.page.scene_cell import WORLD, Stage, around_of, at, ball, in_world, is_shown, scene_of

GOAL = matrix_to_pose(transform(rpy_to_matrix(3.0, 0.2, 0.5), (0.5, 0.1, 0.4)))


def link_pose(stage: Stage, link: str) -> Any:
    return in_world(stage.server, stage.layer("robot").figure.links[link])


def targets(x: float, y: float) -> m.PoseArray:
    return m.PoseArray(header=WORLD, poses=[at(x, y, 0.03)])


@pytest.mark.parametrize("cell", ["panda", "ur5"])
def test_links_and_fingers_have_the_poses_of_forward_kinematics(server: viser.ViserServer, cell: str) -> None:
    stage = Stage(server, cell)
    gripper = stage.robot.config.gripper
    for share, width in ((0.0, 0.02), (0.4, 0.07)):
        q = stage.robot.named("home") + share * (stage.robot.lower - stage.robot.named("home"))
        fingers = dict(zip(gripper.joints, finger_positions(gripper, width), strict=True))
        stage.joints(q, fingers)
        links = stage.robot.link_poses(q, fingers)
        for link in stage.layer("robot").figure.links:
            np.testing.assert_allclose(link_pose(stage, link), links[link], atol=1e-6, err_msg=link)


def test_unknown_joints_are_ignored(panda: Stage) -> None:
    q = panda.robot.named("home") + 0.1
    panda.joints(q, {"turntable_joint": 1.0})
    panda.say(topics.JOINT_STATES, m.JointState(header=WORLD, name=["other"], position=[1.0]))
    np.testing.assert_allclose(panda.view.stage.poses.pose("panda_hand_tcp")[0], panda.robot.fk(q)[:3, 3], atol=1e-6)


def test_nothing_is_sent_without_a_change(panda: Stage) -> None:
    thing = m.WorldObject(id="ball_1", shape="sphere", size=m.Vector3(x=0.06, y=0.06, z=0.06), pose=at(0.4, 0.1, 0.03))
    messages = {
        topics.JOINT_STATES: panda.joint_state([0.1] * 3 + [-1.0] + [0.1] * 3), VALIDATED_TARGETS: targets(0.4, 0.1),
        topics.PLANNING_SCENE: scene_of(*fixed_objects(around_of("panda")), ball("a", at(0.4, 0.1, 0.03))),
        topics.SCENE_OBJECTS: m.WorldObjects(header=WORLD, objects=[thing]),
    }

    def publish_all(stamp: int) -> None:
        for topic, message in messages.items():
            panda.say(topic, message.model_copy(update={"header": m.Header(stamp=stamp, frame_id="world")}))

    panda.show("truth", True)
    with panda.sent() as first:
        publish_all(1)
    with panda.sent() as again:
        publish_all(2)
        panda.say(VALIDATED_TARGETS, targets(0.4003, 0.0996))  # noise of detections
    assert first and not again


def test_without_a_page_nothing_is_sent_and_then_the_newest_of_all(panda: Stage) -> None:
    panda.watched = False
    q = panda.robot.named("home") + 0.2
    with panda.sent() as sent:
        for joints in (q - 0.1, q):
            panda.joints(joints)
        panda.say(topics.PLANNING_SCENE, scene_of(ball("a", at(0.4, 0.1, 0.03))))
        panda.say(VALIDATED_TARGETS, targets(0.4, 0.1))
    assert not sent
    panda.watched = True
    panda.refresh()
    assert panda.layer("objects").node("a") is not None
    np.testing.assert_allclose(link_pose(panda, "panda_hand"), panda.robot.link_poses(q)["panda_hand"], atol=1e-6)


def test_layers_are_shown_and_hidden(panda: Stage) -> None:
    assert list(panda.view.layers) == list(find_layers(find_application("pick_place")))
    panda.joints(panda.robot.named("home"))
    hand = panda.layer("robot").figure.links["panda_hand"]
    for on in (True, False, True):
        panda.show("robot", on)
        assert is_shown(panda.server, hand) is on is panda.view.is_visible("robot")


def test_layers_start_as_configured_and_unknown_ones_are_rejected(server: viser.ViserServer) -> None:
    view = Stage(server, "panda", shown={"truth": True, "workspace": False}).view
    assert view.is_visible("truth") and not view.is_visible("workspace") and view.is_visible("robot")
    with pytest.raises(UnknownName, match=r"layer 'truht'.*'truth'"):
        view.set_shown("truht", True)
    with pytest.raises(UnknownName, match="choices: camera, collision_shapes, compared, fixtures"):
        Stage(server, "panda", shown={"roboter": True})


# --- planning scene ---


def test_objects_are_added_moved_changed_and_removed(panda: Stage) -> None:
    panda.say(topics.PLANNING_SCENE, scene_of(*fixed_objects(around_of("panda")), ball("a", at(0.4, 0.1, 0.03))))
    node, table = panda.layer("objects").node("a"), panda.layer("fixtures").node("table")
    assert isinstance(node, viser.IcosphereHandle) and node.radius == 0.03 and node.color == (255, 36, 36)
    assert isinstance(table, viser.BoxHandle) and table.dimensions == (1.0, 1.0, 0.05)
    panda.say(topics.PLANNING_SCENE, scene_of(ball("a", at(0.5, 0.2, 0.03))))
    assert panda.layer("objects").node("a") is node and panda.layer("fixtures").node("table") is None
    np.testing.assert_allclose(in_world(panda.server, node)[:3, 3], [0.5, 0.2, 0.03])
    larger = ball("a", at(0.5, 0.2, 0.03)).model_copy(update={"dimensions": [0.05]})
    panda.say(topics.PLANNING_SCENE, scene_of(larger))
    assert panda.layer("objects").node("a").radius == 0.05
    panda.say(topics.PLANNING_SCENE, scene_of())
    assert panda.layer("objects").node("a") is None


def test_attached_object_moves_with_its_link_and_one_of_an_unknown_link_is_left_out(panda: Stage) -> None:
    held = ball("held", at(0.01, 0.0, 0.02), role="attached")
    panda.say(topics.PLANNING_SCENE, scene_of(held={"panda_hand_tcp": held, "third_hand": ball("b", at(0, 0, 0))}))
    assert panda.layer("objects").node("b", "third_hand") is None
    for offset in (0.0, 0.3):
        q = panda.robot.named("home") + offset
        panda.joints(q)
        node = panda.layer("objects").node("held", "panda_hand_tcp")
        np.testing.assert_allclose(
            in_world(panda.server, node), panda.robot.fk(q) @ pose_to_matrix(held.pose), atol=1e-6)
    panda.show("robot", False)
    assert is_shown(panda.server, node)
    panda.say(topics.PLANNING_SCENE, scene_of(ball("held", at(0.5, 0.2, 0.03))))  # released
    assert panda.layer("objects").node("held", "panda_hand_tcp") is None
    np.testing.assert_allclose(in_world(panda.server, panda.layer("objects").node("held"))[:3, 3], [0.5, 0.2, 0.03])


@pytest.mark.parametrize("degenerate", [[(0.1, 0.1)] * 3, [(0.0, 0.0), (0.1, 0.0), (0.2, 0.0)]])
def test_prism_has_its_size_and_a_degenerate_one_is_left_out(ur5: Stage, degenerate: list[tuple[float, float]]) -> None:
    def show(outline: list[tuple[float, float]]) -> Any:
        ur5.say(topics.PLANNING_SCENE, scene_of(m.CollisionObject(
            id="a", role="target", shape="prism", dimensions=[0.06], pose=at(0.5, 0, 1.03), outline=outline)))
        return ur5.layer("objects").node("a")

    node = show([(-0.02, -0.01), (0.04, -0.01), (0.04, 0.03), (-0.02, 0.03)])
    np.testing.assert_allclose(node.vertices.min(axis=0), [-0.02, -0.01, -0.03], atol=1e-6)
    np.testing.assert_allclose(node.vertices.max(axis=0), [0.04, 0.03, 0.03], atol=1e-6)
    assert show(degenerate) is None


@pytest.mark.parametrize("cell", ["panda", "ur5"])
def test_empty_messages_do_no_harm(server: viser.ViserServer, cell: str) -> None:
    stage = Stage(server, cell)
    for name in stage.view.layers:
        stage.show(name, True)
    empty: dict[type[m.Message], m.Message] = {
        m.JointState: m.JointState(header=WORLD, name=[], position=[]), m.PlanningScene: scene_of(),
        m.Rejections: m.Rejections(header=WORLD, rejected=[]), m.MarkerArray: m.MarkerArray(header=WORLD, markers=[]),
        m.JointTrajectory: m.JointTrajectory(joint_names=["a"], points=[]), m.TFMessage: m.TFMessage(transforms=[]),
        Contours: Contours(header=WORLD, width=64, height=48), m.PoseArray: m.PoseArray(),
        m.MotionStatus: m.MotionStatus(),
        OutlinePoints: OutlinePoints(), m.WorldObjects: m.WorldObjects(),
        m.PointCloud2: m.PointCloud2(header=WORLD, height=1, width=1, row_step=16, data=b""),
    }
    for topic in {topic for layer in stage.view.layers.values() for topic in layer.TOPICS}:
        if topic.message is not m.CameraInfo:
            stage.say(topic, empty[topic.message])
    stage.view.show_image(topics.CAMERA_IMAGE, np.zeros((48, 64, 3), np.uint8))
    stage.view.play(m.JointTrajectory(joint_names=["a"], points=[]))
    q = stage.robot.named("home")
    stage.joints(q)
    last = list(stage.layer("robot").figure.links)[-1]
    np.testing.assert_allclose(link_pose(stage, last), stage.robot.link_poses(q)[last], atol=1e-6)


# --- goal marker ---


def test_goal_marker_appears_at_the_tool_with_its_gripper_and_stays_where_it_was_put(panda: Stage) -> None:
    q = panda.robot.named("home") + 0.2
    panda.joints(q)
    assert not panda.view.goal.visible
    panda.view.show_goal_marker(True)
    assert panda.view.goal.visible
    np.testing.assert_allclose(pose_to_matrix(panda.view.goal_pose), panda.robot.fk(q), atol=1e-6)
    shown = [node for name, node in panda.server.scene._handle_from_node_name.items() if name.startswith("/goal/")]
    poses, links = [in_world(panda.server, node) for node in shown], panda.robot.link_poses(q)
    assert any(np.allclose(pose, links["panda_hand"], atol=1e-5) for pose in poses)
    assert not any(np.allclose(pose, links["panda_link5"], atol=1e-5) for pose in poses)
    panda.view.goal.pose = GOAL
    panda.view.show_goal_marker(True)
    np.testing.assert_allclose(pose_to_matrix(panda.view.goal_pose), pose_to_matrix(GOAL), atol=1e-9)


def test_invalid_pose_of_the_goal_marker_is_reverted(panda: Stage) -> None:
    panda.view.show_goal_marker(True)
    panda.view.goal.pose = GOAL
    before, node = panda.view.goal_pose, panda.view.goal._node
    for position, wxyz in (((1e9, 0, 0), (1, 0, 0, 0)), ((0, 0, 0.5), (0, 0, 0, 0)), ((np.nan, 0, 0), (1, 0, 0, 0))):
        node._impl.position[:], node._impl.wxyz[:] = position, wxyz  # like a message of a browser
        assert panda.view.goal_pose == before
        np.testing.assert_allclose(node.position, (0.5, 0.1, 0.4))
