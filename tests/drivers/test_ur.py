"""The backend of Universal Robots, by the vendor-neutral client library, against a double of a controller."""

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from common.errors import ConfigError
from common.hardware.driven_arm import DrivenArm, Reading
from common.hardware.interface import Limits
from common.hardware.loading import is_simulated
from drivers.ur import Options, create
from tests.common.hardware.test_backends import robot
from tests.doubles.ur_host import UrHost
from tests.drivers.driven_rig import FASTEST, PERIOD, SWING, TIMEOUT, Rig

pytestmark = [pytest.mark.slow, pytest.mark.alone, pytest.mark.timeout(120)]
if os.environ.get("CI") != "true":
    pytest.importorskip("rtde_control", reason="make setup EXTRAS=ur")

SIX = np.ones(6)
LIMITS = Limits(tuple("abcdef"), -6 * SIX, 6 * SIX, 3 * SIX, 5 * SIX, 10 * SIX, 500 * SIX)


def create_arm(host: str, **options: object) -> DrivenArm:
    given = Options(host=host, **{"model": "ur5e", "ahead": 0.2, **options})  # type: ignore[arg-type]
    return create(SimpleNamespace(gripper=None), LIMITS, 0 * SIX, given)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def host() -> Iterator[UrHost]:
    with UrHost("127.0.0.41") as host:
        yield host


@pytest.fixture(scope="module")
def rig(host: UrHost) -> Iterator[Rig]:
    rig = Rig(create_arm(host.host), 0 * SIX)
    yield rig
    rig.arm.close()


def test_arm_is_read_where_it_is_and_follows_from_there(host: UrHost, rig: Rig) -> None:
    rig.until("")
    assert np.allclose(rig.arm.read(0.0)[0], host.command()["q"], atol=1e-3)
    assert np.allclose(rig.arm.read(0.0)[0], [0, -1.57, 0.5, -1.57, 0, 0], atol=1e-6), "it has not moved"
    assert rig.swing(SWING) == ""
    rig.until("")
    state = host.command()
    assert state["commands"] > 100 and state["stops"] == 0 and state["fastest"] < 1.0


def test_ceasing_set_points_bring_the_arm_to_rest(host: UrHost, rig: Rig) -> None:
    rig.until("")
    assert rig.swing(SWING / 4) == ""
    end = time.monotonic() + TIMEOUT
    while max(map(abs, host.command()["qd"])) > 1e-3:  # without set-points
        assert time.monotonic() < end
        time.sleep(PERIOD)
    assert "ceased to come" in rig.until("ceased to come")
    rig.until_it_moves()  # from where it is


def test_short_hold_up_of_the_driver_does_not_stop_the_arm(host: UrHost, rig: Rig) -> None:
    rig.until_it_moves()
    rig.until("")
    stops = host.command()["stops"]
    (driver,) = [child for child in multiprocessing.active_children() if child.is_alive()]
    assert rig.target is not None
    q0, began, gaps = rig.target, time.monotonic(), [0.4, 0.8, 1.2]
    while (t := time.monotonic() - began) < np.pi and not rig.cycle(
        q0 + 0.5 * (1 - np.cos(2 * t)) * SIX, np.sin(2 * t) * SIX
    ):
        if gaps and t > gaps[0]:
            gaps.pop(0)
            os.kill(driver.pid or 0, signal.SIGSTOP)
            time.sleep(0.04)
            rig.arm.read(0.0)
            assert rig.arm.delay > rig.arm.ahead + 0.03 + 0.03, "readings are that old"
            os.kill(driver.pid or 0, signal.SIGCONT)
    assert host.command()["stops"] == stops and rig.arm.late > 0.03, rig.problems[-3:]
    rig.until_it_moves()


def test_held_up_driver_does_not_consider_the_arm_disconnected(host: UrHost, rig: Rig) -> None:
    rig.until_it_moves()
    driver, count = multiprocessing.active_children(), len(rig.problems)
    for _ in range(5):
        os.kill(driver[0].pid or 0, signal.SIGSTOP)
        time.sleep(0.2)  # longer than the time-out of the arm, shorter than that of the driver
        os.kill(driver[0].pid or 0, signal.SIGCONT)
        rig.until_it_moves()
    assert not [each for each in rig.problems[count:] if "no message from the controller" in each]
    assert multiprocessing.active_children() == driver, "in the same process"


