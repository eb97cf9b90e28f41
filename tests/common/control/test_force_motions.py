"""Force motions as goals of the executor: contact, hard limits, and all that may end or pause them."""

from typing import Any

import numpy as np
import pytest

from common import messages as m
from common.control import force_requests
from tests.common.control.wall_arm import PERIOD, WallRig


def test_until_stops_two_cycles_after_the_force_was_there_and_reports_where() -> None:
    rig = WallRig(wall=0.0123)
    top = rig.height
    assert rig.send(force=8.0, speed=0.02).state == "active"
    crossed, stopped = None, 0.0
    while rig.executor.arm.goal:
        rig.step()
        if crossed is None and rig.arm.stiffness * (rig.arm.wall - rig.height) >= 8.0:
            crossed, height = rig.now, rig.height
        elif crossed is not None and rig.now > crossed + 2 * PERIOD - 1e-9:
            stopped = stopped or rig.height
            assert rig.height == pytest.approx(stopped, abs=1e-9)
    assert rig.status.state == "succeeded" and rig.status.message.startswith("contact: ")
    assert crossed is not None and height - rig.height < 4e-4
    assert rig.status.force >= 8.0 and rig.status.distance == pytest.approx(0.0123 + 8.0 / 2e4, abs=4e-4)
    assert top - rig.height < 0.0133


def test_until_without_contact_ends_before_its_largest_distance() -> None:
    rig = WallRig()
    top = rig.height
    rig.send(force=5.0, max_distance=0.02)
    assert (rig.finish().error, rig.status.state) == ("no_contact", "aborted")
    assert 0.018 < top - rig.height <= 0.02


@pytest.mark.parametrize(("configured", "asked", "limit"), [
    (15.0, None, 15.0), (15.0, 100.0, 15.0), (60.0, 12.0, 12.0)])
def test_hard_limit_ends_the_motion_and_the_arm_backs_off(configured: float, asked: float | None, limit: float) -> None:
    rig = WallRig(wall=0.01, limits=(configured, 10.0))
    rig.send("comply", force=0.0, timeout=60.0, across=False, force_limit=asked)
    rig.run(0.5)
    rig.arm.extra = np.array([0.0, 0.0, -limit - 1.0])  # a pull along the motion
    rig.run(0.05)
    rig.arm.extra[:] = 0.0
    status = rig.finish()
    assert (status.state, status.error) == ("aborted", "force_limit") and f"limit of {limit:g} N" in status.message


def test_arm_backs_off_until_the_force_is_low_and_never_behind_its_start() -> None:
    rig = WallRig(wall=0.01, limits=(20.0, 10.0))
    rig.arm.stiffness = 3e5
    top = rig.height
    rig.send(force=19.0, speed=0.02)
    status = rig.finish()
    assert status.error == "force_limit"
    assert rig.arm.stiffness * (rig.arm.wall - rig.height) < 0.3 * 20.0 and rig.height <= top


def test_torque_limit_ends_the_motion() -> None:
    rig = WallRig(limits=(60.0, 2.0))
    rig.send(force=5.0, tip=0.2)
    rig.run(0.1)
    rig.arm.wrench = lambda: np.array([0, 0, 0, 0, 2.5, 0.0])  # type: ignore[method-assign]
    assert "torque 2.50 N m exceeds the limit of 2 N m" in rig.finish().message


def test_stop_ends_it_and_hold_pauses_it() -> None:
    rig = WallRig()
    rig.send(force=5.0)
    rig.run(0.3)
    rig.executor.authority.hold(m.HoldRequest(hold=True, reason="wait", owner="anna"), rig.now)
    rig.run(0.2)
    held = rig.height
    rig.run(1.0)
    assert rig.height == held and rig.status.state == "active" and rig.status.held
    rig.executor.authority.hold(m.HoldRequest(hold=False, owner="anna"), rig.now)
    rig.run(0.3)
    assert rig.height < held - 1e-3
    rig.executor.authority.stop(m.StopRequest(reason="stop", owner="anna"), rig.now)
    assert rig.finish().state == "cancelled"
    stopped = rig.height
    assert rig.send(force=5.0).error == "stopped"
    rig.run(0.5)
    assert rig.height == stopped


