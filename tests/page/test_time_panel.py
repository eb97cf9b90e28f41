"""The source field of the Time tab while recordings are loading, or cannot be read."""

import asyncio
import threading
from typing import Any

import pytest
import viser

from page.console import ActionQueue
from page.history import RecentHistory, Timeline
from page.time_panel import LIVE_SOURCE, TimePanel
from recording.sample import RecordingError


class Recordings:
    """Recordings that are read when the test allows it; one of them is damaged."""

    def __init__(self) -> None:
        self.readable = {name: threading.Event() for name in ("a.mcap", "b.mcap", "damaged.mcap")}
        self.closed: list[str] = []

    def open(self, name: str) -> Any:
        assert self.readable[name].wait(10)
        if name == "damaged.mcap":
            raise RecordingError("damaged.mcap: is damaged")
        history = RecentHistory()
        history.now, history.close = 10.0, lambda: self.closed.append(name)
        return history


class Panel:
    """A time panel with its timeline."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self.recordings = Recordings()
        self.timeline, self.now = Timeline(lambda _topic: None, RecentHistory()), 0.0
        self.panel = TimePanel(gui, ActionQueue(), self.timeline,
                               names=lambda: list(self.recordings.readable), open_recording=self.recordings.open)
        assert self.source == LIVE_SOURCE

    @property
    def source(self) -> str:
        """The value of the field after an update."""
        self.now += 10.0
        self.panel.show(self.now)
        return str(self.panel._source.value)

    async def select(self, name: str) -> None:
        """Select a source as a browser does."""
        self.panel._source.value = name
        await self.panel._select(name)


@pytest.fixture
async def panel(gui: viser.GuiApi) -> Panel:
    return Panel(gui)


async def test_loading_recording_remains_selected_until_the_page_returns_to_the_present(panel: Panel) -> None:
    selection = asyncio.create_task(panel.select("a.mcap"))
    await asyncio.sleep(0)
    assert panel.source == "a.mcap" and panel.timeline.is_present
    panel.recordings.readable["a.mcap"].set()
    await selection
    assert panel.source == "a.mcap" and panel.timeline.recording is not None
    panel.timeline.return_to_present()
    assert panel.source == LIVE_SOURCE


async def test_unreadable_recording_leaves_the_displayed_one(panel: Panel) -> None:
    for event in panel.recordings.readable.values():
        event.set()
    await panel.select("a.mcap")
    with pytest.raises(RecordingError):
        await panel.select("damaged.mcap")
    assert panel.source == "a.mcap" and panel.timeline.recording is not None
    del panel.recordings.readable["a.mcap"]
    assert panel.source == "a.mcap", "even if its file was deleted"


async def test_of_two_loading_recordings_the_last_selected_one_is_displayed(panel: Panel) -> None:
    selections = {}
    for name in ("a.mcap", "b.mcap"):
        selections[name] = asyncio.create_task(panel.select(name))
        await asyncio.sleep(0)
    for name in ("b.mcap", "a.mcap"):
        panel.recordings.readable[name].set()
        await selections[name]
    assert panel.source == "b.mcap" and panel.recordings.closed == ["a.mcap"]
