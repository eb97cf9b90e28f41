"""The panel with which a person looks back: a slider over the last minutes or a recording, events, and playing."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from functools import partial

import viser

from page.console import Console, assign
from page.markup import block, buttons, press, row, span, table
from page.past import SECONDS, Past
from page.timeline import Timeline

THIS = "this cell: the last minutes"
SPEEDS = {"x 1/4": 0.25, "x 1/2": 0.5, "x 1": 1.0, "x 2": 2.0, "x 5": 5.0, "x 20": 20.0}
LISTED = 12  # events, around the time that is looked at
STEP = 1.0  # [s]
_LISTS = 5.0  # [s] between two looks for recordings


class TimePanel:
    """Slider, buttons and events."""

    def __init__(
        self, gui: viser.GuiApi, console: Console, timeline: Timeline, *, names: Callable[[], Sequence[str]],
        open_one: Callable[[str], Past],
    ) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            console: takes what a person does.
            timeline: that is moved.
            names: of the recordings that can be opened.
            open_one: opens one by its name; takes seconds, on another thread.
        """
        self._console, self._timeline, self._names, self._open_one = console, timeline, names, open_one
        self._listed, self._shown_at = 0.0, 0.0
        self._name = self._wanted = THIS  # what is looked at, or was chosen and is still being read
        self._source = gui.add_dropdown("Look at", [THIS], hint="or a recording of this cell")
        console.on_change(self._source, self._choose, "look")
        self._slider = gui.add_slider("Back [s]", -SECONDS, 0.0, 0.1, 0.0, hint="how long ago")
        console.on_change(self._slider, self._slide, "look")
        speeds = gui.add_dropdown("Speed", list(SPEEDS), initial_value="x 1", hint="at which it is played")
        console.on_change(speeds, self._set_speed, "look")
        for name, act, told in (
            ("before", partial(self._jump, -1), "Event before"), ("back", partial(self._step, -STEP), "A second back"),
            ("play", self._play, "Play"), ("on", partial(self._step, STEP), "A second on"),
            ("next", partial(self._jump, 1), "Next event"), ("now", timeline.now, "Now"),
        ):
            console.on_press(f"time:{name}", act, told, "look")
        for number in range(LISTED):
            console.on_press(f"time:event{number}", partial(self._go, number), "An event", "look")
        self._buttons = gui.add_html("")
        self._where = gui.add_html("")
        self._events = gui.add_html("")
        self._offered: list[float] = []  # times of the events that are listed

    @property
    def told(self) -> str:
        """What is looked at, where that is not now."""
        at, past = self._timeline.at, self._timeline.past
        if at is None:
            return ""
        if self._timeline.recording is not None:
            return f"a recording at {at:.1f} of {past.end:.1f} s"
        return f"{past.end - at:.1f} s ago"

    def show(self, now: float) -> None:
        """Bring the panel up to date at a wall time [s], monotonic."""
        timeline, past = self._timeline, self._timeline.past
        if timeline.recording is None and self._wanted == self._name:
            self._name = self._wanted = THIS  # somebody went back to now
        if now - self._listed >= _LISTS:
            self._listed = now
            options = list(dict.fromkeys([THIS, *self._names(), self._name, self._wanted]))
            if options != list(self._source.options):
                self._source.options = options
        if self._source.value != self._wanted:
            assign(self._source, self._wanted)
        self._move_slider()
        _set(self._buttons, buttons(
            press("‹ event", "time:before", "" if timeline.event(-1) else "nothing happened before"),
            press("− 1 s", "time:back"),
            press("Stop" if timeline.playing else "Play", "time:play", "this is now" if timeline.is_now else ""),
            press("+ 1 s", "time:on", "this is now" if timeline.is_now else ""),
            press("event ›", "time:next", "" if timeline.event(1) else "nothing happened since"),
            press("Now", "time:now", "this is now" if timeline.is_now and timeline.recording is None else "")),
            "time orders")
        said = (f"Looking at {self.told}: scene, pictures, plots are of then. STOP, and what moves the arm, acts now; "
                "the latter brings the page back to now.") if not timeline.is_now else "Now"
        _set(self._where, span(said, "busy" if not timeline.is_now else "good"), "time", now=timeline.is_now)
        self._list(past)

    def _move_slider(self) -> None:
        """Have the slider stand where the time is that is looked at."""
        at, past, recorded = self._timeline.at, self._timeline.past, self._timeline.recording is not None
        low, high = (0.0, max(0.1, round(past.end, 1))) if recorded else (-SECONDS, 0.0)
        if (self._slider.min, self._slider.max) != (low, high):
            self._slider.min, self._slider.max = low, high
            self._slider.label = "At [s]" if recorded else "Back [s]"
        value = (at or 0.0) if recorded else (0.0 if at is None else at - past.end)
        value = round(min(max(value, low), high), 1)
        if value != self._slider.value:
            assign(self._slider, value)

    def _list(self, past: Past) -> None:
        events, at = past.events, self._timeline.at
        until = len(events) if at is None else next((i for i, e in enumerate(events) if e.at > at + 1e-6), len(events))
        last = min(len(events), max(until + LISTED // 2 if at is not None else until, LISTED))
        some = events[max(0, last - LISTED):last]
        self._offered = [event.at for event in some]
        rows = []
        for number, event in reversed(list(enumerate(some))):
            when = f"{event.at:.1f} s" if self._timeline.recording is not None else _clock(past.end - event.at)
            mark = "▸ " if at is not None and max(0, last - LISTED) + number == until - 1 else ""
            rows.append(row(press(f"{mark}{when}", f"time:event{number}"), span(event.words, event.kind)))
        _set(self._events, table((), rows, "small") if rows else span("Nothing has happened yet", "dim"), "events",
             events=len(events))

    # --- what a person does ----------------------------------------------------------------------------------------

    def _slide(self, value: float) -> None:
        past = self._timeline.past
        self._timeline.playing = False
        self._timeline.seek(value if self._timeline.recording is not None else past.end + value)

    def _set_speed(self, name: str) -> None:
        self._timeline.speed = SPEEDS[name]

    def _step(self, by: float) -> None:
        timeline = self._timeline
        timeline.playing = False
        timeline.seek((timeline.at if timeline.at is not None else timeline.past.end) + by)

    def _jump(self, step: int) -> None:
        if (event := self._timeline.event(step)) is not None:
            self._timeline.playing = False
            self._timeline.seek(event.at)

    def _go(self, number: int) -> None:
        if number < len(self._offered):
            self._timeline.playing = False
            self._timeline.seek(self._offered[number])

    def _play(self) -> None:
        timeline = self._timeline
        if not timeline.is_now:
            timeline.playing = not timeline.playing
            if timeline.playing and timeline.at is not None and timeline.at >= timeline.past.end:
                timeline.seek(timeline.past.start)

    async def _choose(self, name: str) -> None:
        self._wanted = name
        if name == THIS:
            self._name = THIS
            self._timeline.open(None)
            return
        self._console.tell(f"Reading {name} …", "busy")
        try:
            past = await asyncio.to_thread(self._open_one, name)
        except BaseException:
            if self._wanted == name:
                self._wanted = self._name
            raise
        if self._wanted != name:  # another was chosen meanwhile
            past.close()
            return
        self._name = name
        self._timeline.open(past)
        self._console.tell(f"{name} is shown; what moves the arm, and Now, bring the page back", "good")


def _clock(ago: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(time.time() - ago))


def _set(html: viser.GuiHtmlHandle, inner: str, name: str, **data: object) -> None:
    if (content := block(inner, name, **data)) != html.content:
        html.content = content
