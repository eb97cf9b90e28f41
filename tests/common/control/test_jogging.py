"""Jogging, cycle by cycle: velocities, limits, and how soon the arm is at rest."""

import numpy as np
import pytest

from common.errors import Refused
from common.messages import Vector3
from tests.common.control.jogged_arm import PERIOD, arm, ur5

__all__ = ["arm", "ur5"]


@pytest.mark.parametrize("sign", [1, -1])
def test_joint_moves_at_the_requested_velocity_and_the_others_stay(arm, sign):
    joint = arm.robot.joint_names[3]
    arm.jog(0.5, joints={joint: sign * 0.2})
    before = arm.q
    arm.jog(0.5, joints={joint: sign * 0.2})
    moved = arm.q - before
    assert moved[3] == pytest.approx(sign * 0.1, abs=1e-6) and not np.delete(moved, 3).any()


def test_arm_is_at_rest_a_fifth_of_a_second_after_the_newest_command(arm):
    rng = np.random.default_rng(1)
    for _ in range(10):
        dq = rng.uniform(-3, 3, arm.robot.dof)
        arm.jog_joints(rng.uniform(0.02, 0.6), dq)
        arm.run(0.19)  # with the cycle of the newest command
        assert arm.at_rest()
    arm.assert_within_limits()


def test_set_points_keep_the_limits_for_any_commands(arm):
    rng = np.random.default_rng(2)
    for _ in range(80):
        kind = rng.integers(3)
        if kind == 0:
            arm.jog_joints(0.02 * rng.integers(1, 20), rng.uniform(-9, 9, arm.robot.dof))
        elif kind == 1:
            arm.jog_tool(0.02 * rng.integers(1, 20), rng.uniform(-1, 1, 3), rng.uniform(-2, 2, 3),
                         frame=str(rng.choice(["base", "tool", "world"])))
        else:
            arm.run(0.01 * rng.integers(1, 20))
    arm.assert_within_limits()
    q = np.array([q for _, q in arm.sent])
    assert set(arm.refused) <= {RELEASE_FIRST} and np.ptp(q, axis=0).min() > 0.05
    assert (arm.robot.lower - q).max() < 1e-6 and (q - arm.robot.upper).max() < 1e-6


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.slow
def test_each_joint_comes_to_rest_before_its_end(arm, sign):
    for k, joint in enumerate(arm.robot.joint_names):
        arm.jog(0.2, joints={joint: sign * 9.0})
        arm.authority._jogging._kinematics, before = None, arm.q - 1  # without the speed limit of the tool, faster
        while not np.array_equal(before, arm.q):
            before = arm.q
            arm.jog(0.5, joints={joint: sign * 9.0})
        end = arm.robot.upper[k] if sign > 0 else arm.robot.lower[k]
        assert 0 <= sign * (end - arm.q[k]) < 0.01
        arm.authority._jogging._kinematics = arm.robot
    arm.assert_within_limits()


@pytest.mark.parametrize("frame", ["base", "tool", "world"])
@pytest.mark.parametrize("axis", range(3))
def test_tool_moves_straight_along_the_axis_of_the_frame(arm, frame, axis):
    arm.jog_joint(0.2, 0.5)  # turn away from the axes
    arm.run(0.5)
    start = arm.tcp
    velocity = np.eye(3)[axis] * 0.1
    arm.jog_tool(0.6, velocity, frame=frame)
    arm.run(0.2)
    direction = {"tool": start[:3, :3], "base": arm.robot.base_axes, "world": np.eye(3)}[frame] @ velocity
    moved = arm.tcp[:3, 3] - start[:3, 3]
    assert moved @ direction / np.linalg.norm(moved) / 0.1 > 0.9999 and 0.05 < np.linalg.norm(moved) < 0.08
    assert np.allclose(arm.tcp[:3, :3], start[:3, :3], atol=2e-3)


