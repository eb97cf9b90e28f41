"""Goals of the trajectory controller: what is followed, refused, repeated, stopped and too far off."""

import re
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.control.goals import REMEMBERED, GoalMemory
from common.control.trajectory import Trajectory
from common.hardware.lag import LagHardware
from common.hardware.mock import MockHardware
from common.messages import Header, Interlock, MotionStatus
from tests.common.control.rig import LateArm
from tests.drivers.rig import START, STEP, T0, Rig
from tests.harness import ROOT


@pytest.mark.parametrize("hardware", [None, LagHardware(START, 0.03, None)])
def test_goal_is_followed_to_its_end(limits, rest_to_rest, hardware):
    rig = Rig(limits, hardware)
    assert rig.accept("a", rest_to_rest([0, 0], [1, -0.5])).state == "active"
    status = rig.until_over()
    assert (status.id, status.state, status.progress) == ("a", "succeeded", 1.0)
    assert np.allclose(rig.q, [1, -0.5], atol=2e-3)


def test_progress_grows_with_time_and_each_point_is_computed_once(rig, rest_to_rest, monkeypatch):
    asked, original = [], Trajectory.at
    monkeypatch.setattr(Trajectory, "at", lambda self, time: (asked.append(time), original(self, time))[1])
    rig.accept("a", rest_to_rest([0, 0], [1, 1]))
    seen = [rig.step().progress for _ in range(50)]
    assert seen == sorted(seen) and seen[-1] == pytest.approx(0.5)
    assert len(asked) == len(set(asked)) >= 50


def test_active_goal_continues_whatever_else_is_requested_and_the_next_starts_at_its_end(rig, rest_to_rest):
    there = rest_to_rest([0, 0], [1, 1])
    rig.accept("a", there)
    rig.step()
    refused = rig.accept("b", there)
    assert (refused.state, refused.error) == ("rejected", "busy") and "'a'" in refused.message
    unknown = rig.controller.cancel("c", "?", rig.now)
    assert (unknown.state, unknown.error) == ("none", "unknown_goal")
    assert rig.controller.status.id == "a" and rig.until_over().state == "succeeded"
    assert rig.controller.cancel("a", "late", rig.now).state == "succeeded"
    assert rig.controller.cancel("", "late", rig.now).state == "succeeded"
    assert rig.accept("d", rest_to_rest([1, 1], [0, 0])).state == "active"
    assert rig.until_over().state == "succeeded"


def test_rejected_goal_does_not_move_the_robot_and_stays_rejected(rig, rest_to_rest):
    first = rig.accept("a", rest_to_rest([0.5, 0], [1, 1]))
    assert (first.state, first.error) == ("rejected", "start_mismatch")
    assert rig.accept("a", rest_to_rest([0, 0], [1, 1])) == first
    rig.step()
    assert np.array_equal(rig.q, START) and rig.controller.status.state == "none"


def test_repeated_id_returns_the_state_of_that_goal_and_moves_nothing(rig, rest_to_rest):
    back = rest_to_rest([1, 1], [0, 0])
    rig.accept("a", rest_to_rest([0, 0], [1, 1]))
    rig.step()
    assert rig.accept("a", back) == rig.controller.status and rig.controller.status.state == "active"
    rig.until_over()
    before = rig.q
    assert rig.accept("a", back) == rig.controller.status and rig.controller.status.state == "succeeded"
    rig.step()
    assert np.array_equal(rig.q, before)


def test_refused_goals_do_not_displace_followed_ones(rig, rest_to_rest):
    there, back = rest_to_rest([0, 0], [0.01, 0], 0.5), rest_to_rest([0.01, 0], [0, 0], 0.5)
    rig.accept("first", there)
    rig.until_over()
    rig.accept("running", back)
    for number in range(REMEMBERED + 1):
        rig.accept(f"busy {number}", there)
    assert rig.accept("running", there).state == "active"
    assert rig.accept(f"busy {REMEMBERED}", there).error == "busy"
    rig.until_over()
    assert rig.accept("first", there).state == "succeeded", "not followed again"
    assert rig.accept("busy 0", there).state == "active", "forgotten by now: a new goal"


def test_number_of_remembered_goals_is_documented():
    stated = re.search(r"newest goals by id \((\d+) accepted", (ROOT / "docs" / "security.md").read_text())
    assert stated is not None and int(stated[1]) == REMEMBERED


def test_old_goals_are_remembered_in_full_and_take_little_memory():
    def state(number):
        interlock = Interlock(kind="held", by="anna", reason="an \u00e4rm\n", since=1_700_000_000_000_000_000 + number)
        return MotionStatus(header=Header(stamp=number), id=f"{number}", state="aborted", progress=1 / 3,
                            error="path_tolerance", message="joint 3", speed_scaling=0.1, interlocks=[interlock])

    memory = GoalMemory()
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    for number in range(500):
        memory.put(f"{number}", state(number), refused=number % 3 == 0)
    taken = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert all(memory.get(f"{number}") == state(number) for number in range(500))
    assert taken < 500 * 1000, "of 6 kB that it takes as an object"
    memory.put("7", state(8))
    memory.put("9", state(9))
    assert memory.get("7") == state(8), "what was packed changes too"


