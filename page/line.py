"""The connection of each page beside viser's: STOP, buttons of our own, what is held down, and what is lost.

Nothing else waits in it, and the page tells by it that nobody is there any more: it speaks four times a second. Words
are JSON: of the page a `Said`; of ours `{"news": ...}`, or `{"n": ..., "said": line, "kind": ...}` of what was asked.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from websockets.exceptions import ConnectionClosed

from common.time_source import monotonic
from page.doors import VISITOR
from page.words import UNDERSTOOD, problem

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

    from common.messages import MotionOwner
    from page.console import Desk
    from page.losses import Loss

PERIOD = 0.25  # [s] wall between two words
SILENT = 2.0  # [s] without news of the service itself, after which it counts as stuck
LATE = 0.15  # [s] later than the promptest one, a word that something is held counts as one of before, and
LAST_SEEN = 0.8  # [s] after the newest news that who says it had: all words of a press may be late alike
LONGEST = 1000  # characters that a page may say at once


class Said(BaseModel):
    """What a page says."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    do: Literal["stop", "press", "hold", "release", "page"]
    n: int = 0  # number of a stop, which comes back in its answer; or of a press, which is held
    what: str = Field("", max_length=100)  # a button, or the key of the page
    at: float = Field(0.0, allow_inf_nan=False)  # [ms] by the browser's clock
    seen: float = Field(0.0, allow_inf_nan=False)  # [s] `time` of the newest news that it had


@dataclass(frozen=True)
class NewsOfAll:
    """What every page is told; ages count from `at` [s, monotonic]."""

    how: tuple[tuple[str, str], ...] = ()  # words and how good each is
    lost: tuple[Loss, ...] = ()
    note: tuple[int, str, str] = (0, "", "")  # number, line, kind
    owner: MotionOwner | None = None
    live: Mapping[str, str] = field(default_factory=dict)  # numbers that stand in panels, by name
    past: str = ""  # what is looked at, where that is not now
    at: float = field(default_factory=monotonic)


class Delays:
    """How late words come, reckoned from the promptest of a press: no clock has to agree with another's, nor run on."""

    def __init__(self) -> None:
        self._press: int | None = None
        self._least = 0.0

    def late(self, press: int, said: float, now: float) -> float:
        """How much later [s] than the promptest of its press a word comes that was said at the browser's time [s]."""
        took = now - said
        self._least = min(self._least, took) if press == self._press else took
        self._press = press
        return took - self._least


class Line:
    """Answers all pages; `serve` runs on the loop of the page's server, everything else on that of the service."""

    def __init__(self, desk: Desk) -> None:
        """Have a desk carry out what pages say."""
        self._desk = desk
        self._news = NewsOfAll()
        self.stop: Callable[[], object] = lambda: None  # a coroutine function that says what it did in a line
        self.holder: Holder = Holder()

    def tell(
        self, how: Iterable[tuple[str, str]], lost: Iterable[Loss], note: tuple[int, str, str],
        owner: MotionOwner | None, live: Mapping[str, str], past: str = "",
    ) -> None:
        """Say from now on how the cell is, what is lost, the newest line, whose the motion is, and numbers.

        `past` says what is looked at, where that is not now.
        """
        self._news = NewsOfAll(tuple(how), tuple(lost), note, owner, live, past)

    async def serve(self, connection: ServerConnection) -> None:
        """Answer a page until it is closed."""
        speaking = asyncio.create_task(self._speak(connection))
        delays = Delays()
        try:
            async for data in connection:  # ends when it is closed
                if self._heard(connection, data, delays):  # it is known now who that is
                    speaking.cancel()
                    speaking = asyncio.create_task(self._speak(connection))
        finally:
            speaking.cancel()
            self._desk.put(lambda: self.holder.release(connection))
            await asyncio.wait({speaking})

    async def _speak(self, connection: ServerConnection) -> None:
        while True:
            now, news = monotonic(), self._news
            lost = [(loss.what, round(max(now - loss.since, 0.0), 1)) for loss in news.lost]
            unknown = {part for loss in news.lost for part in loss.unknown}
            if now - news.at > SILENT:
                lost, unknown = [("The page's own service does not answer", round(now - news.at, 1))], {"all"}
            number, line, kind = news.note
            try:
                await connection.send(json.dumps({"news": {
                    "time": now, "how": news.how, "kept": self._kept(news.owner), "live": dict(news.live), "lost": lost,
                    "past": news.past,
                    "unknown": sorted(unknown),
                    "note": {"number": number, "line": line, "kind": kind}}}))
            except ConnectionClosed:
                return
            await asyncio.sleep(PERIOD)

    def _kept(self, owner: MotionOwner | None) -> str:
        """Why who looks may not move the arm, whatever the arm does."""
        doors = self._desk.doors
        if owner is not None and owner.asked and owner.kind != "task" and owner.owner != doors.person:
            return f"the motion is {owner.description}: Take it over, or wait until it is given back"
        return doors.objection(VISITOR.get(), "operate")

    def _heard(self, connection: ServerConnection, data: str | bytes, delays: Delays) -> bool:
        """Do what a page says; whether it has told who it is."""
        try:
            said = Said.model_validate_json(data[:LONGEST])
        except ValidationError:
            return False  # not of our script
        loop = asyncio.get_running_loop()

        def answer(line: str, kind: str, n: int = 0) -> None:
            words = json.dumps({"n": n, "said": line, "kind": kind})
            asyncio.run_coroutine_threadsafe(_send(connection, words), loop)

        desk, doors = self._desk, self._desk.doors
        unknown = doors.guarded and not doors.is_in(VISITOR.get())  # which page it is: only STOP is for all
        if said.do == "page":
            visitor = doors.page_of(said.what)
            if visitor is not None:
                VISITOR.set(visitor)
            return visitor is not None
        if said.do == "stop":
            if doors.admit(VISITOR.get(), STOP):
                desk.put(lambda: self._stop(lambda line, kind: answer(line, kind, said.n)))
        elif said.do == "release":
            desk.put(lambda: self.holder.release(connection))
        elif unknown:
            answer("the page is still loading, or was closed: nothing was done", "busy")
        elif said.do == "press":
            desk.press(said.what)
        elif delays.late(said.n, said.at * 1e-3, now := monotonic()) <= LATE and now - said.seen <= LAST_SEEN:
            if why := doors.objection(VISITOR.get(), "operate"):
                answer(why, "bad")  # which has the script let go
            elif doors.admit(VISITOR.get(), HOLD, said.what):
                desk.put(desk.operated)
                desk.put(lambda: self.holder.hold(connection, said.what, said.n, lambda line: answer(line, "bad")))
        return False

    async def _stop(self, answer: Callable[[str, str], None]) -> None:
        try:
            line = await self.stop()  # type: ignore[misc]
        except UNDERSTOOD as error:
            answer(f"NOT stopped: {problem(error)}", "bad")
        else:
            answer(line, "good")


async def _send(connection: ServerConnection, words: str) -> None:
    with contextlib.suppress(ConnectionClosed):
        await connection.send(words)


STOP, HOLD = "line:stop", "line:hold"  # parts of the page that the doors know


class Holder:
    """Does something while a button is held down; this one does nothing."""

    def hold(self, who: object, what: str, press: int, refuse: Callable[[str], None]) -> None:
        """The button `what` is held down by a page, which says so again and again; each press has a number."""

    def release(self, who: object) -> None:
        """That page holds no button any more, or is gone."""

