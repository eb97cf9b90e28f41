import numpy as np
import pytest

from applications.pick_place.topics import PickPlaceStatus
from common import messages as m
from recording.report import charts
from recording.report.history import MOST_LINES, RunHistory


@pytest.fixture
def run():
    return RunHistory()


def status(state, target="", **values):
    return PickPlaceStatus(state=state, target=target, **values)


def times_of(spans):
    return [(span.since, span.until) for span in spans]


def test_task_states_follow_each_other_without_gaps(run):
    for time, state, target in ((1, "IDLE", ""), (2, "IDLE", ""), (3, "GRASPING", "ball_1"), (5, "GRASPING", "ball_2"),
                                (6, "DONE", "")):
        run.on_task(time, status(state, target))
    run.finish(7)
    assert [(s.label, s.note, s.since, s.until) for s in run.tasks] == [
        ("IDLE", "", 1, 3), ("GRASPING", "ball_1", 3, 5), ("GRASPING", "ball_2", 5, 6), ("DONE", "", 6, 7)]


def test_failures_before_the_recording_or_a_task_restart_are_no_events(run):
    for time, failures, retries in ((1, 4, 1), (2, 4, 1), (3, 4, 2), (4, 5, 2), (5, 0, 0), (6, 1, 0), (7, 1, 0)):
        run.on_task(time, status("GRASPING", "ball_1", failures=failures, retries=retries, message=f"at {time}"))
    assert [(e.time, e.what, e.note) for e in run.failures] == [
        (3, "GRASPING ball_1", "at 3"), (4, "GRASPING ball_1", "at 4"), (6, "GRASPING ball_1", "at 6")]


def test_motion_spans_from_its_first_to_its_last_status(run):
    for time, goal, state in ((0, "", "none"), (1, "a", "active"), (2, "a", "active"), (3, "a", "succeeded"),
                              (4, "a", "succeeded"), (5, "b", "active"), (6, "b", "aborted"), (8, "c", "active")):
        error = "limit" if state == "aborted" else ""
        run.on_motion(time, m.MotionStatus(id=goal, state=state, error=error, source="c"))
    run.finish(9)
    assert [(o.label, o.since, o.until, o.note) for o in run.motions] == [
        ("a", 1, 3, "succeeded"), ("b", 5, 6, "aborted"), ("c", 8, 9, "not ended")]
    assert run.motions[1].error == "limit" and run.motions[1].source == "c"


def test_pick_is_at_the_last_position_of_the_target(run):
    ball = m.CollisionObject(id="ball_1", role="target", shape="sphere", dimensions=[0.03],
                             pose=m.Pose(position=m.Vector3(x=0.4, y=-0.1, z=0.03)))
    run.on_scene(1, m.PlanningScene(header=m.Header(frame_id="world"), objects=[ball]))
    run.on_task(2, status("GRASPING", "ball_1"))
    run.on_scene(2.5, m.PlanningScene(header=m.Header(frame_id="world"), objects=[]))  # the hand hides it
    for time, holding in ((3, True), (4, True), (5, False)):
        run.on_gripper(time, m.GripperState(holding=holding))
    assert [(p.time, p.position, p.label) for p in run.picks] == [(3, (0.4, -0.1, 0.03), "ball_1")]
    assert times_of(run.holding) == [(3, 5)]


def test_holding_and_pausing_are_spans(run):
    for time, held in ((1, False), (2, True), (3, True), (4, False), (6, True)):
        run.on_motion(time, m.MotionStatus(held=held))
    run.on_task(1, status("GRASPING", paused=True))
    run.finish(8)
    assert times_of(run.held) == [(2, 4), (6, 8)] and times_of(run.paused) == [(1, 8)]


def test_log_has_a_limited_number_of_warnings_and_errors(run):
    for k in range(MOST_LINES + 5):
        for level in ("info", "error"):
            run.on_log(k, m.LogLine(service="a", level=level, message="x"))
    assert len(run.log) == MOST_LINES and run.lines_left_out == 5 and {e.level for e in run.log} == {"error"}


