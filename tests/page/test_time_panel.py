"""The field that says what is looked at says what is, however long reading takes and whatever comes of it."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest
import viser
from page.timeline import Timeline

from page.console import ActionQueue
from page.history import RecentHistory
from page.time_panel import THIS, TimePanel
from recording.sample import RecordingError


class Shelf:
    """Recordings that are read when a test says so; one of them is damaged."""

    def __init__(self) -> None:
        self.read = {name: threading.Event() for name in ("a.mcap", "b.mcap", "damaged.mcap")}
        self.closed: list[str] = []

    def open(self, name: str) -> Any:
        assert self.read[name].wait(10)
        if name == "damaged.mcap":
            raise RecordingError("damaged.mcap: is damaged")
        past = RecentHistory()
        past.now, past.close = 10.0, lambda: self.closed.append(name)  # type: ignore[method-assign]
        return past


class Panel:
    """A time panel, whom persons and the clock make do something."""

    def __init__(self, server: viser.ViserServer, shelf: Shelf) -> None:
        self.timeline, self.now = Timeline(lambda _topic: None, RecentHistory()), 0.0
        self.panel = TimePanel(server.gui, ActionQueue(), self.timeline,  # type: ignore[arg-type]
                               names=lambda: list(shelf.read), open_one=shelf.open)
        assert self.source == THIS

    @property
    def source(self) -> str:
        """What the field says after a while."""
        self.now += 10.0
        self.panel.show(self.now)
        return str(self.panel._source.value)

    async def choose(self, name: str) -> None:
        """As a browser does."""
        self.panel._source.value = name
        await self.panel._choose(name)


@pytest.fixture
async def shelf() -> Shelf:
    return Shelf()


async def test_what_is_being_read_stays_chosen_and_stands_there_until_somebody_goes_back_to_now(
    server: viser.ViserServer, shelf: Shelf
) -> None:
    panel = Panel(server, shelf)
    chosen = asyncio.create_task(panel.choose("a.mcap"))
    await asyncio.sleep(0)
    assert panel.source == "a.mcap" and panel.timeline.is_now
    shelf.read["a.mcap"].set()
    await chosen
    assert panel.source == "a.mcap" and panel.timeline.recording is not None
    panel.timeline.now()
    assert panel.source == THIS


async def test_recording_that_cannot_be_read_leaves_the_one_that_is_looked_at(
    server: viser.ViserServer, shelf: Shelf
) -> None:
    panel = Panel(server, shelf)
    for event in shelf.read.values():
        event.set()
    await panel.choose("a.mcap")
    with pytest.raises(RecordingError):
        await panel.choose("damaged.mcap")
    assert panel.source == "a.mcap" and panel.timeline.recording is not None
    del shelf.read["a.mcap"]
    assert panel.source == "a.mcap", "also when its file has gone"


async def test_of_two_that_are_read_at_a_time_the_one_that_was_chosen_last_is_shown(
    server: viser.ViserServer, shelf: Shelf
) -> None:
    panel = Panel(server, shelf)
    first = asyncio.create_task(panel.choose("a.mcap"))
    await asyncio.sleep(0)
    second = asyncio.create_task(panel.choose("b.mcap"))
    await asyncio.sleep(0)
    shelf.read["b.mcap"].set()
    await second
    shelf.read["a.mcap"].set()
    await first
    assert panel.source == "b.mcap" and shelf.closed == ["a.mcap"]
