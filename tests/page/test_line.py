"""The connection beside each page, with words that no browser would say."""

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from page.console import ActionQueue
from page.control_socket import LAST_SEEN, ControlSocket, Holder
from page.permissions import CURRENT_SESSION, PageSession, Permissions


class Connection:
    """Of a page that says one thing after the other; `heard` is what it was told, other than news."""

    def __init__(self) -> None:
        self.says: asyncio.Queue[str] = asyncio.Queue()
        self.heard: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self.news: dict[str, Any] = {}

    async def __aiter__(self) -> AsyncIterator[str]:
        while True:
            yield await self.says.get()

    async def send(self, data: str) -> None:
        words = json.loads(data)
        self.news = words.get("news", self.news)
        if "said" in words:
            self.heard.put_nowait(words)

    async def say(self, **words: Any) -> None:
        self.says.put_nowait(json.dumps(words))


class Held(Holder):
    """Knows what is held."""

    def __init__(self) -> None:
        self.presses: asyncio.Queue[int] = asyncio.Queue()

    def hold(self, who: object, what: str, press: int, refuse: Callable[[str], None]) -> None:
        self.presses.put_nowait(press)


@pytest.fixture
async def line() -> AsyncIterator[tuple[ControlSocket, Held, Connection, Permissions]]:
    """A line that is served, to somebody whose page is open."""
    doors = Permissions()
    actions, connection = ActionQueue(doors), Connection()
    visitor = PageSession(1, "127.0.0.1", frozenset({"look", "operate"}))
    served = ControlSocket(actions)
    served.holder = held = Held()
    doors.guarded = True
    running = [asyncio.create_task(actions.run()), asyncio.create_task(served.serve(connection))]  # type: ignore[arg-type]
    await connection.say(do="page", what=doors.key_of(visitor))
    yield served, held, connection, doors
    for task in running:
        task.cancel()
    await asyncio.gather(*running, return_exceptions=True)
    CURRENT_SESSION.set(None)


async def test_words_of_a_press_that_are_all_late_move_nothing(
    line: tuple[ControlSocket, Held, Connection, Permissions],
) -> None:
    _, held, connection, _ = line
    now = time.monotonic()
    for press, seen in ((1, now - LAST_SEEN - 1), (2, 0.0), (3, now)):
        for word in range(3):
            await connection.say(do="hold", what="joint:1:+", n=press, at=word * 40.0, seen=seen)
    async with asyncio.timeout(10):
        assert await held.presses.get() == 3, "those that had the news of now"


async def test_page_that_was_closed_does_nothing_over_the_line_that_it_left_open(
    line: tuple[ControlSocket, Held, Connection, Permissions]
) -> None:
    _, held, connection, doors = line
    async with asyncio.timeout(10):
        await connection.say(do="hold", what="joint:1:+", n=1, at=0.0, seen=time.monotonic())
        await held.presses.get()
        doors.leave(PageSession(1, "127.0.0.1", frozenset({"look", "operate"})))
        await connection.say(do="hold", what="joint:1:+", n=2, at=0.0, seen=time.monotonic())
        assert "nothing was done" in (await connection.heard.get())["said"]
    assert held.presses.empty()
