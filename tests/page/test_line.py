"""The connection beside each page, with words that no browser would say."""

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from page.console import Desk
from page.doors import VISITOR, Doors, Visitor
from page.line import LAST_SEEN, Holder, Line


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
async def line() -> AsyncIterator[tuple[Line, Held, Connection, Doors]]:
    """A line that is served, to somebody whose page is open."""
    doors = Doors()
    desk, connection, visitor = Desk(doors), Connection(), Visitor(1, "127.0.0.1", frozenset({"look", "operate"}))
    served = Line(desk)
    served.holder = held = Held()
    doors.guarded = True
    running = [asyncio.create_task(desk.run()), asyncio.create_task(served.serve(connection))]  # type: ignore[arg-type]
    await connection.say(do="page", what=doors.key_of(visitor))
    yield served, held, connection, doors
    for task in running:
        task.cancel()
    await asyncio.gather(*running, return_exceptions=True)
    VISITOR.set(None)


async def test_words_of_a_press_that_are_all_late_move_nothing(line: tuple[Line, Held, Connection, Doors]) -> None:
    _, held, connection, _ = line
    now = time.monotonic()
    for press, seen in ((1, now - LAST_SEEN - 1), (2, 0.0), (3, now)):
        for word in range(3):
            await connection.say(do="hold", what="joint:1:+", n=press, at=word * 40.0, seen=seen)
    async with asyncio.timeout(10):
        assert await held.presses.get() == 3, "those that had the news of now"


async def test_page_that_was_closed_does_nothing_over_the_line_that_it_left_open(
    line: tuple[Line, Held, Connection, Doors]
) -> None:
    _, held, connection, doors = line
    async with asyncio.timeout(10):
        await connection.say(do="hold", what="joint:1:+", n=1, at=0.0, seen=time.monotonic())
        await held.presses.get()
        doors.leave(Visitor(1, "127.0.0.1", frozenset({"look", "operate"})))
        await connection.say(do="hold", what="joint:1:+", n=2, at=0.0, seen=time.monotonic())
        assert "nothing was done" in (await connection.heard.get())["said"]
    assert held.presses.empty()
