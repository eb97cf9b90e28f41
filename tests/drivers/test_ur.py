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


def made(host: str, **options: object) -> DrivenArm:
    given = Options(host=host, **{"model": "ur5e", "ahead": 0.2, **options})  # type: ignore[arg-type]
    return create(SimpleNamespace(gripper=None), LIMITS, 0 * SIX, given)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def host() -> Iterator[UrHost]:
    with UrHost("127.0.0.41") as host:
        yield host


@pytest.fixture(scope="module")
def rig(host: UrHost) -> Iterator[Rig]:
    rig = Rig(made(host.host), 0 * SIX)
    yield rig
    rig.arm.close()


def test_the_arm_is_read_where_it_stands_and_follows_from_there(host: UrHost, rig: Rig) -> None:
    rig.until("")
    assert np.allclose(rig.arm.read(0.0)[0], host.tell()["q"], atol=1e-3)
    assert np.allclose(rig.arm.read(0.0)[0], [0, -1.57, 0.5, -1.57, 0, 0], atol=1e-6), "nothing has moved it"
    assert rig.swing(SWING) == ""
    rig.until("")
    told = host.tell()
    assert told["commands"] > 100 and told["stops"] == 0 and told["fastest"] < 1.0


def test_set_points_that_cease_bring_the_arm_to_rest_by_itself(host: UrHost, rig: Rig) -> None:
    rig.until("")
    assert rig.swing(SWING / 4) == ""
    end = time.monotonic() + TIMEOUT
    while max(map(abs, host.tell()["qd"])) > 1e-3:  # nobody sends anything
        assert time.monotonic() < end
        time.sleep(PERIOD)
    assert "ceased to come" in rig.until("ceased to come")
    rig.until_it_moves()  # from where it is


def test_a_driver_that_is_held_up_for_a_moment_is_no_reason_for_the_arm_to_stop(host: UrHost, rig: Rig) -> None:
    rig.until_it_moves()
    rig.until("")
    stops, (driver,) = host.tell()["stops"], [child for child in multiprocessing.active_children() if child.is_alive()]
    assert rig.kept is not None
    q0, began, gaps = rig.kept, time.monotonic(), [0.4, 0.8, 1.2]
    while (t := time.monotonic() - began) < np.pi and not rig.cycle(
        q0 + 0.5 * (1 - np.cos(2 * t)) * SIX, np.sin(2 * t) * SIX
    ):
        if gaps and t > gaps[0]:
            gaps.pop(0)
            os.kill(driver.pid or 0, signal.SIGSTOP)
            time.sleep(0.04)
            rig.arm.read(0.0)
            assert rig.arm.delay > rig.arm.ahead + 0.03 + 0.03, "what is read is as old as that"
            os.kill(driver.pid or 0, signal.SIGCONT)
    assert host.tell()["stops"] == stops and rig.arm.late > 0.03, rig.told[-3:]
    rig.until_it_moves()


def test_a_driver_that_was_held_up_does_not_take_the_arm_for_silent(host: UrHost, rig: Rig) -> None:
    rig.until_it_moves()
    driver, told = multiprocessing.active_children(), len(rig.told)
    for _ in range(5):
        os.kill(driver[0].pid or 0, signal.SIGSTOP)
        time.sleep(0.2)  # longer than the arm may be silent, and shorter than the driver
        os.kill(driver[0].pid or 0, signal.SIGCONT)
        rig.until_it_moves()
    assert not [each for each in rig.told[told:] if "no message from the controller" in each]
    assert multiprocessing.active_children() == driver, "by the same process"


