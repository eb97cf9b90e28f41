"""The whole scene: robot, objects and layers; nothing is sent when nothing changed or nobody looks."""

from __future__ import annotations

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
from common.robot.transforms import pose_to_matrix
from common.scene.fixtures import fixed_objects
from page.layers import find_layers
from tests.page.scene_cell import WORLD, Stage, around_of, at, ball, in_world, is_shown, scene_of


def fingers(stage: Stage, width: float) -> dict[str, float]:
    gripper = stage.robot.config.gripper
    assert gripper is not None
    return dict(zip(gripper.joints, finger_positions(gripper, width), strict=True))


@pytest.mark.parametrize("cell", ["panda", "ur5"])
def test_links_are_where_forward_kinematics_puts_them(server: viser.ViserServer, cell: str) -> None:
    stage = Stage(server, cell)
    for share, width in ((0.0, 0.02), (0.4, 0.07)):
        q = stage.robot.named("home") + share * (stage.robot.lower - stage.robot.named("home"))
        stage.joints(q, fingers(stage, width))
        links = stage.robot.link_poses(q, fingers(stage, width))
        for link, node in stage.layer("robot").figure.links.items():
            np.testing.assert_allclose(in_world(server, node), links[link], atol=1e-6, err_msg=link)


def test_fingers_move_apart(panda: Stage) -> None:
    gaps = []
    for width in (0.0, 0.08):
        panda.joints(panda.robot.named("home"), fingers(panda, width))
        left, right = (in_world(panda.server, panda.layer("robot").figure.links[f"panda_{side}finger"]) for side in
                       ("left", "right"))
        gaps.append(float(np.linalg.norm(left[:3, 3] - right[:3, 3])))
    assert gaps == pytest.approx([0.0, 0.08], abs=1e-6)


def test_joints_that_the_robot_lacks_are_left_out(panda: Stage) -> None:
    q = panda.robot.named("home") + 0.1
    panda.joints(q, {"turntable_joint": 1.0})
    tcp = panda.view.stage.poses.pose("panda_hand_tcp")[0]
    np.testing.assert_allclose(tcp, panda.robot.fk(q)[:3, 3], atol=1e-6)
    panda.say(topics.JOINT_STATES, m.JointState(header=WORLD, name=["other"], position=[1.0]))
    np.testing.assert_allclose(panda.view.stage.poses.pose("panda_hand_tcp")[0], tcp)


def a_sphere(name: str, pose: m.Pose) -> m.WorldObjects:
    size = m.Vector3(x=0.06, y=0.06, z=0.06)
    return m.WorldObjects(header=WORLD, objects=[m.WorldObject(id=name, shape="sphere", size=size, pose=pose)])


def test_nothing_is_sent_when_nothing_changed(panda: Stage) -> None:
    pose = m.JointState(header=WORLD, name=panda.robot.joint_names, position=[0.1] * 3 + [-1.0] + [0.1] * 3)
    scene = scene_of(*fixed_objects(around_of("panda")), ball("a", at(0.4, 0.1, 0.03)))
    targets = m.PoseArray(header=WORLD, poses=[at(0.4, 0.1, 0.03)])
    truth = a_sphere("ball_1", at(0.4, 0.1, 0.03))
    panda.show("truth", True)

    def show_all(stamp: int) -> None:
        later = {"header": m.Header(stamp=stamp, frame_id="world")}
        panda.say(topics.JOINT_STATES, pose.model_copy(update=later))
        panda.say(topics.PLANNING_SCENE, scene.model_copy(update=later))
        panda.say(VALIDATED_TARGETS, targets.model_copy(update=later))
        panda.say(topics.SCENE_OBJECTS, truth.model_copy(update=later))

    with panda.sent() as first:
        show_all(1)
    with panda.sent() as again:
        show_all(2)
    assert first and not again


def test_trembling_targets_are_not_sent_again(panda: Stage) -> None:
    panda.say(VALIDATED_TARGETS, m.PoseArray(header=WORLD, poses=[at(0.4, 0.1, 0.03)]))
    with panda.sent() as sent:
        panda.say(VALIDATED_TARGETS, m.PoseArray(header=WORLD, poses=[at(0.4003, 0.0996, 0.03)]))
    assert not sent


