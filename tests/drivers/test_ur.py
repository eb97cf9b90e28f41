"""The backend of Universal Robots with its vendor-neutral client library, against a double of a controller."""

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from common.errors import ConfigError
from common.hardware.backends import has_simulated_world, is_simulated, real_arm
from common.hardware.driven_arm import DrivenArm, Reading
from common.hardware.interface import Limits
from drivers.ur import Options, create
from drivers.ur_wrench import at_flange
from tests.common.hardware.test_backends import robot
from tests.doubles.ur_host import UrHost
from tests.drivers.driven_rig import FASTEST, SWING, TIMEOUT, Rig

pytestmark = [pytest.mark.slow, pytest.mark.alone, pytest.mark.timeout(120)]
if os.environ.get("CI") != "true":
    pytest.importorskip("rtde_control", reason="make setup EXTRAS=ur")

SIX = np.ones(6)
REST = 0 * SIX
LIMITS = Limits(tuple("abcdef"), -6 * SIX, 6 * SIX, 3 * SIX, 5 * SIX, 10 * SIX, 500 * SIX)


def create_arm(host: str, model: str = "ur5e") -> DrivenArm:
    options = Options(host=host, model=model, ahead=0.2)
    return create(SimpleNamespace(gripper=None), LIMITS, REST, options)


@pytest.fixture(scope="module")
def host() -> Iterator[UrHost]:
    with UrHost("127.0.0.41") as host:
        yield host


@pytest.fixture(scope="module")
def shared(host: UrHost) -> Iterator[Rig]:
    rig = Rig(create_arm(host.host), REST)
    yield rig
    rig.arm.close()


@pytest.fixture
def rig(shared: Rig) -> Rig:
    """A connected arm that accepts set-points."""
    shared.until("")
    return shared


def recover(rig: Rig) -> None:
    """Release the arm after a safety stop."""
    rig.until("was stopped for safety")
    assert rig.done(rig.arm.order("recover")) == ""
    rig.until_it_moves()


def test_arm_starts_at_its_position_and_follows_set_points(host: UrHost, rig: Rig) -> None:
    assert np.allclose(rig.arm.read(0.0)[0], host.command()["q"], atol=1e-3)
    assert np.allclose(rig.arm.read(0.0)[0], [0, -1.57, 0.5, -1.57, 0, 0], atol=1e-6), "it has not moved"
    assert rig.swing(SWING) == ""
    rig.until("")
    state = host.command()
    assert state["commands"] > 100 and state["stops"] == 0 and state["fastest"] < 1.0


