"""Frames as children of their parents in tf, in any order of arrival, and cameras at their frames."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import viser

from common import messages as m
from common import topics
from common.config import CameraConfig
from common.perception.pinhole import Pinhole
from common.robot.transform_tree import MAX_FRAMES
from common.robot.transforms import matrix_to_pose, pose_to_matrix, rpy_to_matrix, transform
from page.figure import Transforms
from tests.page.scene_cell import Stage, around_of, at, in_world

POSE = matrix_to_pose(transform(rpy_to_matrix(0.3, -0.2, 1.0), (0.1, 0.2, 0.3)))
T = pose_to_matrix(POSE)
CAMERA = Pinhole.from_config(around_of("panda").camera)


def tf(*transforms: tuple[str, str, m.Pose]) -> m.TFMessage:
    return m.TFMessage(transforms=[
        m.TransformStamped(header=m.Header(stamp=1, frame_id=parent), child_frame_id=child, transform=pose)
        for parent, child, pose in transforms])


class Frames:
    """The layer of frames."""

    def __init__(self, stage: Stage) -> None:
        self.stage, self.layer = stage, stage.layer("frames")
        stage.show("frames", True)

    def say(self, *transforms: tuple[str, str, m.Pose]) -> None:
        """Publish transforms one by one."""
        for each in transforms:
            self.stage.say(topics.TF, tf(each))

    def pose(self, name: str) -> np.ndarray | None:
        node = self.layer.node(name)
        return in_world(self.stage.server, node) if node is not None else None

    def assert_at(self, name: str, *position: float) -> None:
        pose = self.pose(name)
        np.testing.assert_allclose(pose[:3, 3], position)


@pytest.fixture
def frames(panda: Stage) -> Frames:
    return Frames(panda)


def test_frame_is_displayed_once_its_parents_are_known_and_moves_with_them(frames: Frames) -> None:
    frames.say(("hand", "finger", POSE), ("base", "hand", POSE))
    assert frames.pose("finger") is None
    frames.say(("world", "base", POSE))
    np.testing.assert_allclose(frames.pose("finger"), T @ T @ T, atol=1e-9)
    frames.say(("world", "base", at(1, 0, 0)))
    np.testing.assert_allclose(frames.pose("hand"), pose_to_matrix(at(1, 0, 0)) @ T, atol=1e-9)


def test_frame_with_a_new_parent_takes_its_children_along(frames: Frames) -> None:
    frames.say(*((parent, child, at(1, 0, 0)) for parent, child in (
        ("world", "a"), ("world", "b"), ("a", "tool"), ("tool", "tip"))))
    frames.say(("b", "tool", at(0, 2, 0)), ("world", "b", at(0, 0, 3)))
    frames.assert_at("tip", 1, 2, 3)


def test_frames_in_a_cycle_are_left_out_and_parent_and_child_may_change_roles(frames: Frames) -> None:
    frames.say(("a", "b", POSE), ("b", "a", POSE), ("world", "c", POSE), ("world", "world", POSE))
    assert frames.pose("a") is None and frames.pose("c") is not None
    assert np.isfinite(frames.stage.view.stage.transforms.pose("a")).all()
    frames.say(("b", "a", at(1, 0, 0)), ("world", "b", at(1, 0, 0)))
    frames.assert_at("a", 2, 0, 0)


def test_frame_names_that_differ_by_a_slash_have_separate_nodes(frames: Frames) -> None:
    for x in (1.0, 2.0):
        frames.say(*((parent, child, at(x, 0, 0)) for parent, child in (
            ("world", "a/b"), ("world", "a_b"), ("world", "label 0"), ("a_b", "tip"))))
    for name, x in {"a/b": 2.0, "a_b": 2.0, "label 0": 2.0, "tip": 4.0}.items():
        frames.assert_at(name, x, 0, 0)


def test_number_of_frames_is_bounded_and_the_newest_are_displayed(frames: Frames) -> None:
    for number in range(4):
        chain = list(pairwise(["world", *(f"{number}/{i}" for i in range(1000))]))
        frames.stage.say(topics.TF, tf(*((parent, child, at(0, 0, 1)) for parent, child in reversed(chain))))
    frames.say(("world", "base", POSE))
    assert len(frames.stage.view.stage.transforms.newest) == MAX_FRAMES and len(frames.layer._nodes) <= 500
    assert frames.pose("base") is not None and frames.pose("0/1") is None and frames.pose("3/1") is not None


def test_camera_follows_its_frame_on_a_moving_gripper(panda: Stage) -> None:
    panda.say(topics.CAMERA_INFO, CAMERA.info(m.Header(frame_id="eye")))
    panda.say(topics.TF_STATIC, tf(("world", "hand", at(0.5, 0, 0.5)), ("hand", "eye", POSE)))
    expected = pose_to_matrix(at(0.5, 0, 0.5)) @ T
    node = panda.layer("camera").nodes["camera"]
    np.testing.assert_allclose(in_world(panda.server, node), expected, atol=1e-9)
    for seconds, x in ((1.0, 0.6), (0.05, 0.7)):  # the second update comes too soon
        panda.say(topics.TF, tf(("world", "hand", at(x, 0, 0.5))), seconds)
        np.testing.assert_allclose(in_world(panda.server, node)[0, 3], expected[0, 3] + 0.1, atol=1e-6)


def test_each_of_two_cameras_has_a_frustum(server: viser.ViserServer) -> None:
    stage = Stage(server, "panda", keys=[{"camera/*": "left_camera/*"}, {"camera/*": "right_camera/*"}])
    for side, x in (("left", 0.3), ("right", 0.7)):
        info = CAMERA.info(m.Header(frame_id=f"{side}_eye"))
        stage.say(replace(topics.CAMERA_INFO, key=f"{side}_camera/camera_info"), info)
        stage.say(topics.TF_STATIC, tf(("world", f"{side}_eye", at(x, 0, 0.5))))
    nodes = stage.layer("camera").nodes
    assert {name: round(float(in_world(server, node)[0, 3]), 6) for name, node in nodes.items()} == {
        "left_camera": 0.3, "right_camera": 0.7}


def test_camera_without_transforms_has_its_configured_pose() -> None:
    config = CameraConfig(position=(0.4, 0.0, 0.8))
    np.testing.assert_allclose(Transforms([config]).pose(config.frame)[:3, 3], [0.4, 0.0, 0.8])


def test_frustum_has_the_field_of_view_of_the_camera_and_a_small_image(panda: Stage) -> None:
    panda.say(topics.CAMERA_INFO, CAMERA.info(m.Header(frame_id="camera_optical_frame")))
    node = panda.layer("camera").nodes["camera"]
    assert np.tan(node.fov / 2) == pytest.approx(CAMERA.height / 2 / CAMERA.fy)
    assert np.tan(node.fov / 2) * node.aspect == pytest.approx(CAMERA.width / 2 / CAMERA.fx)
    for seconds, gray, shown in ((0.0, 10, 10), (0.4, 20, 10), (0.2, 30, 30)):  # at most every half second
        panda.clock.now += seconds
        panda.view.show_image(topics.CAMERA_IMAGE, np.full((480, 640, 3), gray, np.uint8))
        assert node.image.shape == (240, 320, 3) and node.image[0, 0, 0] == shown
