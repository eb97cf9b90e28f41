"""The WebSocket of each page next to viser's: STOP, buttons, held buttons, and the status bar.

Images never delay it, as viser's connection may be delayed. Messages are JSON: the page sends a `PageMessage`; the
server sends `{"status": {...}}` four times a second, by which the page also notices a lost connection, and
`{"n": number, "result": text, "kind": kind}` in reply to a request.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from websockets.exceptions import ConnectionClosed

from common.time_source import monotonic
from page.access import CURRENT_SESSION
from page.browser_values import MAX_NUMBER, to_json
from page.situation import Situation, control_text
from page.status_text import USER_ERRORS, error_text

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

    from common.messages import MotionOwner
    from page.console import ActionQueue

STOP, HOLD = "control:stop", "control:hold"  # element ids for the permissions
STATUS_PERIOD = 0.25  # [s] wall
STATUS_TIMEOUT = 2.0  # [s] without a new status of the viewer service, after which it counts as stuck
MAX_DELAY = 0.15  # [s] by which a hold message may be later than the fastest one of its press
MAX_STATUS_AGE = 0.8  # [s] of the newest status that the page had received: a constant delay shows up here only
MAX_LENGTH = 1000  # characters of a message
GRACE = 1.0  # [s] for which a connection may be lost before it is reported
MAX_REMEMBERED = 100  # lost services: any client can invent service names
MAX_NAMED = 8  # services named in one line

ARM_LOST = "The robot controller does not respond: the arm's position is unknown, and STOP may not reach it"
TASK_LOST = "The task does not respond: its state is unknown"


class PageMessage(BaseModel):
    """A message of a page."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    do: Literal["stop", "press", "hold", "release", "page"]
    n: int = Field(0, ge=-(2**53), le=2**53)  # number of a STOP, returned in its reply; number of the press for "hold"
    what: str = Field("", max_length=100)  # name of the button; for "page" the secret key of the page
    at: float = Field(0.0, ge=-MAX_NUMBER, le=MAX_NUMBER)  # [ms] by the clock of the browser
    seen: float = Field(0.0, ge=-MAX_NUMBER, le=MAX_NUMBER)  # [s] `time` of the newest status it had received


@dataclass(frozen=True)
class Loss:
    """A lost connection.

    Attributes:
        message: for the operator.
        since: [s, monotonic].
        stale: parts of the page whose content is out of date: "all", "arm", "task".
    """

    message: str
    since: float
    stale: frozenset[str] = frozenset()


@dataclass(frozen=True)
class PageStatus:
    """The status that every page shows; times are monotonic [s].

    Attributes:
        situation: first line of the status bar.
        summary: texts of its second line, each with its kind (good, busy, bad, off, dim).
        lost: lost connections.
        note: number, text and kind of the newest message for the operator.
        note_time: when it was shown.
        owner: motion owner.
        live: numbers in panels, by name.
        past: position in time that is displayed; empty for the present.
        at: when this was published.
    """

    situation: Situation = field(default_factory=Situation)
    summary: tuple[tuple[str, str], ...] = ()
    lost: tuple[Loss, ...] = ()
    note: tuple[int, str, str] = (0, "", "")
    note_time: float = 0.0
    owner: MotionOwner | None = None
    live: Mapping[str, str] = field(default_factory=dict)
    past: str = ""
    at: float = field(default_factory=monotonic)


class PressDelay:
    """Delay of hold messages relative to the fastest one of the same press; needs no synchronized clocks."""

    def __init__(self) -> None:
        self._press: int | None = None
        self._offset = 0.0

    def update(self, press: int, sent: float, received: float) -> float:
        """Return the delay [s] of a message; `sent` is by the browser's clock, `received` by ours [s]."""
        offset = received - sent
        self._offset = min(self._offset, offset) if press == self._press else offset
        self._press = press
        return offset - self._offset


class HoldHandler:
    """Acts while a button is held down; this default does nothing."""

    def hold(self, client: object, button: str, press: int, reject: Callable[[str], None]) -> None:
        """Handle a repeated message that a page holds a button down; each press has a number of its own."""

    def release(self, client: object) -> None:
        """Handle that a page released its button or was closed."""


