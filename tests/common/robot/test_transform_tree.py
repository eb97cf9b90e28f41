"""Poses between frames of a tree, and of a camera on a moving link at the time of an image."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import load_cell
from common.errors import UnknownName
from common.messages import Header, JointState, TFMessage
from common.messages.basics import MAX_STAMP
from common.robot.model import RobotModel
from common.robot.transform_tree import HISTORY_SIZE as SIZE
from common.robot.transform_tree import MAX_FRAMES, NotConnected, TransformHistory, TransformTree, TransformUnavailable
from common.robot.transforms import invert, rpy_to_matrix, transform
from services.robot_state_publisher import LinkFrames, stamped

ANGLE = st.floats(-3.1, 3.1)
T = st.builds(lambda a, b, c, x, y, z: transform(rpy_to_matrix(a, b, c), (x, y, z)),
              ANGLE, ANGLE, ANGLE, *[st.floats(-2, 2)] * 3)
ROBOT = RobotModel.load(load_cell("panda").robot)
FRAMES = LinkFrames(ROBOT)
HOME = ROBOT.named("home")
T_TCP_CAMERA = transform(rpy_to_matrix(0.1, 0.2, 0.3), (0.05, 0.0, -0.1))
FIXED = TFMessage(transforms=[
    *FRAMES.fixed(0), stamped("world", FRAMES.root, FRAMES.T_world_root, 0),
    stamped(ROBOT.config.tcp_link, "lens", T_TCP_CAMERA, 0)])
MS = 1_000_000
SPEED = np.array([0.5, -0.3, 0.4, 0.2, -0.6, 0.5, 1.0])  # [rad/s]


def shifted(x: float) -> np.ndarray:
    return transform(np.eye(3), (x, 0.0, 0.0))


def tree_of(*edges: str) -> TransformTree:
    """A tree of edges "parent child", each child 1 m from its parent."""
    tree = TransformTree()
    for edge in edges:
        tree.set(*edge.split(), shifted(1))
    return tree


@given(T, T, T, T)
def test_pose_goes_up_to_the_common_ancestor_and_down_again(a, b, c, d) -> None:
    tree = TransformTree()
    for parent, child, pose in (("world", "base", a), ("base", "hand", b), ("base", "mast", c), ("mast", "camera", d)):
        tree.set(parent, child, pose)
    assert tree.path("camera", "hand") == ["camera", "mast", "base", "hand"]
    np.testing.assert_allclose(tree.pose("camera", "hand"), invert(d) @ invert(c) @ b, atol=1e-9)
    np.testing.assert_allclose(tree.pose("camera", "hand") @ tree.pose("hand", "camera"), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(tree.pose("world", "camera"), a @ c @ d, atol=1e-9)
    np.testing.assert_array_equal(tree.pose("hand", "hand"), np.eye(4))


@pytest.mark.parametrize(("frames", "error", "message"), [
    (("map", "hadn"), UnknownName, r"unknown frame 'hadn' \(did you mean 'hand'\?\); choices: cart, hand, map, world"),
    (("hand", "cart"), NotConnected, "'cart' are not connected: the root of one is 'world', of the other 'map'"),
])
def test_unknown_and_unconnected_frames_are_refused(frames, error, message) -> None:
    with pytest.raises(error, match=message):
        tree_of("world hand", "map cart").pose(*frames)


def test_cycle_of_frames_ends_the_search() -> None:
    tree = tree_of("a b", "c d")
    tree.set("b", "a", shifted(-1))
    assert tree.pose("a", "b")[0, 3] == 1
    with pytest.raises(NotConnected):
        tree.pose("a", "d")
    assert [name for _, name in tree.walk()] == ["c", "d"]


def test_older_transform_is_ignored_unless_the_child_has_a_new_parent() -> None:
    tree = TransformTree()
    for stamp, x in ((20, 2.0), (10, 1.0)):
        tree.update(TFMessage(transforms=[stamped("belt", "part", shifted(x), stamp)]))
    assert tree.pose("belt", "part")[0, 3] == 2.0 and tree.stamp_of("part") == 20
    tree.update(TFMessage(transforms=[stamped("hand", "part", shifted(3.0), 5)]))
    assert tree.pose("hand", "part")[0, 3] == 3.0 and tree.parent_of("part") == "hand"


def test_stamp_in_the_future_does_not_block_later_updates_of_the_tree() -> None:
    tree = TransformTree()
    for stamp, x in ((MAX_STAMP, 1), (20, 2), (10, 3)):
        tree.set("belt", "part", shifted(x), stamp)
    assert tree.pose("belt", "part")[0, 3] == 2.0 and tree.stamp_of("part") == 20


def test_tree_keeps_the_frames_updated_last() -> None:
    tree, pose = TransformTree(), stamped("world", "tool", np.eye(4), 0)
    for number in range(5):
        names = ("tool", *(f"{number} {i}" for i in range(900)))
        tree.update(TFMessage(transforms=[pose.model_copy(update={"child_frame_id": name}) for name in names]))
    assert len(tree.frames) == MAX_FRAMES + 1
    assert tree.parent_of("tool") == "world" and tree.parent_of("0 0") is None


def test_walk_yields_every_frame_below_its_parent() -> None:
    tree = tree_of("world b", "b c", "world a", "b bb", "map m")
    assert list(tree.walk()) == [(0, "map"), (1, "m"), (0, "world"), (1, "a"), (1, "b"), (2, "bb"), (2, "c")]


def joints_at(stamp: int) -> np.ndarray:
    return HOME + SPEED * stamp * 1e-9


def lens_at(stamp: int) -> np.ndarray:
    return ROBOT.fk(joints_at(stamp)) @ T_TCP_CAMERA


def tf_of(q: np.ndarray, stamp: int) -> TFMessage:
    message = FRAMES.moving(JointState(header=Header(stamp=stamp), name=ROBOT.joint_names, position=q.tolist()))
    assert message is not None
    return TFMessage.model_validate({"transforms": message.transforms})


def history_of(stamps: list[int], moves: bool = True) -> TransformHistory:
    history = TransformHistory()
    for stamp in stamps:
        history.add(tf_of(joints_at(stamp) if moves else HOME, stamp))
    return history


def test_mounted_camera_is_where_the_arm_was_at_the_time_of_the_image() -> None:
    history = history_of([0, 20 * MS, 40 * MS, 60 * MS])
    for stamp in (0, 7 * MS, 20 * MS, 33 * MS, 60 * MS):
        np.testing.assert_allclose(history.pose("lens", FIXED, stamp), lens_at(stamp), atol=1e-5)
    assert np.abs(lens_at(0) - lens_at(60 * MS)).max() > 0.01


@pytest.mark.parametrize(("stamps", "requested", "kind"), [
    ([], 0, "early"), ([10 * MS], 30 * MS, "early"), ([10 * MS, 30 * MS], 5 * MS, "unknown_camera"),
    ([k * MS for k in range(1, SIZE + 50)], 2 * MS, "late"), ([0, 500 * MS], 250 * MS, "gap"),
])
def test_time_that_tf_does_not_cover_has_no_pose(stamps: list[int], requested: int, kind: str) -> None:
    with pytest.raises(TransformUnavailable) as refusal:
        history_of(stamps).pose("lens", FIXED, requested)
    assert refusal.value.kind == kind


def test_gap_in_tf_is_accepted_while_the_arm_is_at_rest() -> None:
    history = history_of([0, 500 * MS], moves=False)
    np.testing.assert_allclose(history.pose("lens", FIXED, 250 * MS), lens_at(0), atol=1e-9)


def test_history_ignores_a_transform_that_is_not_newer() -> None:
    history = history_of([0, 20 * MS])
    before = history.pose("lens", FIXED, 10 * MS)
    history.add(tf_of(HOME + 1, 0))
    np.testing.assert_array_equal(history.pose("lens", FIXED, 10 * MS), before)


def test_unknown_and_cyclic_frames_are_named() -> None:
    history = history_of([0])
    with pytest.raises(TransformUnavailable, match=r"tf_static has no frame 'elsewhere'; its frames: .*lens"):
        history.pose("elsewhere", FIXED, 0)
    ring = TFMessage(transforms=[stamped(a, b, np.eye(4), 0) for a, b in ("ab", "ba")])
    with pytest.raises(TransformUnavailable, match="is its own ancestor"):
        history.pose("a", ring, 0)


def test_flood_of_invented_frames_does_not_drop_a_frame_that_is_updated() -> None:
    history, invented = history_of([0]), stamped("world", "new", np.eye(4), 1)
    for stamp in range(1, 6):
        history.add(tf_of(HOME, stamp * MS))
        names = [f"new_{stamp}_{k}" for k in range(1000)]
        history.add(TFMessage(transforms=[invented.model_copy(update={"child_frame_id": name}) for name in names]))
    assert history.frame_count <= MAX_FRAMES and np.isfinite(history.pose("lens", FIXED, 5 * MS)).all()


def test_stamp_in_the_future_does_not_block_later_updates_of_the_history() -> None:
    history = history_of([0, 20 * MS])
    future = [each.model_copy(update={"header": Header(stamp=MAX_STAMP, frame_id=each.header.frame_id)})
              for each in tf_of(joints_at(40 * MS), 40 * MS).transforms]
    history.add(TFMessage(transforms=future))
    for stamp in (60 * MS, 80 * MS):
        history.add(tf_of(joints_at(stamp), stamp))
    np.testing.assert_allclose(history.pose("lens", FIXED, 70 * MS), lens_at(70 * MS), atol=1e-5)
