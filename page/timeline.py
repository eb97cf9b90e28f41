"""Where in time the page looks: at now, or back at what was kept of the last minutes, or at a recording."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from common.errors import ZencellError
from common.messages import Message
from common.topics import Topic
from page.feeds import Latest
from page.past import Event, Past

M = TypeVar("M", bound=Message)

_LIVE_WITHIN = 0.3  # [s] of the end of the last minutes: that is now
_SAME = 0.05  # [s] of an event: it is looked at


class Timeline:
    """What is shown is asked of it, as of `Feeds`: who looks at now is told what the feeds tell.

    Attributes:
        at: the time [s] that is looked at, by the clock of what is looked at; None: now.
        playing: whether that goes on.
        speed: by how much per second.
        recording: what is looked at, in place of the last minutes.
        moved: called when another time is looked at that does not follow from playing on.
        told: called with why there is something that cannot be shown.
    """

    def __init__(self, live: Latest, memory: Past) -> None:
        """Look at now."""
        self._live, self._memory = live, memory
        self.at: float | None = None
        self.playing = False
        self.speed = 1.0
        self.recording: Past | None = None
        self.moved: Callable[[], None] = lambda: None
        self.told: Callable[[str], None] = lambda _why: None
        self._pictured: dict[str, float] = {}  # the times of which pictures were given last
        self._stepped: float | None = None

    @property
    def past(self) -> Past:
        """What is looked back at."""
        return self.recording if self.recording is not None else self._memory

    @property
    def is_now(self) -> bool:
        """Whether now is looked at."""
        return self.at is None

    def latest(self, topic: Topic[M], /) -> M | None:
        """The newest message of a topic at the time that is looked at, or None."""
        return self._live(topic) if self.at is None else self.past.latest(topic, self.at)

    def picture(self, topic: Topic[Any]) -> Any:
        """The newest picture at the time that is looked back at, as a message; None for none, or the one of before.

        While nobody looks at another time it is not read and sent anew: those take the time of whoever presses STOP.
        """
        if self.at is None or self._pictured.get(topic.key) == self.at:
            return None
        self._pictured[topic.key] = self.at
        try:
            return self.past.picture(topic, self.at)
        except ZencellError as error:  # a recording that is damaged there
            self.told(str(error))
            return None

    def picture_anew(self) -> None:
        """Give pictures once more: there are others to see them."""
        self._pictured.clear()

    def open(self, recording: Past | None) -> None:
        """Look at a recording from its beginning, stopped; None: at the last minutes again, at now."""
        if self.recording is not None:
            self.recording.close()
        self.recording, self.playing = recording, False
        self.picture_anew()
        self.at = recording.start if recording is not None else None
        self.moved()

    def now(self) -> None:
        """Look at now."""
        if self.at is not None or self.recording is not None:
            self.open(None)

    def seek(self, at: float) -> None:
        """Look at a time [s]; at the end of the last minutes it is now."""
        past = self.past
        if self.recording is None and at > past.end - _LIVE_WITHIN:
            self.now()
            return
        self.at = min(max(at, past.start), past.end)
        self.moved()

    def step(self, now: float) -> None:
        """Go on at a wall time [s], monotonic, if it plays; what is kept no more is not looked at any longer."""
        elapsed = now - self._stepped if self._stepped is not None else 0.0
        self._stepped = now
        if self.at is None:
            return
        past = self.past
        if self.playing:
            self.at += self.speed * elapsed
            if self.recording is None and self.at > past.end - _LIVE_WITHIN and self.speed >= 1:
                self.now()
                return
            if self.at >= past.end:
                self.at, self.playing = past.end, False
        self.at = max(self.at, past.start)

    def event(self, step: int) -> Event | None:
        """The next event in a direction, +1 or -1; None where there is none."""
        at = self.at if self.at is not None else self.past.end + _SAME
        if step > 0:
            return next((event for event in self.past.events if event.at > at + _SAME), None)
        return next((event for event in reversed(self.past.events) if event.at < at - _SAME), None)