def test_force_while_held_does_not_move_the_arm() -> None:
    rig = WallRig(limits=(20.0, 10.0))
    rig.send("comply", force=0.0, timeout=60.0)
    rig.run(0.2)
    rig.executor.authority.hold(m.HoldRequest(hold=True, owner="anna"), rig.now)
    rig.run(0.2)
    held = rig.arm.q
    rig.arm.extra = np.array([0.0, 19.0, 0.0])
    rig.run(0.5)
    assert np.array_equal(rig.arm.q, held)
    rig.arm.extra = np.array([0.0, 25.0, 0.0])
    rig.run(0.5)
    assert np.array_equal(rig.arm.q, held)
    rig.executor.authority.hold(m.HoldRequest(hold=False, owner="anna"), rig.now)
    assert rig.finish().error == "force_limit"


def test_another_owner_is_refused_and_a_repeated_request_moves_nothing_twice() -> None:
    rig = WallRig()
    request = rig.request(force=5.0)
    assert rig.executor.move_by_force(request, rig.now).state == "active"
    assert rig.executor.move_by_force(rig.request(force=5.0, owner="anna"), rig.now).error == "not_owner"
    rig.finish()
    assert rig.executor.move_by_force(request, rig.now).error == "no_contact"
    assert not rig.executor.arm.goal


def test_motion_of_a_task_ends_with_the_task() -> None:
    rig = WallRig()
    rig.send(force=5.0)
    rig.run(0.3)
    rig.executor.force_motions.task_present = False
    rig.run(0.1)
    assert (rig.status.state, rig.status.error) == ("aborted", "requester_gone")
    assert rig.send(force=5.0).error == "no_requester"


