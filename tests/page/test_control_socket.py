"""The control socket with messages that no browser would send, and the detection of lost connections."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from common.time_source import use_time_source
from page.access import CURRENT_SESSION, PageSession, Permissions
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
from tests.page.test_permissions import Clock

SESSION = PageSession(1, "127.0.0.1", frozenset({"look", "operate"}))
AVAILABLE = {"arm": ("no arm", True), "task": ("no task", True)}
UNAVAILABLE = {"arm": ("no arm", False), "task": ("no task", False)}


class Page(HoldHandler):
    """A page with its WebSocket: `incoming` are its messages, `results` the replies, `presses` the effective ones."""

    def __init__(self) -> None:
        self.permissions, self.clock = Permissions(), Clock()
        self.clock.now = 100.0
        self.incoming: asyncio.Queue[str] = asyncio.Queue()
        self.results: asyncio.Queue[str] = asyncio.Queue()
        self.presses: asyncio.Queue[int] = asyncio.Queue()

    async def __aiter__(self) -> AsyncIterator[str]:
        while True:
            yield await self.incoming.get()

    async def send(self, data: str) -> None:
        message = json.loads(data)
        if "result" in message:
            self.results.put_nowait(message["result"])

    def receive(self, **message: Any) -> None:
        self.incoming.put_nowait(json.dumps(message))

    def hold_down(self, press: int, seen: float, at: float = 0.0) -> None:
        self.receive(do="hold", what="joint:1:+", n=press, at=at, seen=seen)

    def hold(self, client: object, button: str, press: int, reject: Callable[[str], None]) -> None:
        self.presses.put_nowait(press)


@pytest.fixture
async def page() -> AsyncIterator[Page]:
    page = Page()
    actions = ActionQueue(page.permissions)
    control = ControlSocket(actions)
    control.hold_handler = page
    page.permissions.enforced = True
    running = [asyncio.create_task(actions.run()), asyncio.create_task(control.serve(page))]
    page.receive(do="page", what=page.permissions.issue_key(SESSION))
    with use_time_source(page.clock):  # a delay of this machine makes no status too old
        async with asyncio.timeout(10):
            yield page
    for task in running:
        task.cancel()
    await asyncio.gather(*running, return_exceptions=True)
    CURRENT_SESSION.set(None)


async def test_press_whose_messages_are_all_late_has_no_effect(page: Page) -> None:
    now = page.clock.now
    for press, seen in ((1, now - MAX_STATUS_AGE - 1), (2, 0.0), (3, now)):
        for number in range(3):
            page.hold_down(press, seen, at=number * 40.0)
    assert await page.presses.get() == 3, "only this press had a recent status"


async def test_closed_page_cannot_act_over_its_open_control_socket(page: Page) -> None:
    page.hold_down(1, page.clock.now)
    await page.presses.get()
    page.permissions.remove(SESSION)
    page.hold_down(2, page.clock.now)
    assert "nothing was done" in await page.results.get()
    assert page.presses.empty()


def test_delayed_message_is_detected_whatever_the_clocks_show() -> None:
    delay = PressDelay()
    assert [delay.update(1, 1000.0 + at, 5.0 + at) for at in (0.0, 0.25)] == [0.0, 0.0]
    assert delay.update(1, 1000.5, 5.5 + 0.4) > MAX_DELAY
    assert delay.update(1, 1001.0, 6.0625) < MAX_DELAY
    assert delay.update(2, 1002.0, 9000.0) == 0.0, "the browser's machine was suspended meanwhile"


def detector_of(*services: str) -> LossDetector:
    losses = LossDetector()
    assert losses.update(True, services, AVAILABLE, 0.0) == []
    return losses


def test_lost_service_is_reported_after_a_grace_time_until_it_returns() -> None:
    losses = detector_of("camera", "viewer")
    assert losses.update(True, ["viewer"], AVAILABLE, 5.0) == []
    assert losses.update(True, ["viewer"], AVAILABLE, 5.0 + GRACE) == [Loss("camera does not respond", 5.0)]
    assert losses.update(True, ["viewer", "camera"], AVAILABLE, 8.0) == []
    assert losses.update(True, ["viewer"], AVAILABLE, 9.0) == [], "the grace time starts again"


def test_part_of_the_page_whose_responder_was_lost_is_stale() -> None:
    lost = {"arm": ("no arm", False), "task": ("no task", True)}
    assert LossDetector().update(True, [], lost, 100.0) == [], "it was never seen"
    losses = detector_of("executor")
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