def test_set_points_are_for_when_they_were_made_however_late_they_are_sent(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.until("")
    sent: list[tuple[object, ...]] = []
    monkeypatch.setattr(rig.arm._process, "send", lambda message: sent.append(message) or True)
    q, now = rig.measured, time.monotonic()
    for n in range(5):
        time.sleep(0.01 + 0.004 * (n % 2))
        rig.arm.write(q, 0 * SIX, now + 0.01 * n)
    stamps = [message[2] for message in sent]
    assert np.allclose(np.diff(np.array(stamps, dtype=float)), 0.01, atol=1e-6)


def test_a_program_that_ended_is_told_at_once_and_begun_again(
    host: UrHost, rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.until_it_moves()
    driver = multiprocessing.active_children()
    heard, hear = list[str](), rig.arm._process.on_message
    monkeypatch.setattr(rig.arm._process, "on_message", lambda told: (heard.append(told.state.message), hear(told)))
    host.tell("end")
    assert rig.wave(2.0) != "", "it comes to rest"
    rig.until_it_moves()
    assert any("its program has ended" in message for message in heard)
    assert multiprocessing.active_children() == driver, "by the same process"


def test_an_arm_that_comes_to_rest_by_itself_says_so_before_it_rests(
    host: UrHost, rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.until_it_moves()
    rig.until("")
    assert rig.swing(SWING / 4) == ""
    heard, hear = list[Reading](), rig.arm._process.on_message
    monkeypatch.setattr(rig.arm._process, "on_message", lambda told: (heard.append(told), hear(told)))
    end = time.monotonic() + TIMEOUT
    while not heard or not heard[-1].ceased:  # nobody sends anything
        assert time.monotonic() < end
        time.sleep(0.001)
    assert max(map(abs, next(each for each in heard if each.ceased).state.dq)) > 0.05, "while it moves"
    while problem := rig.cycle(None, 0 * SIX):
        assert "ceased to come" in problem, "nor does it say anything else until it rests"
    assert max(map(abs, host.tell()["qd"])) < FASTEST / 2, "half of what was, for servoJ smooths: what it is sent rests"


def test_a_protective_stop_says_so_and_is_left_only_when_somebody_asks(host: UrHost, rig: Rig) -> None:
    rig.until("")
    host.tell("protect")
    assert rig.wave(2.0) != ""
    rig.until("protective stop")
    assert rig.arm.state.mode == "protective_stop"
    host.tell("normal")  # a person at the pendant: that alone moves nothing
    rig.until("was stopped for safety")
    where = host.tell()["q"]
    assert rig.done(rig.arm.order("recover")) == ""
    rig.until("")
    assert np.allclose(host.tell()["q"], where) and rig.swing(0.3) == "", rig.told[-6:]


def test_a_protective_stop_outlives_the_link_that_told_of_it(host: UrHost, rig: Rig) -> None:
    rig.until("")
    host.tell("protect")
    rig.until("protective stop")
    host.tell("pull 1")
    rig.until("no message")
    host.tell("normal")
    rig.until("was stopped for safety")
    assert rig.done(rig.arm.order("recover")) == ""
    rig.until_it_moves()


def test_a_stop_of_before_this_process_lets_nothing_move_either(host: UrHost, rig: Rig) -> None:
    rig.until("")
    rig.arm.stopped = True
    rig.until("was stopped for safety")
    assert rig.done(rig.arm.order("recover")) == "" and not rig.arm.stopped
    rig.until_it_moves()


def test_an_emergency_stop_is_not_recovered_from_by_a_request(host: UrHost, rig: Rig) -> None:
    rig.until("")
    host.tell("emergency")
    rig.until("emergency stop")
    assert "pressed" in rig.done(rig.arm.order("recover"))
    host.tell("normal")
    rig.until("was stopped for safety")
    assert rig.done(rig.arm.order("recover")) == ""
    rig.until("")


def test_a_pulled_cable_is_told_and_the_arm_found_where_it_stopped(host: UrHost, rig: Rig) -> None:
    rig.until("")
    host.tell("pull 1")
    problem = rig.wave(3.0)
    assert "no message" in problem or "does not take" in problem
    rig.until("")
    assert np.allclose(rig.arm.read(0.0)[0], host.tell()["q"], atol=1e-3)
    rig.until_it_moves()


def test_a_controller_that_was_started_again_waits_for_its_joints_to_be_powered(host: UrHost, rig: Rig) -> None:
    rig.until("")
    host.tell("reboot 1")
    assert rig.wave(3.0) != ""
    rig.until("without power")
    assert rig.arm.state.mode == "off"
    assert rig.done(rig.arm.order("enable")) == ""
    rig.until_it_moves()


def test_a_jump_is_not_played(host: UrHost, rig: Rig) -> None:
    rig.until("")
    end = time.monotonic() + TIMEOUT
    while rig.kept is None or np.abs(np.array((before := host.tell())["q"]) - rig.kept).max() > 1e-3 or max(
        map(abs, before["qd"])
    ) > 1e-3:
        rig.cycle(None, 0 * SIX)  # what was sent before is still played
        assert time.monotonic() < end
    rig.cycle(rig.kept + 0.5, 0 * SIX)
    assert "would jump" in rig.until("would jump")
    after = host.tell()
    assert after["stops"] == before["stops"] and np.allclose(after["q"], before["q"], atol=2e-3)


def test_freedrive_lets_go_of_the_arm_until_it_is_ended(host: UrHost, rig: Rig) -> None:
    rig.until("")
    assert rig.done(rig.arm.order("freedrive", 1.0)) == "" and host.tell()["freedrive"]
    assert "moved by hand" in rig.until("moved by hand")
    assert rig.done(rig.arm.order("freedrive", 0.0)) == "" and not host.tell()["freedrive"]
    rig.until("")


def test_what_the_tool_carries_and_the_slider_are_told(host: UrHost, rig: Rig) -> None:
    rig.until("")
    assert rig.done(rig.arm.order("payload", 1.25)) == "" and host.tell()["payload"][0] == 1.25
    host.tell("slider 0.3")
    end = time.monotonic() + TIMEOUT
    while rig.arm.state.speed != 0.3:
        rig.cycle(None, 0 * SIX)
        assert time.monotonic() < end
    host.tell("slider 1")
    assert "cannot dance" in rig.done(rig.arm.order("dance"))


def test_what_it_carries_is_told_between_motions_only(host: UrHost, rig: Rig) -> None:
    rig.until_it_moves()
    rig.until("")
    orders, tries = list[int](), 0

    def ask(t: float) -> None:
        nonlocal tries
        if t < SWING / 4:
            orders.clear()
        elif not orders:  # another weight in each try: one that was cut short may have been told it at rest
            tries += 1
            orders.append(rig.arm.order("payload", 0.6 + 0.01 * tries))

    assert rig.swing(SWING, ask) == ""
    before = host.tell()["payload"][0]
    assert "while the arm moves" in rig.done(orders[0]) and before != 0.6 + 0.01 * tries
    rig.until("")
    number = rig.arm.order("payload", 0.5, 0.0, 0.0, 0.1)
    end = time.monotonic() + TIMEOUT
    while (outcome := rig.arm.outcome(number)) is None:
        assert rig.cycle(None, 0 * SIX) == "" and time.monotonic() < end
    assert outcome == "" and host.tell()["payload"] == [0.5, 0.0, 0.0, 0.1]
    assert rig.swing(SWING / 4) == "", "and goes on"


def test_nobody_at_the_address_is_told_without_end() -> None:
    rig = Rig(made("127.0.0.42"), 0 * SIX)
    try:
        problem = rig.until("Timeout connecting")
        assert "ur5e at 127.0.0.42" in problem and rig.arm.state.mode == "disconnected"
        assert "ur5e at" in rig.done(rig.arm.order("enable"))
    finally:
        rig.arm.close()


def test_a_controller_of_the_older_series_is_served_at_its_rate() -> None:
    with UrHost("127.0.0.43", "--cb3") as host:
        rig = Rig(made(host.host, model="ur5"), 0 * SIX)
        try:
            rig.until("")
            assert not any("was connected" in told for told in rig.told), "that is no fault"
            assert rig.swing(1.0) == ""
            assert 50 < host.tell()["commands"] < 1000
        finally:
            rig.arm.close()


def test_the_simulated_world_goes_with_it_when_it_is_asked_for() -> None:
    assert not is_simulated(robot("ur", host="10.0.0.1", model="ur10e"))
    assert is_simulated(robot("ur", host="10.0.0.1", model="ur10e", world="simulated"))
    with pytest.raises(ConfigError, match=r"model"):
        is_simulated(robot("ur", host="10.0.0.1", model="ur6"))
    with pytest.raises(ConfigError, match=r"host"):
        is_simulated(robot("ur"))
