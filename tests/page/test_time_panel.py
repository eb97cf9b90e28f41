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


class Panel:
    """A time panel with recordings that are read when the test allows it; one of them is damaged."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self.readable = {name: threading.Event() for name in ("a.mcap", "b.mcap", "damaged.mcap")}
        self.closed: list[str] = []
        self.timeline, self.now = Timeline(lambda _topic: None, RecentHistory()), 0.0
        self.panel = TimePanel(gui, ActionQueue(), self.timeline, names=lambda: list(self.readable),
                               open_recording=self.open)

    def open(self, name: str) -> Any:
        assert self.readable[name].wait(10)
        if name == "damaged.mcap":
            raise RecordingError("damaged.mcap: is damaged")
        history = RecentHistory()
        history.now, history.close = 10.0, lambda: self.closed.append(name)
        return history

    @property
    def source(self) -> str:
        """The value of the field after an update."""
        self.now += 10.0
        self.panel.show(self.now)
        return str(self.panel._source.value)

    async def select(self, name: str) -> asyncio.Task[None]:
        """Select a source as a browser does; return the loading."""
        self.panel._source.value = name
        loading = asyncio.create_task(self.panel._select(name))
        await asyncio.sleep(0)
        return loading


@pytest.fixture
async def panel(gui: viser.GuiApi) -> Panel:
    panel = Panel(gui)
    assert panel.source == LIVE_SOURCE
    return panel


async def test_recording_remains_selected_while_it_loads_and_if_another_is_unreadable(panel: Panel) -> None:
    loading = await panel.select("a.mcap")
    assert panel.source == "a.mcap" and panel.timeline.is_present
    for event in panel.readable.values():
        event.set()
    await loading
    assert panel.source == "a.mcap" and panel.timeline.recording is not None
    with pytest.raises(RecordingError):
        await (await panel.select("damaged.mcap"))
    assert panel.source == "a.mcap" and panel.timeline.recording is not None
    del panel.readable["a.mcap"]
    assert panel.source == "a.mcap", "even if its file was deleted"
    panel.timeline.return_to_present()
    assert panel.source == LIVE_SOURCE


async def test_of_two_loading_recordings_the_last_selected_one_is_displayed(panel: Panel) -> None:
    loading = {name: await panel.select(name) for name in ("a.mcap", "b.mcap")}
    for name in ("b.mcap", "a.mcap"):
        panel.readable[name].set()
        await loading[name]
    assert panel.source == "b.mcap" and panel.closed == ["a.mcap"]