class ControlSocket:
    """Serves all pages. `serve` runs on the loop of the web server, everything else on the loop of the service.

    Attributes:
        stop: coroutine function that stops the robot and returns a line with what it did.
        hold_handler: receives held buttons.
    """

    def __init__(self, actions: ActionQueue) -> None:
        """Execute requests of the pages by these actions."""
        self._actions = actions
        self._status = PageStatus()
        self.stop: Callable[[], object] = lambda: None
        self.hold_handler = HoldHandler()

    def publish(self, status: PageStatus) -> None:
        """Send this status to every page from now on."""
        self._status = status

    async def serve(self, connection: ServerConnection) -> None:
        """Serve one page until it is closed."""
        sender = asyncio.create_task(self._send_status(connection))
        delay = PressDelay()
        try:
            async for data in connection:
                if self._handle(connection, data, delay):  # the session is known now: the status depends on it
                    sender.cancel()
                    sender = asyncio.create_task(self._send_status(connection))
        finally:
            sender.cancel()
            self._actions.put(lambda: self.hold_handler.release(connection))
            await asyncio.wait({sender})

    async def _send_status(self, connection: ServerConnection) -> None:
        while True:
            now, status = monotonic(), self._status
            lost = [(loss.message, round(max(now - loss.since, 0.0), 1)) for loss in status.lost]
            stale = {part for loss in status.lost for part in loss.stale}
            if now - status.at > STATUS_TIMEOUT:
                lost, stale = [("The viewer service does not respond", round(now - status.at, 1))], {"all"}
            number, text, kind = status.note
            first, control = status.situation, control_text(status.owner, self._actions.permissions.client_name)
            message = {
                "time": now, "summary": [*status.summary, (f"Control: {control}", "")],
                "situation": {"text": first.text, "kind": first.kind, "hint": first.hint, "since": first.since * 1e-6},
                "blocked": self._blocked(status.owner), "live": {**status.live, "control": control}, "lost": lost,
                "past": status.past, "stale": sorted(stale),
                "note": {"number": number, "text": text, "kind": kind, "age": max(now - status.note_time, 0.0)},
            }
            try:
                await connection.send(to_json({"status": message}))
            except ConnectionClosed:
                return
            await asyncio.sleep(STATUS_PERIOD)

    def _blocked(self, owner: MotionOwner | None) -> str:
        """Return why this page cannot move the arm, whatever state the arm is in; empty if it can."""
        permissions = self._actions.permissions
        if owner is not None and owner.asked and owner.kind != "task" and owner.owner != permissions.client_name:
            return f"{owner.owner or 'another operator'} controls the arm: press Take control, or wait for its release"
        return permissions.check(CURRENT_SESSION.get(), "operate")

    def _handle(self, connection: ServerConnection, data: str | bytes, delay: PressDelay) -> bool:
        """Handle a message of a page; return whether it identified the page."""
        try:
            message = PageMessage.model_validate_json(data[:MAX_LENGTH])
        except ValidationError:
            return False  # not sent by overlay.js
        loop = asyncio.get_running_loop()

        def reply(text: str, kind: str, n: int = 0) -> None:
            result = to_json({"n": n, "result": text, "kind": kind})
            asyncio.run_coroutine_threadsafe(_send(connection, result), loop)

        actions, permissions = self._actions, self._actions.permissions
        if message.do == "page":
            session = permissions.session_of(message.what)
            if session is not None:
                CURRENT_SESSION.set(session)
            return session is not None
        if message.do == "stop":
            if permissions.allow(CURRENT_SESSION.get(), STOP):
                actions.put(lambda: self._stop(lambda text, kind: reply(text, kind, message.n)))
        elif message.do == "release":
            actions.put(lambda: self.hold_handler.release(connection))
        elif permissions.enforced and not permissions.is_open(CURRENT_SESSION.get()):
            reply("the page is still loading, or was closed: nothing was done", "busy")
        elif message.do == "press":
            actions.press(message.what)
        elif (delay.update(message.n, message.at * 1e-3, now := monotonic()) <= MAX_DELAY
              and now - message.seen <= MAX_STATUS_AGE):
            self._hold(connection, message, lambda text: reply(text, "bad"))
        return False

    def _hold(self, connection: ServerConnection, message: PageMessage, reject: Callable[[str], None]) -> None:
        """Pass on that a button is held; overlay.js releases it when it is rejected."""
        actions, permissions = self._actions, self._actions.permissions
        if reason := permissions.check(CURRENT_SESSION.get(), "operate"):
            reject(reason)
        elif permissions.allow(CURRENT_SESSION.get(), HOLD, message.what):
            actions.put(actions.before_operation)
            actions.put(lambda: self.hold_handler.hold(connection, message.what, message.n, reject))

    async def _stop(self, reply: Callable[[str, str], None]) -> None:
        try:
            text = await self.stop()  # type: ignore[misc]
        except USER_ERRORS as error:
            reply(f"NOT stopped: {error_text(error)}", "bad")
        else:
            reply(text, "good")


async def _send(connection: ServerConnection, message: str) -> None:
    with contextlib.suppress(ConnectionClosed):
        await connection.send(message)


# --- the status bar ---


class LossDetector:
    """Reports peers that were reachable and no longer are. A peer never seen is still starting, not lost."""

    def __init__(self) -> None:
        self._seen: set[str] = set()
        self._lost: dict[str, float] = {}  # since when [s]

    def update(
        self, connected: bool, alive: Iterable[str], responders: Mapping[str, tuple[str, bool]], now: float
    ) -> list[Loss]:
        """Return what is lost at a wall time.

        Args:
            connected: whether the router is reachable.
            alive: services that are ready.
            responders: parts of the page, each with the message if it is lost, and whether its server is available.
            now: wall time [s], monotonic.
        """
        reachable = {"": connected}
        if connected:
            reachable |= dict.fromkeys(self._seen - {"", *(f"/{part}" for part in responders)}, False)
            reachable |= dict.fromkeys(alive, True)
            reachable |= {f"/{part}": available for part, (_, available) in responders.items()}
        for name, is_reachable in reachable.items():
            if is_reachable:
                self._seen.add(name)
                self._lost.pop(name, None)
            elif name in self._seen:
                self._lost.setdefault(name, now)
        for name in sorted(self._lost, key=self._lost.__getitem__)[: max(0, len(self._lost) - MAX_REMEMBERED)]:
            del self._lost[name]
            self._seen.remove(name)
        if not connected:
            since = self._lost.get("", now)
            return [Loss("No connection to the cell's router: everything shown is out of date, and no request is sent",
                         since, frozenset({"all"}))]
        lost = {name: since for name, since in self._lost.items() if now - since >= GRACE}
        found = [Loss(responders[part][0], lost[f"/{part}"], frozenset({part}))
                 for part in responders if f"/{part}" in lost]
        if names := sorted(name for name in lost if not name.startswith("/")):
            verb = "does" if len(names) == 1 else "do"
            more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
            found.append(Loss(f"{', '.join(names[:MAX_NAMED])}{more} {verb} not respond",
                              min(lost[name] for name in names)))
        return found