def test_while_nobody_looks_nothing_is_sent_and_then_the_newest_of_all(panda: Stage) -> None:
    panda.watched = False
    q = panda.robot.named("home") + 0.2
    with panda.sent() as sent:
        for share in (0.5, 1.0):
            panda.joints(panda.robot.named("home") + 0.2 * share)
        panda.say(topics.PLANNING_SCENE, scene_of(ball("a", at(0.4, 0.1, 0.03))))
        panda.say(VALIDATED_TARGETS, m.PoseArray(header=WORLD, poses=[at(0.4, 0.1, 0.03)]))
    assert not sent
    panda.watched = True
    panda.look()
    assert panda.layer("objects").node("a") is not None
    hand = in_world(panda.server, panda.layer("robot").figure.links["panda_hand"])
    np.testing.assert_allclose(hand, panda.robot.link_poses(q)["panda_hand"], atol=1e-6)


def test_layers_are_shown_and_hidden(panda: Stage) -> None:
    assert list(panda.view.layers) == list(find_layers(find_application("pick_place")))
    panda.joints(panda.robot.named("home"))
    hand = panda.layer("robot").figure.links["panda_hand"]
    assert is_shown(panda.server, hand)
    panda.show("robot", False)
    assert not is_shown(panda.server, hand) and not panda.view.shows("robot")
    panda.show("robot", True)
    assert is_shown(panda.server, hand)


def test_layers_begin_as_wanted_and_unknown_ones_are_refused(server: viser.ViserServer) -> None:
    view = Stage(server, "panda", shown={"truth": True, "workspace": False}).view
    assert view.shows("truth") and not view.shows("workspace") and view.shows("robot")
    with pytest.raises(UnknownName, match=r"layer 'truht'.*'truth'"):
        view.set_shown("truht", True)
    with pytest.raises(UnknownName, match="choices: camera, collision_shapes, compared, fixtures"):
        Stage(server, "panda", shown={"roboter": True})


def test_hidden_layer_shows_the_newest_when_it_comes_back(panda: Stage) -> None:
    panda.say(topics.SCENE_OBJECTS, a_sphere("ball_1", at(0.4, 0.1, 0.03)))
    assert panda.layer("truth").node("ball_1") is None
    panda.show("truth", True)
    assert is_shown(panda.server, panda.layer("truth").node("ball_1"))


def test_objects_come_move_change_and_go(panda: Stage) -> None:
    panda.say(topics.PLANNING_SCENE, scene_of(*fixed_objects(around_of("panda")), ball("a", at(0.4, 0.1, 0.03))))
    node, table = panda.layer("objects").node("a"), panda.layer("fixtures").node("table")
    assert isinstance(node, viser.IcosphereHandle) and node.radius == 0.03 and node.color == (255, 36, 36)
    assert isinstance(table, viser.BoxHandle) and table.dimensions == (1.0, 1.0, 0.05)
    assert node.name.startswith("/objects/") and table.name.startswith("/fixtures/")
    panda.say(topics.PLANNING_SCENE, scene_of(ball("a", at(0.5, 0.2, 0.03))))
    assert panda.layer("objects").node("a") is node and panda.layer("fixtures").node("table") is None
    np.testing.assert_allclose(in_world(panda.server, node)[:3, 3], [0.5, 0.2, 0.03])
    larger = ball("a", at(0.5, 0.2, 0.03)).model_copy(update={"dimensions": [0.05]})
    panda.say(topics.PLANNING_SCENE, scene_of(larger))
    changed = panda.layer("objects").node("a")
    assert isinstance(changed, viser.IcosphereHandle) and changed.radius == 0.05
    panda.say(topics.PLANNING_SCENE, scene_of())
    assert panda.layer("objects").node("a") is None


def test_attached_object_moves_with_its_link(panda: Stage) -> None:
    held = ball("held", at(0.01, 0.0, 0.02), role="attached")
    panda.say(topics.PLANNING_SCENE, scene_of(held={"panda_hand_tcp": held}))
    for turn in (0.0, 0.3):
        q = panda.robot.named("home") + turn
        panda.joints(q)
        wanted = panda.robot.fk(q) @ pose_to_matrix(held.pose)
        node = panda.layer("objects").node("held", "panda_hand_tcp")
        np.testing.assert_allclose(in_world(panda.server, node), wanted, atol=1e-6)
    panda.say(topics.PLANNING_SCENE, scene_of(ball("held", at(0.5, 0.2, 0.03))))  # put down
    assert panda.layer("objects").node("held", "panda_hand_tcp") is None
    np.testing.assert_allclose(in_world(panda.server, panda.layer("objects").node("held"))[:3, 3], [0.5, 0.2, 0.03])


