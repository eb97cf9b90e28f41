"""The Time tab: a slider over the last minutes or a recording, playback, and a list of events."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from functools import partial

import viser

from page.console import Console, assign
from page.history import SECONDS, History, Timeline
from page.markup import Html, block, buttons, press, row, span, table

LIVE_SOURCE = "this cell: last 3 minutes"
SPEEDS = {"x 1/4": 0.25, "x 1/2": 0.5, "x 1": 1.0, "x 2": 2.0, "x 5": 5.0, "x 20": 20.0}
MAX_EVENTS = 12  # listed around the displayed time
STEP = 1.0  # [s]
_FILES_PERIOD = 5.0  # [s] between two searches for recordings


class TimePanel:
    """Source, slider, buttons and events."""

    def __init__(
        self, gui: viser.GuiApi, console: Console, timeline: Timeline, *, names: Callable[[], Sequence[str]],
        open_recording: Callable[[str], History],
    ) -> None:
        """Build the panel.

        Args:
            gui: of the server.
            console: runs the buttons.
            timeline: to control.
            names: returns the names of available recordings.
            open_recording: opens a recording; takes seconds, called on another thread.
        """
        self._console, self._timeline, self._names, self._open = console, timeline, names, open_recording
        self._last_search = 0.0
        self._name = self._selected = LIVE_SOURCE  # displayed source, and selected one that may still be loading
        self._source = gui.add_dropdown("Source", [LIVE_SOURCE], hint="the last minutes, or a recording of this cell")
        console.on_change(self._source, self._select, "look")
        self._slider = gui.add_slider("Time [s]", -SECONDS, 0.0, 0.1, 0.0, hint="relative to now, or in the recording")
        console.on_change(self._slider, self._slide, "look")
        speeds = gui.add_dropdown("Playback speed", list(SPEEDS), initial_value="x 1")
        console.on_change(speeds, self._set_speed, "look")
        for name, action, label in (
            ("before", partial(self._jump, -1), "Previous event"), ("back", partial(self._step, -STEP), "Back 1 s"),
            ("play", self._play, "Play"), ("on", partial(self._step, STEP), "Forward 1 s"),
            ("next", partial(self._jump, 1), "Next event"), ("now", timeline.return_to_present, "Live"),
        ):
            console.on_press(f"time:{name}", action, label, "look")
        for number in range(MAX_EVENTS):
            console.on_press(f"time:event{number}", partial(self._go_to, number), "Event", "look")
        self._buttons, self._where, self._events = Html(gui), Html(gui), Html(gui)
        self._listed: list[float] = []  # times of the listed events

    @property
    def position(self) -> str:
        """Text of the displayed time; empty for the present."""
        at, history = self._timeline.at, self._timeline.history
        if at is None:
            return ""
        if self._timeline.recording is not None:
            return f"a recording at {at:.1f} of {history.end:.1f} s"
        return f"the state {history.end - at:.1f} s ago"

    def show(self, now: float) -> None:
        """Update the panel at a wall time [s], monotonic."""
        timeline, history = self._timeline, self._timeline.history
        if timeline.recording is None and self._selected == self._name:
            self._name = self._selected = LIVE_SOURCE  # another page or a motion returned to the present
        if now - self._last_search >= _FILES_PERIOD:
            self._last_search = now
            options = list(dict.fromkeys([LIVE_SOURCE, *self._names(), self._name, self._selected]))
            if options != list(self._source.options):
                self._source.options = options
        if self._source.value != self._selected:
            assign(self._source, self._selected)
        self._move_slider()
        present = "the present is displayed" if timeline.is_present else ""
        self._buttons.set(block(buttons(
            press("‹ Event", "time:before", "" if timeline.adjacent_event(-1) else "no earlier event"),
            press("− 1 s", "time:back"),
            press("Pause" if timeline.playing else "Play", "time:play", present),
            press("+ 1 s", "time:on", present),
            press("Event ›", "time:next", "" if timeline.adjacent_event(1) else "no later event"),
            press("Live", "time:now", present if timeline.recording is None else "")), "time orders"))
        if timeline.is_present:
            where = span("Live", "good")
        else:
            where = span(f"Showing {self.position}: scene, images and plots. STOP and all motions act on the present; "
                         "a motion returns the page to Live.", "busy")
        self._where.set(block(where, "time", now=timeline.is_present))
        self._list_events(history)

    def _move_slider(self) -> None:
        """Move the slider to the displayed time."""
        at, history, recorded = self._timeline.at, self._timeline.history, self._timeline.recording is not None
        low, high = (0.0, max(0.1, round(history.end, 1))) if recorded else (-SECONDS, 0.0)
        if (self._slider.min, self._slider.max) != (low, high):
            self._slider.min, self._slider.max = low, high
        value = (at or 0.0) if recorded else (0.0 if at is None else at - history.end)
        value = round(min(max(value, low), high), 1)
        if value != self._slider.value:
            assign(self._slider, value)

    def _list_events(self, history: History) -> None:
        events, at = history.events, self._timeline.at
        past = len(events) if at is None else next((i for i, e in enumerate(events) if e.at > at + 1e-6), len(events))
        last = min(len(events), max(past + MAX_EVENTS // 2 if at is not None else past, MAX_EVENTS))
        first = max(0, last - MAX_EVENTS)
        listed = events[first:last]
        self._listed = [event.at for event in listed]
        rows = []
        for number, event in reversed(list(enumerate(listed))):
            when = f"{event.at:.1f} s" if self._timeline.recording is not None else _clock(history.end - event.at)
            mark = "▸ " if at is not None and first + number == past - 1 else ""
            rows.append(row(press(f"{mark}{when}", f"time:event{number}"), span(event.text, event.kind)))
        content = table((), rows, "small") if rows else span("No events yet", "dim")
        self._events.set(block(content, "events", events=len(events)))

    # --- operations ---

    def _seek(self, at: float) -> None:
        self._timeline.playing = False
        self._timeline.seek(at)

    def _slide(self, value: float) -> None:
        self._seek(value if self._timeline.recording is not None else self._timeline.history.end + value)

    def _set_speed(self, name: str) -> None:
        self._timeline.speed = SPEEDS[name]

    def _step(self, by: float) -> None:
        timeline = self._timeline
        self._seek((timeline.at if timeline.at is not None else timeline.history.end) + by)

    def _jump(self, direction: int) -> None:
        if (event := self._timeline.adjacent_event(direction)) is not None:
            self._seek(event.at)

    def _go_to(self, number: int) -> None:
        if number < len(self._listed):
            self._seek(self._listed[number])

    def _play(self) -> None:
        timeline = self._timeline
        if not timeline.is_present:
            timeline.playing = not timeline.playing
            if timeline.playing and timeline.at is not None and timeline.at >= timeline.history.end:
                timeline.seek(timeline.history.start)

    async def _select(self, name: str) -> None:
        self._selected = name
        if name == LIVE_SOURCE:
            self._name = LIVE_SOURCE
            self._timeline.open(None)
            return
        self._console.notify(f"Reading {name} …", "busy")
        try:
            recording = await asyncio.to_thread(self._open, name)
        except BaseException:
            if self._selected == name:
                self._selected = self._name
            raise
        if self._selected != name:  # another source was selected meanwhile
            recording.close()
            return
        self._name = name
        self._timeline.open(recording)
        self._console.notify(f"Showing {name}; Live, or any motion, returns to the present", "good")


def _clock(ago: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(time.time() - ago))