def test_tool_turns_about_its_own_centre(arm):
    start = arm.tcp
    arm.jog_tool(0.5, angular=(0, 0, 0.4), frame="tool")
    arm.run(0.2)
    turned = start[:3, :3].T @ arm.tcp[:3, :3]
    assert np.linalg.norm(arm.tcp[:3, 3] - start[:3, 3]) < 2e-3
    assert 0.1 < np.arctan2(turned[1, 0], turned[0, 0]) < 0.3


def test_tool_keeps_the_manual_reduced_speed(arm):
    arm.jog_tool(1.0, (3.0, 0.0, 0.0))
    arm.jog_joint(1.0, 9.0)
    assert 0.2 < arm.tool_speed() <= 0.251


@pytest.mark.parametrize("seed", [2, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in range(3, 9))])
def test_tool_keeps_that_speed_near_the_ends_of_joints(arm, seed):
    rng = np.random.default_rng(seed)
    for _ in range(25):
        if rng.random() < 0.5:
            arm.jog_joints(0.6, rng.choice([-9.0, 0.0, 9.0], arm.robot.dof))
        else:
            arm.jog_tool(0.6, rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 3))
        arm.run(0.2)
    assert arm.tool_speed() <= 0.27


def test_tool_keeps_speed_and_line_where_a_joint_reaches_its_end(arm):
    arm.jog_tool(14.0, (0.0, 0.0, -0.2))
    arm.run(0.5)
    assert arm.tool_speed() <= 0.251
    aside = np.linalg.norm((arm.positions - arm.positions[0])[:, :2], axis=1)
    assert aside.max() < 0.006
    assert any("cannot keep its direction" in message for message in messages(arm))


def messages(arm):
    return [report.motion.message for report in arm.reports if report.motion]


@pytest.mark.parametrize("linear", [(0.2, 0.0, 0.1), (0.1, -0.2, 0.0)])
def test_tool_keeps_its_direction_to_the_end_of_reach_and_stops_there_with_a_reason(arm, linear):
    direction = np.array(linear) / np.linalg.norm(linear)
    before = arm.tcp
    arm.jog_tool(6.0, linear)
    arm.run(0.5)
    steps = np.diff(arm.positions[::5], axis=0)
    steps = steps[np.linalg.norm(steps, axis=1) > 1e-3]
    assert len(steps) > 20 and (steps @ direction / np.linalg.norm(steps, axis=1)).min() > np.cos(np.radians(8))
    away = arm.positions - before[:3, 3]
    assert np.linalg.norm(away - np.outer(away @ direction, direction), axis=1).max() < 5e-3
    assert np.allclose(arm.tcp[:3, :3], before[:3, :3], atol=5e-3), "it does not turn"
    assert messages(arm)[-1].startswith("jogging ended: the tool cannot keep its direction, as the arm is at the end")
    assert sum("jogging ended" in note for report in arm.reports for note in report.notes) == 1
    end = arm.tcp[:3, 3]
    arm.jog_tool(1.0, linear)
    arm.run(0.5)
    assert np.linalg.norm(arm.tcp[:3, 3] - end) < 1e-3
    arm.jog_tool(1.0, -np.array(linear))
    moved = arm.tcp[:3, 3] - end
    assert moved @ -direction > 0.05 and moved @ -direction / np.linalg.norm(moved) > np.cos(np.radians(5))
    assert messages(arm)[-1] == "", "the reason is over"


@pytest.mark.slow
def test_tool_hardly_moves_at_the_end_of_its_reach_and_comes_back(arm):
    arm.jog_tool(20.0, (0.2, 0.0, 0.0))
    before = arm.tcp[:3, 3]
    arm.jog_tool(0.5, (0.2, 0.0, 0.0))
    assert np.linalg.norm(arm.tcp[:3, 3] - before) < 0.001
    arm.run(0.35)  # the button is released
    arm.jog_tool(8.0, (-0.2, 0.0, 0.0))
    assert arm.tcp[0, 3] < before[0] - 0.03
    arm.assert_within_limits()


def test_command_of_zero_brings_the_arm_to_rest_at_once(arm):
    arm.jog_tool(0.5, (0.1, 0.0, 0.0))
    arm.jog_tool(0.12)
    assert arm.at_rest()