def test_arm_without_set_points_brakes_and_reports_it_before_it_is_at_rest(
    host: UrHost, rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.until_it_moves()
    assert rig.swing(SWING / 4) == ""
    messages, receive = list[Reading](), rig.arm._process.on_message
    monkeypatch.setattr(rig.arm._process, "on_message", lambda message: (messages.append(message), receive(message)))
    rig.wait_for(lambda: messages and messages[-1].ceased)
    assert max(map(abs, next(each for each in messages if each.ceased).state.dq)) > 0.05, "while it moves"
    while problem := rig.cycle(None, REST):
        assert "ceased to come" in problem, "no other problem until it is at rest"
    assert max(map(abs, host.command()["qd"])) < FASTEST / 2, "servoJ smooths, but the set-points have stopped"
    rig.wait_for(lambda: max(map(abs, host.command()["qd"])) < 1e-3)
    rig.until_it_moves()


def test_short_delay_of_the_driver_does_not_stop_the_arm(host: UrHost, rig: Rig) -> None:
    rig.until_it_moves()
    rig.until("")
    stops = host.command()["stops"]
    (driver,) = [child for child in multiprocessing.active_children() if child.is_alive()]
    q0, start, pauses = rig.target, time.monotonic(), [0.4, 0.8, 1.2]
    while (t := time.monotonic() - start) < np.pi and not rig.cycle(
        q0 + 0.5 * (1 - np.cos(2 * t)) * SIX, np.sin(2 * t) * SIX
    ):
        if pauses and t > pauses[0]:
            pauses.pop(0)
            os.kill(driver.pid or 0, signal.SIGSTOP)
            time.sleep(0.04)
            rig.arm.read(0.0)
            assert rig.arm.delay > rig.arm.ahead + 0.03 + 0.03, "age of the readings"
            os.kill(driver.pid or 0, signal.SIGCONT)
    assert host.command()["stops"] == stops and rig.arm.late > 0.03, rig.problems[-3:]


def test_long_delay_of_the_driver_is_no_lost_connection(rig: Rig) -> None:
    rig.until_it_moves()
    driver, count = multiprocessing.active_children(), len(rig.problems)
    for _ in range(2):
        os.kill(driver[0].pid or 0, signal.SIGSTOP)
        time.sleep(0.2)  # longer than the timeout of the arm, shorter than that of the driver
        os.kill(driver[0].pid or 0, signal.SIGCONT)
        rig.until_it_moves()
    assert not [each for each in rig.problems[count:] if "no message from the controller" in each]
    assert multiprocessing.active_children() == driver, "the same process"


def test_set_points_have_the_time_of_their_computation(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[tuple[object, ...]] = []
    monkeypatch.setattr(rig.arm._process, "send", lambda message: sent.append(message) or True)
    monkeypatch.setattr(rig.arm._process, "on_message", lambda message: None)  # the driver misses the set-points
    assert rig.arm._newest is not None
    monkeypatch.setattr(rig.arm, "_newest", rig.arm._newest._replace(ceased="", epoch=rig.arm._epoch))
    now = time.monotonic()
    for n in range(5):
        time.sleep(0.01 + 0.004 * (n % 2))
        rig.arm.write(rig.measured, REST, now + 0.01 * n)
    assert np.allclose(np.diff(np.array([message[2] for message in sent], dtype=float)), 0.01, atol=1e-6)


def test_ended_program_is_reported_at_once_and_restarted(
    host: UrHost, rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.until_it_moves()
    driver = multiprocessing.active_children()
    messages, receive = list[str](), rig.arm._process.on_message
    monkeypatch.setattr(rig.arm._process, "on_message",
                        lambda message: (messages.append(message.state.message), receive(message)))
    host.command("end")
    assert rig.wave(2.0) != "", "it stops"
    rig.until_it_moves()
    assert any("its program has ended" in message for message in messages)
    assert multiprocessing.active_children() == driver, "the same process"


def test_protective_stop_persists_over_a_lost_link_and_ends_only_on_request(host: UrHost, rig: Rig) -> None:
    host.command("protect")
    assert rig.wave(2.0) != ""
    rig.until("protective stop")
    assert rig.arm.state.mode == "protective_stop"
    assert "robot recover" in rig.done(rig.arm.order("enable"))
    assert rig.arm.state.mode == "protective_stop" and rig.arm.stopped
    host.command("pull 1")
    rig.until("no message")
    host.command("normal")  # at the pendant: that alone moves nothing
    rig.until("was stopped for safety")
    where = host.command()["q"]
    assert rig.done(rig.arm.order("recover")) == ""
    rig.until("")
    assert np.allclose(host.command()["q"], where) and rig.swing(0.3) == "", rig.problems[-6:]


def test_stop_before_a_restart_of_this_process_blocks_motions(rig: Rig) -> None:
    rig.arm.stopped = True
    recover(rig)
    assert not rig.arm.stopped


def test_request_does_not_end_an_emergency_stop(host: UrHost, rig: Rig) -> None:
    host.command("emergency")
    rig.until("emergency stop")
    for act in ("recover", "enable"):
        assert "pressed" in rig.done(rig.arm.order(act))
    host.command("normal")
    rig.until("without power")
    assert "robot enable" in rig.done(rig.arm.order("recover")) and host.command()["mode"] == "POWER_OFF"
    assert rig.done(rig.arm.order("enable")) == ""
    recover(rig)


def test_unplugged_cable_is_reported_and_the_arm_read_where_it_stopped(host: UrHost, rig: Rig) -> None:
    host.command("pull 1")
    problem = rig.wave(3.0)
    assert "no message" in problem or "does not take" in problem
    rig.until("")
    assert np.allclose(rig.arm.read(0.0)[0], host.command()["q"], atol=1e-3)
    rig.until_it_moves()


def test_rebooted_controller_waits_for_power(host: UrHost, rig: Rig) -> None:
    host.command("reboot 1")
    assert rig.wave(3.0) != ""
    rig.until("without power")
    assert rig.arm.state.mode == "off"
    assert rig.done(rig.arm.order("enable")) == ""
    rig.until_it_moves()


def test_freedrive_releases_the_arm_until_it_is_ended(host: UrHost, rig: Rig) -> None:
    assert rig.done(rig.arm.order("freedrive", 1.0)) == "" and host.command()["freedrive"]
    assert "moved by hand" in rig.until("moved by hand")
    assert rig.done(rig.arm.order("freedrive", 0.0)) == "" and not host.command()["freedrive"]
    rig.until("")
    assert "cannot dance" in rig.done(rig.arm.order("dance"))


def test_speed_slider_is_reported(host: UrHost, rig: Rig) -> None:
    host.command("slider 0.3")
    rig.wait_for(lambda: (rig.cycle(None, REST), rig.arm.state.speed == 0.3)[1])
    host.command("slider 1")


def test_force_and_the_payload_that_the_controller_subtracts_arrive(host: UrHost, rig: Rig) -> None:
    assert np.allclose(rig.arm.wrench(), 0)
    host.command("push 0 0 12 0.5 0 0")  # in the axes of the base
    rig.wait_for(lambda: np.linalg.norm(rig.arm.wrench()[:3]) > 11.9)
    assert np.linalg.norm(rig.arm.wrench()[3:]) == pytest.approx(0.5)
    assert np.allclose(rig.arm.wrench(), at_flange(rig.arm.read(0.0)[0].tolist(), [0, 0, 12, 0.5, 0, 0]), atol=0.01)
    number = rig.arm.order("payload", 0.7, 0.0, 0.01, 0.05)
    assert rig.done(number) == ""
    rig.wait_for(lambda: np.allclose(rig.arm.known_payload, [0.7, 0.0, 0.01, 0.05]))


def test_payload_is_set_only_between_motions(host: UrHost, rig: Rig) -> None:
    rig.until_it_moves()
    orders, attempts = list[int](), 0

    def request(t: float) -> None:
        nonlocal attempts
        if t < SWING / 4:
            orders.clear()
        elif not orders:  # another mass in each attempt: an interrupted one may have set it at rest
            attempts += 1
            orders.append(rig.arm.order("payload", 0.6 + 0.01 * attempts))

    assert rig.swing(SWING, request) == ""
    before = host.command()["payload"][0]
    assert "while the arm moves" in rig.done(orders[0]) and before != 0.6 + 0.01 * attempts
    rig.until("")
    number = rig.arm.order("payload", 0.5, 0.0, 0.0, 0.1)
    end = time.monotonic() + TIMEOUT
    while (outcome := rig.arm.outcome(number)) is None:
        assert rig.cycle(None, REST) == "" and time.monotonic() < end
    assert outcome == "" and host.command()["payload"] == [0.5, 0.0, 0.0, 0.1]
    assert rig.swing(SWING / 4) == "", "motions continue"


def test_missing_controller_is_reported_as_long_as_it_is_missing() -> None:
    rig = Rig(create_arm("127.0.0.42"), REST)
    try:
        assert "ur5e at 127.0.0.42" in rig.until("Timeout connecting") and rig.arm.state.mode == "disconnected"
        assert "ur5e at" in rig.done(rig.arm.order("enable"))
    finally:
        rig.arm.close()


def test_cb3_controller_is_served_at_its_rate() -> None:
    with UrHost("127.0.0.43", "--cb3") as host:
        rig = Rig(create_arm(host.host, model="ur5"), REST)
        try:
            rig.until("")
            assert not any("was connected" in problem for problem in rig.problems), "no fault"
            start, before = time.monotonic(), host.command()["packets"]
            assert rig.swing(1.0) == ""
            assert 50 < host.command()["packets"] - before < 150 * (time.monotonic() - start), "125 Hz"
        finally:
            rig.arm.close()


def test_simulated_world_is_an_option() -> None:
    assert not is_simulated(robot("ur", host="10.0.0.1", model="ur10e"))
    on_a_double = robot("ur", host="10.0.0.1", model="ur10e", world="simulated")
    assert has_simulated_world(on_a_double) and not is_simulated(on_a_double) and real_arm(on_a_double) == "ur-10.0.0.1"
    with pytest.raises(ConfigError, match=r"model"):
        has_simulated_world(robot("ur", host="10.0.0.1", model="ur6"))
    with pytest.raises(ConfigError, match=r"host"):
        has_simulated_world(robot("ur"))
