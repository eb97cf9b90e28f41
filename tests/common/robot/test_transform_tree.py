import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import UnknownName
from common.messages import Header, Pose, TFMessage, TransformStamped, Vector3
from common.messages.basics import MAX_STAMP
from common.robot.transform_history import MOST_FRAMES
from common.robot.transform_tree import NotConnected, TransformTree
from common.robot.transforms import invert, matrix_to_rpy, rpy_to_matrix, transform

ANGLE = st.floats(-3.1, 3.1)
T = st.builds(lambda a, b, c, x, y, z: transform(rpy_to_matrix(a, b, c), (x, y, z)),
              ANGLE, ANGLE, ANGLE, *[st.floats(-2, 2)] * 3)


def moved(x: float) -> np.ndarray:
    return transform(np.eye(3), (x, 0.0, 0.0))


@given(T, T, T, T)
def test_pose_goes_up_to_the_common_ancestor_and_down_again(a: np.ndarray, b: np.ndarray, c: np.ndarray,
                                                            d: np.ndarray) -> None:
    tree = TransformTree()
    for parent, child, pose in (("world", "base", a), ("base", "hand", b), ("base", "mast", c), ("mast", "camera", d)):
        tree.set(parent, child, pose)
    assert tree.path("camera", "hand") == ["camera", "mast", "base", "hand"]
    np.testing.assert_allclose(tree.pose("camera", "hand"), invert(d) @ invert(c) @ b, atol=1e-9)
    np.testing.assert_allclose(tree.pose("camera", "hand") @ tree.pose("hand", "camera"), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(tree.pose("world", "camera"), a @ c @ d, atol=1e-9)
    np.testing.assert_array_equal(tree.pose("hand", "hand"), np.eye(4))


def test_unknown_frame_names_the_frames_that_there_are() -> None:
    tree = TransformTree()
    tree.set("world", "hand", moved(1))
    with pytest.raises(UnknownName, match=r"unknown frame 'hadn' \(did you mean 'hand'\?\); choices: hand, world"):
        tree.pose("world", "hadn")


def test_trees_that_are_not_connected_name_both_roots() -> None:
    tree = TransformTree()
    tree.set("world", "hand", moved(1))
    tree.set("map", "cart", moved(1))
    with pytest.raises(NotConnected, match="'cart' are not connected: one hangs on 'world', the other on 'map'"):
        tree.pose("hand", "cart")


def test_frames_that_hang_on_each_other_do_not_go_round_for_ever() -> None:
    tree = TransformTree()
    tree.set("a", "b", moved(1))
    tree.set("b", "a", moved(-1))
    tree.set("c", "d", moved(1))
    assert tree.pose("a", "b")[0, 3] == 1
    with pytest.raises(NotConnected):
        tree.pose("a", "d")
    assert [name for _, name in tree.walk()] == ["c", "d"]


def test_older_transform_does_not_replace_a_newer_one_and_a_child_may_move_to_another_parent() -> None:
    def message(parent: str, stamp: int, x: float) -> TFMessage:
        return TFMessage(transforms=[TransformStamped(
            header=Header(stamp=stamp, frame_id=parent), child_frame_id="part", transform=Pose(position=Vector3(x=x))
        )])

    tree = TransformTree()
    tree.update(message("belt", 20, 2.0))
    tree.update(message("belt", 10, 1.0))
    assert tree.pose("belt", "part")[0, 3] == 2.0
    assert tree.stamp_of("part") == 20
    tree.update(message("hand", 5, 3.0))
    assert tree.pose("hand", "part")[0, 3] == 3.0
    assert tree.parent_of("part") == "hand"


def test_stamp_of_a_time_to_come_hides_nothing_that_is_told_after_it() -> None:
    tree = TransformTree()
    for stamp, x in ((MAX_STAMP, 1), (20, 2), (10, 3)):
        tree.set("belt", "part", moved(x), stamp)
    assert tree.pose("belt", "part")[0, 3] == 2.0 and tree.stamp_of("part") == 20


def test_of_frames_that_are_made_up_those_are_known_that_were_told_of_last() -> None:
    tree = TransformTree()
    for number in range(5):
        tree.update(TFMessage(transforms=[
            TransformStamped(header=Header(frame_id="world"), child_frame_id=name, transform=Pose())
            for name in ("tool", *(f"{number} {i}" for i in range(900)))]))
    assert len(tree.frames) == MOST_FRAMES + 1
    assert tree.parent_of("tool") == "world" and tree.parent_of("0 0") is None


def test_walk_gives_every_frame_below_its_parent() -> None:
    tree = TransformTree()
    for parent, child in (("world", "b"), ("b", "c"), ("world", "a"), ("b", "bb"), ("map", "m")):
        tree.set(parent, child, moved(1))
    assert list(tree.walk()) == [(0, "map"), (1, "m"), (0, "world"), (1, "a"), (1, "b"), (2, "bb"), (2, "c")]


@given(ANGLE, st.floats(-1.5, 1.5), ANGLE)
def test_roll_pitch_and_yaw_come_back(roll: float, pitch: float, yaw: float) -> None:
    np.testing.assert_allclose(matrix_to_rpy(rpy_to_matrix(roll, pitch, yaw)), (roll, pitch, yaw), atol=1e-6)


@given(ANGLE, st.sampled_from([np.pi / 2, -np.pi / 2]), ANGLE)
def test_upright_pitch_still_gives_angles_of_that_rotation(roll: float, pitch: float, yaw: float) -> None:
    rotation = rpy_to_matrix(roll, pitch, yaw)
    np.testing.assert_allclose(rpy_to_matrix(*matrix_to_rpy(rotation)), rotation, atol=1e-6)
