"""The control socket with messages that no browser would send, and the detection of lost connections."""

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from page.console import ActionQueue
from page.control_socket import (
    GRACE,
    MAX_DELAY,
    MAX_STATUS_AGE,
    ControlSocket,
    HoldHandler,
    Loss,
    LossDetector,
    PressDelay,
)
from page.permissions import CURRENT_SESSION, PageSession, Permissions

SESSION = PageSession(1, "127.0.0.1", frozenset({"look", "operate"}))
AVAILABLE = {"arm": ("no arm", True), "task": ("no task", True)}
UNAVAILABLE = {"arm": ("no arm", False), "task": ("no task", False)}


class Connection:
    """A fake WebSocket: `incoming` are the messages of the page, `results` the replies to it."""

    def __init__(self) -> None:
        self.incoming: asyncio.Queue[str] = asyncio.Queue()
        self.results: asyncio.Queue[dict[str, Any]] = asyncio.Queue()

    async def __aiter__(self) -> AsyncIterator[str]:
        while True:
            yield await self.incoming.get()

    async def send(self, data: str) -> None:
        message = json.loads(data)
        if "result" in message:
            self.results.put_nowait(message)

    def receive(self, **message: Any) -> None:
        self.incoming.put_nowait(json.dumps(message))

    def hold(self, press: int, seen: float, at: float = 0.0) -> None:
        self.receive(do="hold", what="joint:1:+", n=press, at=at, seen=seen)


class Presses(HoldHandler):
    def __init__(self) -> None:
        self.numbers: asyncio.Queue[int] = asyncio.Queue()

    def hold(self, client: object, button: str, press: int, reject: Callable[[str], None]) -> None:
        self.numbers.put_nowait(press)


Served = tuple[Presses, Connection, Permissions]


@pytest.fixture
async def served() -> AsyncIterator[Served]:
    """A socket of an open page."""
    permissions = Permissions()
    actions, connection = ActionQueue(permissions), Connection()
    control = ControlSocket(actions)
    control.hold_handler = presses = Presses()
    permissions.enforced = True
    running = [asyncio.create_task(actions.run()),
               asyncio.create_task(control.serve(connection))]  # type: ignore[arg-type]
    connection.receive(do="page", what=permissions.issue_key(SESSION))
    yield presses, connection, permissions
    for task in running:
        task.cancel()
    await asyncio.gather(*running, return_exceptions=True)
    CURRENT_SESSION.set(None)


async def test_press_whose_messages_are_all_late_has_no_effect(served: Served) -> None:
    presses, connection, _ = served
    now = time.monotonic()
    for press, seen in ((1, now - MAX_STATUS_AGE - 1), (2, 0.0), (3, now)):
        for number in range(3):
            connection.hold(press, seen, at=number * 40.0)
    async with asyncio.timeout(10):
        assert await presses.numbers.get() == 3, "only this press had a recent status"


async def test_closed_page_cannot_act_over_its_open_control_socket(served: Served) -> None:
    presses, connection, permissions = served
    async with asyncio.timeout(10):
        connection.hold(1, time.monotonic())
        await presses.numbers.get()
        permissions.remove(SESSION)
        connection.hold(2, time.monotonic())
        assert "nothing was done" in (await connection.results.get())["result"]
    assert presses.numbers.empty()


def test_delayed_message_is_detected_whatever_the_clocks_show() -> None:
    delay = PressDelay()
    assert [delay.update(1, 1000.0 + at, 5.0 + at) for at in (0.0, 0.25)] == [0.0, 0.0]
    assert delay.update(1, 1000.5, 5.5 + 0.4) > MAX_DELAY
    assert delay.update(1, 1001.0, 6.0625) < MAX_DELAY
    assert delay.update(2, 1002.0, 9000.0) == 0.0, "the browser's machine was suspended meanwhile"


# --- lost connections ---


def detector_of(*services: str) -> LossDetector:
    losses = LossDetector()
    assert losses.update(True, services, AVAILABLE, 0.0) == []
    return losses


def test_peer_that_was_never_seen_is_not_lost() -> None:
    assert LossDetector().update(True, [], {"arm": ("no arm", False)}, 100.0) == []


def test_lost_service_is_reported_after_a_grace_time_until_it_returns() -> None:
    losses = detector_of("camera", "viewer")
    assert losses.update(True, ["viewer"], AVAILABLE, 5.0) == []
    assert losses.update(True, ["viewer"], AVAILABLE, 5.0 + GRACE) == [Loss("camera does not respond", 5.0)]
    assert losses.update(True, ["viewer", "camera"], AVAILABLE, 8.0) == []
    assert losses.update(True, ["viewer"], AVAILABLE, 9.0) == [], "the grace time starts again"


def test_part_of_the_page_without_a_responder_is_stale() -> None:
    losses, lost = detector_of("executor"), {"arm": ("no arm", False), "task": ("no task", True)}
    losses.update(True, [], lost, 1.0)
    assert losses.update(True, [], lost, 3.0) == [
        Loss("no arm", 1.0, frozenset({"arm"})), Loss("executor does not respond", 1.0)]


def test_lost_router_is_the_only_report_and_makes_everything_stale() -> None:
    losses = detector_of("camera")
    for now in (2.0, 9.0):
        (loss,) = losses.update(False, [], UNAVAILABLE, now)
        assert (loss.since, loss.stale) == (2.0, {"all"}) and "router" in loss.message
    assert losses.update(True, [], UNAVAILABLE, 10.0) == [], "services have a grace time to return"
    assert losses.update(True, ["camera"], AVAILABLE, 10.5) == []


def test_invented_service_names_are_bounded_in_memory_and_in_the_message() -> None:
    losses = LossDetector()
    for number in range(1000):
        losses.update(True, ["camera", f"invented {number:04}"], {}, float(number))
    losses.update(True, ["camera"], {}, 1000.0)
    (lost,) = losses.update(True, ["camera"], {}, 2000.0)
    assert lost.message.endswith(" and 92 more do not respond") and "invented 0900" in lost.message
    losses.update(True, [], {}, 2010.0)
    (lost,) = losses.update(True, [], {}, 2020.0)
    assert "camera" in lost.message, "the service that was seen last is reported"