def test_robot_can_be_hidden_without_what_it_holds(panda: Stage) -> None:
    panda.say(topics.PLANNING_SCENE, scene_of(held={"panda_hand": ball("held", at(0, 0, 0.1), role="attached")}))
    panda.show("robot", False)
    assert is_shown(panda.server, panda.layer("objects").node("held", "panda_hand"))


def test_object_on_a_link_that_the_robot_lacks_is_left_out(panda: Stage) -> None:
    panda.say(topics.PLANNING_SCENE, scene_of(ball("a", at(0.4, 0, 0.03)), held={"third_hand": ball("b", at(0, 0, 0))}))
    assert panda.layer("objects").node("a") is not None
    assert panda.layer("objects").node("b", "third_hand") is None


def test_prism_is_as_large_as_its_cross_section(ur5: Stage) -> None:
    thing = m.CollisionObject(
        id="yellow_1", role="target", shape="prism", dimensions=[0.06], pose=at(0.5, 0.0, 1.03),
        outline=[(-0.02, -0.01), (0.04, -0.01), (0.04, 0.03), (-0.02, 0.03)],
    )
    ur5.say(topics.PLANNING_SCENE, scene_of(thing))
    node: Any = ur5.layer("objects").node("yellow_1")
    np.testing.assert_allclose(node.vertices.min(axis=0), [-0.02, -0.01, -0.03], atol=1e-6)
    np.testing.assert_allclose(node.vertices.max(axis=0), [0.04, 0.03, 0.03], atol=1e-6)


def test_prism_that_encloses_nothing_is_left_out(ur5: Stage) -> None:
    def prism(*outline: tuple[float, float]) -> m.CollisionObject:
        return m.CollisionObject(id="a", role="target", shape="prism", dimensions=[0.1], outline=list(outline),
                                 pose=at(0.4, 0, 0))

    objects = ur5.layer("objects")
    for outline in ([(0.1, 0.1)] * 3, [(0.0, 0.0), (0.1, 0.0), (0.2, 0.0)]):
        ur5.say(topics.PLANNING_SCENE, scene_of(prism((0.0, 0.0), (0.1, 0.0), (0.0, 0.1))))
        assert objects.node("a") is not None
        ur5.say(topics.PLANNING_SCENE, scene_of(prism(*outline)))
        assert objects.node("a") is None
    ur5.say(topics.PLANNING_SCENE, scene_of())


@pytest.mark.parametrize("cell", ["panda", "ur5"])
def test_messages_without_content_do_no_harm(server: viser.ViserServer, cell: str) -> None:
    stage = Stage(server, cell)
    for name in stage.view.layers:
        stage.show(name, True)
    needed: dict[type[m.Message], m.Message] = {
        m.JointState: m.JointState(header=WORLD, name=[], position=[]), m.PlanningScene: scene_of(),
        m.Rejections: m.Rejections(header=WORLD, rejected=[]), m.MarkerArray: m.MarkerArray(header=WORLD, markers=[]),
        m.JointTrajectory: m.JointTrajectory(joint_names=["a"], points=[]), m.TFMessage: m.TFMessage(transforms=[]),
        Contours: Contours(header=WORLD, width=64, height=48), m.PoseArray: m.PoseArray(),
        OutlinePoints: OutlinePoints(), m.WorldObjects: m.WorldObjects(),
        m.PointCloud2: m.PointCloud2(header=WORLD, height=1, width=1, row_step=16, data=b""),
    }
    topics_shown = {topic for layer in stage.view.layers.values() for topic in layer.TOPICS}
    for topic in topics_shown:
        if topic.message is not m.CameraInfo:
            stage.say(topic, needed[topic.message])
    stage.view.picture(topics.CAMERA_IMAGE, np.zeros((48, 64, 3), np.uint8))
    stage.view.play(m.JointTrajectory(joint_names=["a"], points=[]))
    stage.joints(stage.robot.named("home"))


def test_scene_leaves_it_to_the_page_from_where_it_is_seen(server: viser.ViserServer) -> None:
    server.initial_camera.position, server.initial_camera.look_at = (3.0, 2.0, 1.0), (0.3, 0.2, 0.1)
    Stage(server, "panda")
    np.testing.assert_allclose(server.initial_camera.position, (3.0, 2.0, 1.0))
    np.testing.assert_allclose(server.initial_camera.look_at, (0.3, 0.2, 0.1))
