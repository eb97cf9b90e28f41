"""Frames hang on one another as tf says, whatever comes first; the camera is where its frame is."""

from __future__ import annotations

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

TURNED = matrix_to_pose(transform(rpy_to_matrix(0.3, -0.2, 1.0), (0.1, 0.2, 0.3)))


def tf(parent: str, child: str, pose: m.Pose) -> m.TFMessage:
    header = m.Header(stamp=1, frame_id=parent)
    return m.TFMessage(transforms=[m.TransformStamped(header=header, child_frame_id=child, transform=pose)])


@pytest.fixture
def stage(panda: Stage) -> Stage:
    panda.show("frames", True)
    return panda


def test_frame_moves_with_the_one_that_it_hangs_on(stage: Stage) -> None:
    stage.say(topics.TF, tf("world", "base", TURNED))
    stage.say(topics.TF, tf("base", "tool", TURNED))
    node = stage.layer("frames").node("tool")
    T = pose_to_matrix(TURNED)
    np.testing.assert_allclose(in_world(stage.server, node), T @ T, atol=1e-9)
    stage.say(topics.TF, tf("world", "base", at(1, 0, 0)))
    np.testing.assert_allclose(in_world(stage.server, node), pose_to_matrix(at(1, 0, 0)) @ T, atol=1e-9)


def test_frame_waits_for_the_one_that_it_hangs_on(stage: Stage) -> None:
    stage.say(topics.TF, tf("hand", "finger", TURNED))
    stage.say(topics.TF, tf("base", "hand", TURNED))
    assert stage.layer("frames").node("finger") is None
    stage.say(topics.TF, tf("world", "base", TURNED))
    T = pose_to_matrix(TURNED)
    np.testing.assert_allclose(in_world(stage.server, stage.layer("frames").node("finger")), T @ T @ T, atol=1e-9)


def test_frame_that_hangs_elsewhere_now_takes_its_children_along(stage: Stage) -> None:
    for parent, child in (("world", "a"), ("world", "b"), ("a", "tool"), ("tool", "tip")):
        stage.say(topics.TF, tf(parent, child, at(1, 0, 0)))
    stage.say(topics.TF, tf("b", "tool", at(0, 2, 0)))
    stage.say(topics.TF, tf("world", "b", at(0, 0, 3)))
    tip = stage.layer("frames").node("tip")
    np.testing.assert_allclose(in_world(stage.server, tip)[:3, 3], [1, 2, 3])


def test_frames_that_hang_on_each_other_in_a_circle_are_left_out(stage: Stage) -> None:
    for parent, child in (("a", "b"), ("b", "a"), ("world", "c")):
        stage.say(topics.TF, tf(parent, child, TURNED))
    assert stage.layer("frames").node("a") is None and stage.layer("frames").node("c") is not None
    assert np.isfinite(stage.view.stage.transforms.pose("a")).all()


def test_frames_whose_names_differ_by_a_slash_stand_beside_each_other(stage: Stage) -> None:
    for x in (1.0, 2.0):
        for parent, child in (("world", "a/b"), ("world", "a_b"), ("world", "words 0"), ("a_b", "tip")):
            stage.say(topics.TF, tf(parent, child, at(x, 0, 0)))
    frames = stage.layer("frames")
    assert {name: in_world(stage.server, frames.node(name))[0, 3] for name in ("a/b", "a_b", "words 0", "tip")} == {
        "a/b": 2.0, "a_b": 2.0, "words 0": 2.0, "tip": 4.0}


def test_frame_that_hangs_on_what_hung_on_it_changes_places(stage: Stage) -> None:
    for parent, child in (("world", "a"), ("a", "b"), ("b", "a"), ("world", "b"), ("world", "world")):
        stage.say(topics.TF, tf(parent, child, at(1, 0, 0)))
    assert in_world(stage.server, stage.layer("frames").node("a"))[0, 3] == 2.0


def test_any_number_of_frames_is_told_of_and_the_newest_are_shown(stage: Stage) -> None:
    def hang(names: list[str]) -> m.TFMessage:
        """Each on the one before it, told of from the last one on."""
        each = [tf(parent, child, at(0, 0, 1)).transforms[0] for parent, child in pairwise(["world", *names])]
        return m.TFMessage(transforms=each[::-1])

    for number in range(4):
        stage.say(topics.TF, hang([f"{number}/{i}" for i in range(1000)]))
    stage.say(topics.TF, tf("world", "base", TURNED))
    frames = stage.layer("frames")
    assert len(stage.view.stage.transforms.newest) == MAX_FRAMES and len(frames._nodes) <= 500
    assert frames.node("base") is not None and frames.node("0/1") is None and frames.node("3/1") is not None