def test_stalled_executor_makes_no_jump_while_it_jogs(arm):
    rng = np.random.default_rng(3)
    for _ in range(20):
        arm.jog_joints(0.3, rng.uniform(-1, 1, arm.robot.dof))
        at = arm.q
        arm.step(rng.uniform(0.02, 0.5))
        assert np.all(np.abs(arm.q - at) <= PERIOD * arm.limits.velocity * 0.2)


# --- refusals ---


def test_invalid_command_is_refused(ur5):
    for fields, code, message in (
        ({"joints": {"nose": 1.0}}, "unknown_joint", "'nose' is no joint of the arm; choices: "),
        ({"joints": {ur5.joint: 1.0}, "linear": Vector3(x=1.0)}, "contradiction", "exclude each other"),
    ):
        with pytest.raises(Refused, match=message) as refusal:
            ur5.command(**fields)
        assert refusal.value.code == code
        ur5.run(0.35)
    ur5.command(joints={}, linear=Vector3(x=0.1))


def test_neither_a_goal_nor_another_operator_moves_a_jogged_arm_and_a_goal_excludes_jogging(ur5):
    ur5.jog_joint(0.3)
    with pytest.raises(Refused, match=r"the motion is owned by ann \(operator\)"):
        ur5.command(owner="bob", joints={ur5.joint: -0.2})
    assert ur5.execute("one", "ann").error == "busy"
    ur5.run(0.5)
    assert ur5.execute("two", "ann").state == "active"
    ur5.jog_joint(2.2, -0.2)
    last = [report.motion for report in ur5.reports if report.motion][-1]
    assert (last.id, last.state) == ("two", "succeeded") and set(ur5.refused) == {"busy", RELEASE_FIRST}


RELEASE_FIRST = "let_go"  # code of commands of a button that was not released since a stop, a hold or a restart


def assert_jogs_only_after_a_release(arm):
    before = arm.q
    arm.jog_joint(1.0, 0.5)
    assert np.array_equal(arm.q, before) and RELEASE_FIRST in arm.refused
    arm.run(0.35)
    arm.jog_joint(0.3, 0.5)
    assert not np.array_equal(arm.q, before)


@pytest.mark.parametrize("interruption", ["stop", "hold"])
def test_pressed_button_moves_nothing_after_a_stop_or_a_hold_until_it_is_released(ur5, interruption):
    ur5.jog_joint(0.3)
    ur5.stop("bob") if interruption == "stop" else ur5.hold("bob")
    ur5.jog_joint(0.2)
    before = ur5.q
    ur5.jog_joint(1.0)
    ur5.start_task("bob")
    assert np.array_equal(ur5.q, before)
    assert_jogs_only_after_a_release(ur5)


@pytest.mark.parametrize("others", [15, 16, 40])
def test_many_refused_clients_do_not_make_the_pressed_button_count_again(ur5, others):
    ur5.jog_joint(0.3)
    ur5.stop("bob")
    for _ in range(10):
        for k in range(others):
            with pytest.raises(Refused):
                ur5.command(owner=f"other {k}", joints={ur5.joint: 0.2})
        ur5.jog_joint(0.02)
    ur5.start_task("bob")
    assert_jogs_only_after_a_release(ur5)


def test_button_pressed_over_a_restart_of_the_executor_moves_nothing(ur5):
    ur5.restart()
    assert_jogs_only_after_a_release(ur5)
    assert set(ur5.refused) == {RELEASE_FIRST}


def test_only_the_operator_who_stopped_the_arm_may_jog_it(ur5):
    acknowledged = ur5.stop("ann").newest
    ur5.jog_joint(0.3, owner="bob", acknowledged=acknowledged)
    ur5.jog_joint(0.3)
    assert ur5.at_rest() and set(ur5.refused) == {"stopped", RELEASE_FIRST}
    ur5.run(0.3)
    ur5.jog_joint(0.3, acknowledged=acknowledged)
    assert not ur5.at_rest()