@given(fraction=st.floats(0.02, 0.98), end=st.floats(0.1, 1.0))
def test_stopped_goal_comes_to_rest_soon_on_its_path_within_limits(limits, rest_to_rest, fraction, end):
    rig = Rig(limits)
    rig.accept("a", rest_to_rest([0, 0], [end, -end / 2]))
    while rig.now - T0 < fraction:
        rig.step()
    answer = rig.controller.cancel("a", "tested", rig.now)
    assert answer.state == "active" and "tested" in answer.message
    assert rig.accept("b", rest_to_rest([0, 0], [1, 1])).error == "busy"
    status, stopped = rig.until_over(), rig.now
    assert (status.state, status.error, status.message) == ("cancelled", "cancelled", "tested")
    assert stopped - T0 < fraction + 0.5
    positions, velocities = np.array(rig.positions), np.array(rig.velocities)
    assert np.allclose(positions[:, 1], -positions[:, 0] / 2, atol=1e-9), "the path is a straight line"
    assert np.allclose(velocities[-1], 0.0, atol=1e-2)
    assert np.all(np.abs(np.diff(velocities, axis=0)) / STEP <= limits.acceleration * 1.1)
    assert positions[-1, 0] <= end + 1e-9
    assert rig.step().state == "cancelled" and np.allclose(rig.positions[-1], rig.positions[-2], atol=1e-9)



def test_arm_that_falls_behind_is_braked_along_its_path_and_held_where_it_comes_to_rest(limits, rest_to_rest):
    rig = Rig(limits, LagHardware(START, 1.0, None), path=0.1)
    rig.accept("a", rest_to_rest([0, 0], [0.2, 1.0]))
    status = rig.until_over()
    assert (status.state, status.error, status.source) == ("aborted", "path_tolerance", "controller")
    assert "elbow" in status.message and status.progress < 1
    rig.run(600)
    positions = np.array(rig.positions)
    assert np.allclose(positions[:, 1], 5 * positions[:, 0], atol=1e-9), "the path is a straight line"
    assert np.all(np.abs(np.diff(positions, 2, axis=0)) <= 1.021 * STEP**2 * limits.acceleration)
    assert np.allclose(rig.q, positions[-1], atol=0.02) and np.array_equal(positions[-1], positions[-100])


def test_arm_that_does_not_arrive_ends_the_goal_after_the_goal_time(limits, rest_to_rest):
    class Sticky(MockHardware):
        def read(self, now):
            q, dq = super().read(now)
            return q * 0.95, 0 * dq

    rig = Rig(limits, Sticky(START, None), goal_time=0.5)
    rig.accept("a", rest_to_rest([0, 0], [1, 1]))
    status = rig.until_over()
    assert (status.state, status.error) == ("aborted", "goal_tolerance") and 1.5 < rig.now - T0 < 1.6



# --- arms with a delay of 0.1 s, according to their driver ---


@pytest.fixture
def delayed(limits, rest_to_rest):
    """Return a rig whose arm is late by some seconds and has started a goal."""
    def make(seconds=0.11, path=0.02):
        rig = Rig(limits, LateArm(START, None, seconds), path=path)
        rig.controller.history.delay = 0.1
        rig.accept("a", rest_to_rest([0, 0], [1, 1]))
        return rig

    return make


def test_arm_with_a_delay_is_compared_with_its_past_set_points_since_the_last_stop(delayed, rest_to_rest):
    rig = delayed()
    for _ in range(60):
        assert rig.step().state == "active", "0.1 s at 1.9 rad/s is ten times the tolerance"
    rig.controller.fault("it was stopped")
    rig.hardware.stop()
    rig.step()
    assert rig.accept("b", rest_to_rest(rig.q, [0, 0])).state == "active"
    assert rig.until_over().state == "succeeded"


def test_progress_of_an_arm_with_a_delay_is_its_own_and_never_decreases(delayed):
    rig, seen = delayed(path=0.1), []
    for k in range(105):
        rig.controller.history.delay = 0.1 + 0.02 * (k % 2)
        seen.append(rig.step().progress)
    assert seen == sorted(seen) and seen[49] == pytest.approx(0.4, abs=0.011)
    assert seen[99] == pytest.approx(0.9, abs=0.011), "the set-points are there, the arm is not"
    assert rig.until_over().progress == 1.0


def test_delayed_readings_are_compared_with_the_set_points_of_their_time(delayed):
    rig = delayed()
    rig.run(60)
    current, old = rig.hardware.read, rig.hardware.read(rig.now)
    rig.hardware.read = lambda now: old
    for _ in range(10):
        rig.controller.history.delay += STEP
        assert rig.step().state == "active" and not rig.controller.status.message
    rig.hardware.read, rig.controller.history.delay = current, 0.1
    assert rig.until_over().state == "succeeded"


def test_arm_later_than_usual_is_on_its_path_and_one_that_stays_behind_is_not(delayed):
    assert delayed(0.19).until_over().state == "succeeded"
    assert delayed(0.26).until_over().error == "path_tolerance"