def test_frames_are_moved_ten_times_a_second_at_most(stage: Stage) -> None:
    stage.say(topics.TF, tf("world", "base", at(0, 0, 0)))
    with stage.sent() as sent:
        stage.say(topics.TF, tf("world", "base", at(0, 0, 1)), 0.05)
        assert not sent
        stage.say(topics.TF, tf("world", "base", at(0, 0, 2)), 0.06)
    assert [message.name for message in sent] == ["/frames/base", "/frames/words 0"]


def test_camera_is_where_its_frame_is_on_a_moving_hand(panda: Stage) -> None:
    camera = Pinhole.from_config(around_of("panda").camera)
    panda.say(topics.CAMERA_INFO, camera.info(m.Header(frame_id="eye")))
    for parent, child, pose in (("world", "hand", at(0.5, 0, 0.5)), ("hand", "eye", TURNED)):
        panda.say(topics.TF_STATIC, tf(parent, child, pose))
    wanted = pose_to_matrix(at(0.5, 0, 0.5)) @ pose_to_matrix(TURNED)
    node = panda.layer("camera").nodes["camera"]
    np.testing.assert_allclose(in_world(panda.server, node), wanted, atol=1e-9)
    for seconds, x in ((1.0, 0.6), (0.05, 0.7)):  # the second one too soon to be shown
        panda.say(topics.TF, tf("world", "hand", at(x, 0, 0.5)), seconds)
        np.testing.assert_allclose(in_world(panda.server, node)[0, 3], wanted[0, 3] + 0.1, atol=1e-6)


def test_each_of_two_cameras_has_a_frustum_where_it_is(server: viser.ViserServer) -> None:
    keys = [{"camera/*": "left_camera/*"}, {"camera/*": "right_camera/*"}]
    stage = Stage(server, "panda", keys=keys)
    camera = Pinhole.from_config(around_of("panda").camera)
    for side, x in (("left", 0.3), ("right", 0.7)):
        stage.say(replace(topics.CAMERA_INFO, key=f"{side}_camera/camera_info"),
                  camera.info(m.Header(frame_id=f"{side}_eye")))
        stage.say(topics.TF_STATIC, tf("world", f"{side}_eye", at(x, 0, 0.5)))
    nodes = stage.layer("camera").nodes
    assert {name: round(float(in_world(server, node)[0, 3]), 6) for name, node in nodes.items()} == {
        "left_camera": 0.3, "right_camera": 0.7}


def test_camera_without_transforms_is_where_the_surroundings_say() -> None:
    config = CameraConfig(position=(0.4, 0.0, 0.8))
    np.testing.assert_allclose(Transforms([config]).pose(config.frame)[:3, 3], [0.4, 0.0, 0.8])


def test_camera_looks_as_far_to_the_sides_as_its_picture(panda: Stage) -> None:
    camera = Pinhole.from_config(around_of("panda").camera)
    panda.say(topics.CAMERA_INFO, camera.info(m.Header(frame_id="camera_optical_frame")))
    node = panda.layer("camera").nodes["camera"]
    assert np.tan(node.fov / 2) == pytest.approx(camera.height / 2 / camera.fy)
    assert np.tan(node.fov / 2) * node.aspect == pytest.approx(camera.width / 2 / camera.fx)


def test_picture_of_the_frustum_is_small_and_comes_twice_a_second(panda: Stage) -> None:
    camera = Pinhole.from_config(around_of("panda").camera)
    panda.say(topics.CAMERA_INFO, camera.info(m.Header(frame_id="camera_optical_frame")))
    node = panda.layer("camera").nodes["camera"]
    for seconds, grey in ((0.0, 10), (0.4, 20), (0.2, 30)):
        panda.clock.now += seconds
        panda.view.picture(topics.CAMERA_IMAGE, np.full((480, 640, 3), grey, np.uint8))
        assert node.image.shape == (240, 320, 3)
        assert node.image[0, 0, 0] == (10 if grey < 30 else 30)
