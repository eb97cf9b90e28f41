"""Where a camera on a moving link was when a picture was taken."""

from __future__ import annotations

import numpy as np
import pytest

from common.config import load_cell
from common.messages import Header, JointState, TFMessage, TransformStamped
from common.messages.basics import MAX_STAMP
from common.robot.model import RobotModel
from common.robot.transform_history import KEPT, MOST_FRAMES, NoTransform, TransformHistory
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, transform
from services.robot_state_publisher import LinkFrames, stamped

ROBOT = RobotModel.load(load_cell("panda").robot)
FRAMES = LinkFrames(ROBOT)
HOME = ROBOT.named("home")
T_TCP_CAMERA = transform(rpy_to_matrix(0.1, 0.2, 0.3), (0.05, 0.0, -0.1))
FIXED = TFMessage(transforms=[
    *FRAMES.fixed(0), stamped("world", FRAMES.root, FRAMES.T_world_root, 0),
    stamped(ROBOT.config.tcp_link, "lens", T_TCP_CAMERA, 0)])
MS = 1_000_000
SPEED = np.array([0.5, -0.3, 0.4, 0.2, -0.6, 0.5, 1.0])  # [rad/s]


def joints_at(stamp: int) -> np.ndarray:
    return HOME + SPEED * stamp * 1e-9


def told_at(stamp: int, moves: bool = True) -> TFMessage:
    q = joints_at(stamp) if moves else HOME
    message = FRAMES.moving(JointState(header=Header(stamp=stamp), name=ROBOT.joint_names, position=q.tolist()))
    assert message is not None
    return TFMessage.model_validate({"transforms": message.transforms})


def told(stamps: list[int], moves: bool = True) -> TransformHistory:
    history = TransformHistory()
    for stamp in stamps:
        history.note(told_at(stamp, moves))
    return history


def test_camera_on_the_hand_is_where_the_arm_was_at_the_time_of_the_picture_and_not_where_it_is_now() -> None:
    history = told([0, 20 * MS, 40 * MS, 60 * MS])
    for stamp in (0, 7 * MS, 20 * MS, 33 * MS, 60 * MS):
        expected = ROBOT.fk(joints_at(stamp)) @ T_TCP_CAMERA
        np.testing.assert_allclose(history.pose("lens", FIXED, stamp), expected, atol=1e-5)
    assert np.abs(history.pose("lens", FIXED, 0) - history.pose("lens", FIXED, 60 * MS)).max() > 0.01


@pytest.mark.parametrize(("stamps", "asked", "kind"), [
    ([], 0, "early"), ([10 * MS], 30 * MS, "early"), ([10 * MS, 30 * MS], 5 * MS, "unknown_camera"),
    ([k * MS for k in range(1, KEPT + 50)], 2 * MS, "late"), ([0, 500 * MS], 250 * MS, "gap"),
])
def test_no_pose_is_made_up_for_a_time_that_tf_does_not_cover(stamps: list[int], asked: int, kind: str) -> None:
    with pytest.raises(NoTransform) as refused:
        told(stamps).pose("lens", FIXED, asked)
    assert refused.value.kind == kind


def test_an_arm_that_rests_may_be_told_of_seldom() -> None:
    history = told([0, 500 * MS], moves=False)
    np.testing.assert_allclose(history.pose("lens", FIXED, 250 * MS), ROBOT.fk(HOME) @ T_TCP_CAMERA, atol=1e-9)


def test_what_is_not_newer_is_left_out_and_unknown_and_circular_frames_are_named() -> None:
    history = told([0, 20 * MS])
    before = history.pose("lens", FIXED, 10 * MS)
    link = FRAMES.moving(JointState(header=Header(), name=ROBOT.joint_names, position=(HOME + 1).tolist()))
    assert link is not None
    history.note(TFMessage.model_validate({"transforms": link.transforms}))  # of time 0
    np.testing.assert_array_equal(history.pose("lens", FIXED, 10 * MS), before)
    with pytest.raises(NoTransform, match=r"tf_static has no frame 'elsewhere'; it has: .*lens"):
        history.pose("elsewhere", FIXED, 0)
    pose = matrix_to_pose(np.eye(4))
    ring = [TransformStamped(header=Header(frame_id=a), child_frame_id=b, transform=pose) for a, b in ("ab", "ba")]
    with pytest.raises(NoTransform, match="hangs on itself"):
        history.pose("a", TFMessage(transforms=ring), 0)


def test_frames_that_are_made_up_push_out_none_that_is_told_of_again() -> None:
    history = told([0])
    for stamp in range(1, 8):
        state = JointState(header=Header(stamp=stamp * MS), name=ROBOT.joint_names, position=list(HOME))
        message = FRAMES.moving(state)
        assert message is not None
        history.note(TFMessage.model_validate({"transforms": message.transforms}))
        history.note(TFMessage(transforms=[stamped("world", f"new_{stamp}_{k}", np.eye(4), 1) for k in range(1000)]))
    assert len(history._kept) <= MOST_FRAMES
    assert np.isfinite(history.pose("lens", FIXED, 7 * MS)).all()


def test_stamp_of_a_time_to_come_hides_nothing_that_is_told_after_it() -> None:
    history = told([0, 20 * MS])
    made_up = [each.model_copy(update={"header": Header(stamp=MAX_STAMP, frame_id=each.header.frame_id)})
               for each in told_at(40 * MS).transforms]
    history.note(TFMessage(transforms=made_up))
    for stamp in (60 * MS, 80 * MS):
        history.note(told_at(stamp))
    expected = ROBOT.fk(joints_at(70 * MS)) @ T_TCP_CAMERA
    np.testing.assert_allclose(history.pose("lens", FIXED, 70 * MS), expected, atol=1e-5)