def test_set_points_have_the_time_of_their_computation(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.until("")
    sent: list[tuple[object, ...]] = []
    monkeypatch.setattr(rig.arm._process, "send", lambda message: sent.append(message) or True)
    q, now = rig.measured, time.monotonic()
    for n in range(5):
        time.sleep(0.01 + 0.004 * (n % 2))
        rig.arm.write(q, 0 * SIX, now + 0.01 * n)
    stamps = [message[2] for message in sent]
    assert np.allclose(np.diff(np.array(stamps, dtype=float)), 0.01, atol=1e-6)


def test_ended_program_is_reported_at_once_and_restarted(
    host: UrHost, rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.until_it_moves()
    driver = multiprocessing.active_children()
    messages, receive = list[str](), rig.arm._process.on_message
    monkeypatch.setattr(rig.arm._process, "on_message",
                        lambda message: (messages.append(message.state.message), receive(message)))
    host.command("end")
    assert rig.wave(2.0) != "", "it comes to rest"
    rig.until_it_moves()
    assert any("its program has ended" in message for message in messages)
    assert multiprocessing.active_children() == driver, "in the same process"


def test_arm_that_brakes_by_itself_reports_it_before_it_is_at_rest(
    host: UrHost, rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.until_it_moves()
    rig.until("")
    assert rig.swing(SWING / 4) == ""
    messages, receive = list[Reading](), rig.arm._process.on_message
    monkeypatch.setattr(rig.arm._process, "on_message", lambda message: (messages.append(message), receive(message)))
    end = time.monotonic() + TIMEOUT
    while not messages or not messages[-1].ceased:  # without set-points
        assert time.monotonic() < end
        time.sleep(0.001)
    assert max(map(abs, next(each for each in messages if each.ceased).state.dq)) > 0.05, "while it moves"
    while problem := rig.cycle(None, 0 * SIX):
        assert "ceased to come" in problem, "no other problem until it is at rest"
    assert max(map(abs, host.command()["qd"])) < FASTEST / 2, "servoJ smooths, but the set-points have stopped"


def test_protective_stop_is_reported_and_ends_only_on_request(host: UrHost, rig: Rig) -> None:
    rig.until("")
    host.command("protect")
    assert rig.wave(2.0) != ""
    rig.until("protective stop")
    assert rig.arm.state.mode == "protective_stop"
    host.command("normal")  # at the pendant: that alone moves nothing
    rig.until("was stopped for safety")
    where = host.command()["q"]
    assert rig.done(rig.arm.order("recover")) == ""
    rig.until("")
    assert np.allclose(host.command()["q"], where) and rig.swing(0.3) == "", rig.problems[-6:]


def test_protective_stop_persists_over_a_lost_link(host: UrHost, rig: Rig) -> None:
    rig.until("")
    host.command("protect")
    rig.until("protective stop")
    host.command("pull 1")
    rig.until("no message")
    host.command("normal")
    rig.until("was stopped for safety")
    assert rig.done(rig.arm.order("recover")) == ""
    rig.until_it_moves()


def test_stop_before_a_restart_of_this_process_blocks_motions(host: UrHost, rig: Rig) -> None:
    rig.until("")
    rig.arm.stopped = True
    rig.until("was stopped for safety")
    assert rig.done(rig.arm.order("recover")) == "" and not rig.arm.stopped
    rig.until_it_moves()


def test_request_does_not_end_an_emergency_stop(host: UrHost, rig: Rig) -> None:
    rig.until("")
    host.command("emergency")
    rig.until("emergency stop")
    assert "pressed" in rig.done(rig.arm.order("recover"))
    host.command("normal")
    rig.until("was stopped for safety")
    assert rig.done(rig.arm.order("recover")) == ""
    rig.until("")


def test_pulled_cable_is_reported_and_the_arm_found_where_it_stopped(host: UrHost, rig: Rig) -> None:
    rig.until("")
    host.command("pull 1")
    problem = rig.wave(3.0)
    assert "no message" in problem or "does not take" in problem
    rig.until("")
    assert np.allclose(rig.arm.read(0.0)[0], host.command()["q"], atol=1e-3)
    rig.until_it_moves()


def test_restarted_controller_waits_for_power(host: UrHost, rig: Rig) -> None:
    rig.until("")
    host.command("reboot 1")
    assert rig.wave(3.0) != ""
    rig.until("without power")
    assert rig.arm.state.mode == "off"
    assert rig.done(rig.arm.order("enable")) == ""
    rig.until_it_moves()


def test_jump_is_not_played(host: UrHost, rig: Rig) -> None:
    rig.until("")
    end = time.monotonic() + TIMEOUT
    while rig.target is None or np.abs(np.array((before := host.command())["q"]) - rig.target).max() > 1e-3 or max(
        map(abs, before["qd"])
    ) > 1e-3:
        rig.cycle(None, 0 * SIX)  # earlier set-points are still played
        assert time.monotonic() < end
    rig.cycle(rig.target + 0.5, 0 * SIX)
    assert "would jump" in rig.until("would jump")
    after = host.command()
    assert after["stops"] == before["stops"] and np.allclose(after["q"], before["q"], atol=2e-3)


def test_freedrive_releases_the_arm_until_it_is_ended(host: UrHost, rig: Rig) -> None:
    rig.until("")
    assert rig.done(rig.arm.order("freedrive", 1.0)) == "" and host.command()["freedrive"]
    assert "moved by hand" in rig.until("moved by hand")
    assert rig.done(rig.arm.order("freedrive", 0.0)) == "" and not host.command()["freedrive"]
    rig.until("")


def test_payload_is_set_and_the_slider_reported(host: UrHost, rig: Rig) -> None:
    rig.until("")
    assert rig.done(rig.arm.order("payload", 1.25)) == "" and host.command()["payload"][0] == 1.25
    host.command("slider 0.3")
    end = time.monotonic() + TIMEOUT
    while rig.arm.state.speed != 0.3:
        rig.cycle(None, 0 * SIX)
        assert time.monotonic() < end
    host.command("slider 1")
    assert "cannot dance" in rig.done(rig.arm.order("dance"))


def test_payload_is_set_only_between_motions(host: UrHost, rig: Rig) -> None:
    rig.until_it_moves()
    rig.until("")
    orders, tries = list[int](), 0

    def ask(t: float) -> None:
        nonlocal tries
        if t < SWING / 4:
            orders.clear()
        elif not orders:  # another mass in each try: an interrupted one may have set it at rest
            tries += 1
            orders.append(rig.arm.order("payload", 0.6 + 0.01 * tries))

    assert rig.swing(SWING, ask) == ""
    before = host.command()["payload"][0]
    assert "while the arm moves" in rig.done(orders[0]) and before != 0.6 + 0.01 * tries
    rig.until("")
    number = rig.arm.order("payload", 0.5, 0.0, 0.0, 0.1)
    end = time.monotonic() + TIMEOUT
    while (outcome := rig.arm.outcome(number)) is None:
        assert rig.cycle(None, 0 * SIX) == "" and time.monotonic() < end
    assert outcome == "" and host.command()["payload"] == [0.5, 0.0, 0.0, 0.1]
    assert rig.swing(SWING / 4) == "", "motions continue"


def test_missing_controller_is_reported_as_long_as_it_is_missing() -> None:
    rig = Rig(create_arm("127.0.0.42"), 0 * SIX)
    try:
        problem = rig.until("Timeout connecting")
        assert "ur5e at 127.0.0.42" in problem and rig.arm.state.mode == "disconnected"
        assert "ur5e at" in rig.done(rig.arm.order("enable"))
    finally:
        rig.arm.close()


def test_cb3_controller_is_served_at_its_rate() -> None:
    with UrHost("127.0.0.43", "--cb3") as host:
        rig = Rig(create_arm(host.host, model="ur5"), 0 * SIX)
        try:
            rig.until("")
            assert not any("was connected" in problem for problem in rig.problems), "no fault"
            assert rig.swing(1.0) == ""
            assert 50 < host.command()["commands"] < 1000
        finally:
            rig.arm.close()


def test_simulated_world_is_an_option() -> None:
    assert not is_simulated(robot("ur", host="10.0.0.1", model="ur10e"))
    assert is_simulated(robot("ur", host="10.0.0.1", model="ur10e", world="simulated"))
    with pytest.raises(ConfigError, match=r"model"):
        is_simulated(robot("ur", host="10.0.0.1", model="ur6"))
    with pytest.raises(ConfigError, match=r"host"):
        is_simulated(robot("ur"))