def test_joint_states_without_the_named_joints_are_omitted(run):
    for time, values in ((1, {"name": ["f", "b", "a"], "position": [9, 2, 1], "velocity": [0, 4, 3]}),
                         (2, {"name": ["b"], "position": [2]}), (3, {"name": ["a", "b"], "position": [5, 6]})):
        run.on_joints(time, m.JointState(header=m.Header(), **values))
    times, q, v = run.joints(["a", "b"])
    assert times.tolist() == [1, 3] and q.tolist() == [[1, 2], [5, 6]] and v[0].tolist() == [3, 4]
    assert np.isnan(v[1]).all()


def test_prismatic_joints_are_not_labelled_in_radians():
    text = charts.joints(np.arange(2.0), np.zeros((2, 1)), np.zeros((2, 1)), ["lift"], None)
    assert "position [rad or m]" in text and "speed [rad/s or m/s]" in text


@pytest.mark.parametrize(("shape", "dimensions", "size"), [
    ("box", [0.4, 0.2, 0.1], [0.2, 0.4]), ("cylinder", [0.1, 0.3], [0.2, 0.2])])
def test_footprint_is_the_solid_from_above(run, shape, dimensions, size):
    turned = m.Pose(position=m.Vector3(x=1, y=2), orientation=m.Quaternion(z=np.sqrt(0.5), w=np.sqrt(0.5)))
    thing = m.CollisionObject(id="t", role="fixture", shape=shape, dimensions=dimensions, pose=turned)
    run.on_scene(0, m.PlanningScene(header=m.Header(), objects=[thing]))
    corners = run.footprints["t"].corners
    assert np.ptp(corners, axis=0) == pytest.approx(size, abs=1e-9) and corners.mean(axis=0) == pytest.approx([1, 2])


def test_long_curves_are_thinned_and_keep_their_extremes():
    times = np.linspace(0, 60, 6001)
    values = np.sin(times)[:, None] * 0.1
    values[1234], values[4321] = 3.0, -2.0
    indices = charts.thinned(times, values)
    assert len(indices) <= charts.MAX_POINTS + 4 and {1234, 4321, 6000} <= set(indices.tolist())
    assert charts.thinned(times[:50], values[:50]).tolist() == list(range(50))


def test_history_of_any_length_has_a_bounded_number_of_entries(run, monkeypatch):
    monkeypatch.setattr("recording.report.history.MOST_JOINT_STATES", 100)
    monkeypatch.setattr("recording.report.history.MOST_ENTRIES", 50)
    for k in range(1000):
        run.on_joints(k, m.JointState(header=m.Header(stamp=k), name=["a"], position=[k]))
        run.on_trajectory(k, m.JointTrajectory(header=m.Header(stamp=k), joint_names=["a"], points=[]))
    assert 50 <= len(run.joint_states) <= 100 and len(run.trajectories) == 50
    steps = np.diff(run.joint_times)
    assert run.joint_times[0] < 32 and run.joint_times[-1] > 980 and max(steps) <= 2 * min(steps), "the whole run"


def test_changes_of_signals_and_losses_of_their_backend_are_events(run):
    def state(clamp, pressure=1.5, reason="", unplugged=""):
        return m.IoState(reason=reason, signals=[
            m.IoSignal(name="clamp", direction="output", value=clamp),
            m.IoSignal(name="pressure", direction="input", value=pressure, unit="bar", reason=unplugged)])

    for time, message in enumerate((state(None), state(False), state(True), state(True, 2.0), state(True, 2.0, "gone"),
                                    state(True, 2.0), state(True, 2.0, "", "unplugged"))):
        run.on_signals(time, message)
    assert [(each.time, each.what, each.note) for each in run.signals] == [
        (2, "clamp", "on"), (3, "pressure", "2.0 bar"), (4, "backend", "gone"), (5, "backend", "connected"),
        (6, "pressure", "unplugged")]