def test_motion_of_an_operator_ends_when_it_is_not_requested_again(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [100.0]
    monkeypatch.setattr("common.control.force_requests.monotonic", lambda: clock[0])
    rig = WallRig()
    request = rig.request(force=5.0, owner="anna", max_distance=0.1)
    rig.executor.move_by_force(request, rig.now)
    again = request.model_copy(update={"trajectory": request.trajectory.model_copy(update={"points": []})})
    for _ in range(4):
        clock[0] += 0.6 * force_requests.KEEP_ALIVE
        rig.run(0.2)
        assert rig.executor.move_by_force(again, rig.now).state == "active"
    rig.executor.move_by_force(rig.request(force=5.0, owner="bob"), rig.now)  # refused, and no sign of anna
    clock[0] += 1.1 * force_requests.KEEP_ALIVE
    rig.run(0.1)
    assert (rig.status.state, rig.status.error) == ("aborted", "requester_gone")


def test_arm_without_a_sensor_is_refused_with_the_reason_and_a_lost_sensor_ends_the_motion() -> None:
    status = WallRig(sensor=False).send(force=5.0)
    assert status.error == "no_wrench" and "world.simulator: mujoco" in status.message
    rig = WallRig()
    rig.send(force=5.0)
    rig.run(0.2)
    rig.arm.lost = True
    assert rig.finish(0.5).error == "no_wrench" and rig.status.state == "aborted"


def test_motion_continues_from_rest_after_late_cycles_and_ends_after_a_long_pause() -> None:
    rig = WallRig(wall=0.03)
    rig.send(force=5.0, max_distance=0.05)
    rig.run(0.5)
    before = rig.arm.q
    rig.now += 0.2
    rig.step()
    assert np.abs(rig.arm.q - before).max() < 6e-4 and rig.status.state == "active"
    rig.run(0.5)
    rig.now += 0.6
    rig.run(0.05)
    assert (rig.status.state, rig.status.error) == ("aborted", "interrupted")
    rig.send(force=5.0, max_distance=0.03)
    assert rig.finish().state == "succeeded"


@pytest.mark.parametrize(("fields", "code"), [
    ({"direction": (1.0, 0.0, 0.0), "trajectory": "down"}, "path_mismatch"),
    ({"max_distance": 0.08, "trajectory": "short"}, "path_mismatch"),
    ({"speed": 0.1}, "too_fast"),
    ({"force": 60.0}, "force_limit"),
    ({"force": 10.0, "force_limit": 8.0}, "force_limit"),
])
def test_unsuitable_request_is_refused(fields: dict[str, Any], code: str) -> None:
    rig = WallRig()
    if "trajectory" in fields:
        fields["trajectory"] = rig.line(0.05)
    status = rig.send(**{"force": 5.0, **fields})
    assert (status.state, status.error) == ("rejected", code), status.message
    rig.run(0.2)
    assert not rig.executor.arm.goal


def test_compliant_arm_yields_within_its_region_and_speed() -> None:
    rig = WallRig()
    at = rig.robot.fk(rig.arm.q)[:3, 3]
    rig.send("comply", force=0.0, timeout=3.0, radius=0.004, speed=0.02, max_distance=0.03)
    rig.run(0.1)
    rig.arm.extra = np.array([20.0, 0.0, -20.0])
    last, fastest = at, 0.0
    for _ in range(280):
        rig.step()
        here = rig.robot.fk(rig.arm.q)[:3, 3]
        fastest, last = max(fastest, float(np.linalg.norm(here - last)) / PERIOD), here
    moved = here - at
    assert 0.003 < moved[0] < 0.0042 and abs(moved[1]) < 1e-4 and -0.03 <= moved[2] < -0.02
    assert fastest < 0.03
    rig.arm.extra[:] = 0.0
    assert rig.finish().state == "succeeded"


def test_compliant_arm_presses_with_the_requested_force() -> None:
    rig = WallRig(wall=0.005)
    rig.send("comply", force=12.0, timeout=4.0, across=False)
    rig.run(3.5)
    assert rig.arm.stiffness * (rig.arm.wall - rig.height) == pytest.approx(12.0, abs=0.6)


def test_scene_monitor_reads_the_planned_line_of_a_force_motion() -> None:
    rig = WallRig()
    request = rig.request(force=5.0)
    rig.executor.move_by_force(request, rig.now)
    followed = rig.executor.followed(request.id)
    assert type(followed) is m.ExecuteRequest and followed.trajectory == request.trajectory
    rig.run(2.0)
    assert 0.3 < rig.status.progress < 0.9


def test_motion_that_zeroes_first_moves_only_after_rest_and_by_the_force_since() -> None:
    rig = WallRig(wall=0.01)
    rig.arm.extra = np.array([0.0, 0.0, 6.0])  # an offset of the sensor: more than the requested force
    top = rig.height
    rig.send(force=5.0, zero=True)
    rig.run(0.1)
    assert rig.height == top and rig.executor.arm.goal, "at rest until the mean is known"
    assert (rig.finish().state, rig.executor.force.estimator.zeroed) == ("succeeded", True)
    assert rig.status.distance == pytest.approx(0.01 + 5.0 / 2e4, abs=4e-4)


@pytest.mark.parametrize("cause", ["moving", "pressing", "stopped"])
def test_motion_that_cannot_zero_ends_where_it_is(cause: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = WallRig()
    q = rig.arm.q.copy()
    if cause == "moving":
        monkeypatch.setattr(rig.arm, "read", lambda now: (rig.arm.q.copy(), np.full(7, 0.03)))
    elif cause == "pressing":
        rig.arm.extra = np.array([0.0, 0.0, 61.0])
    rig.send(force=5.0, zero=True)
    rig.run(0.05)
    if cause == "stopped":
        rig.executor.authority.stop(m.StopRequest(reason="stop", owner="anna"), rig.now)
    expected = {"moving": "not_zeroed", "pressing": "force_limit", "stopped": "cancelled"}[cause]
    assert rig.finish(10.0).error == expected and not rig.executor.force.estimator.zeroed
    assert np.array_equal(rig.arm.q, q)
