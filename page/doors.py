"""What those who have the page open may do: by the token that they brought, and one at a time moves the arm.

Where no token is asked for there is one person, who may do everything. Anybody may stop.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Literal

from common.time_source import monotonic

Need = Literal["stop", "look", "operate", "tune", "take"]

BY = "page"  # who asks, where it is not known which person
IDLE = 60.0  # [s] without an order, after which who operates has given that back
QUIET = 2.0  # [s] in which the same order of the same person, such as a slider on its way, is logged once
LONGEST = 60  # characters of a value in the log


@dataclass(frozen=True)
class Visitor:
    """Somebody who has the page open, for as long as that connection lasts."""

    number: int  # 0: of a connection that did not tell yet of which page it is
    address: str
    roles: frozenset[str]

    def __str__(self) -> str:
        """As it is shown and logged."""
        return f"page {self.number} ({', '.join(sorted(self.roles - {'look'})) or 'look'}, {self.address})"


VISITOR: ContextVar[Visitor | None] = ContextVar("visitor", default=None)  # whose message is being handled


class Doors:
    """Who operates, and what each part of the page needs. From any thread."""

    def __init__(self, note: Callable[[str], None] = lambda line: None) -> None:
        """Let everybody do everything; `note` is called with a line for the log."""
        self.guarded = False  # whether tokens are asked for
        self.refused: Callable[[str], None] = lambda line: None  # shows why somebody may not
        self._note = note
        self._needs: dict[str, tuple[Need, str]] = {}  # by id of a part of the page: and what it is called
        self._holder: Visitor | None = None
        self._acted = 0.0  # when who operates did so last [s, monotonic]
        self._noted: dict[tuple[Visitor | None, str], float] = {}
        self._pages: dict[str, Visitor] = {}  # by the key that only this page knows
        self._lock = threading.Lock()

    def need(self, part: str, need: Need, what: str) -> None:
        """Say what a part of the page needs; one of which nothing is said moves the arm."""
        self._needs[part] = (need, what)

    def key_of(self, visitor: Visitor) -> str:
        """A key by which the other connection of the same page tells whose it is."""
        key = secrets.token_urlsafe(16)
        with self._lock:
            self._pages[key] = visitor
        return key

    def page_of(self, key: str) -> Visitor | None:
        """Who was given that key, as long as the page is open."""
        with self._lock:
            return self._pages.get(key)

    def is_in(self, visitor: Visitor | None) -> bool:
        """Whether the page of a visitor is open, as far as it has told which it is."""
        with self._lock:
            return visitor in self._pages.values()

    @property
    def person(self) -> str:
        """What to call who asks now: one host is one person, whose own stops and holds are no other's."""
        visitor = VISITOR.get()
        return f"{BY} {visitor.address}" if self.guarded and visitor is not None else BY

    @property
    def operator(self) -> str:
        """Who operates; empty if nobody does."""
        with self._lock:
            return str(self._holder) if self._holder is not None and monotonic() - self._acted < IDLE else ""

    def leave(self, visitor: Visitor | None) -> None:
        """Take note that somebody has closed the page: who operated does not any more."""
        with self._lock:
            self._noted = {known: when for known, when in self._noted.items() if known[0] != visitor}
            self._pages = {key: known for key, known in self._pages.items() if known != visitor}
            if visitor is not None and visitor == self._holder:
                self._holder = None
                self._note(f"{visitor} has gone and does not operate any more")

    def give_back(self, visitor: Visitor | None) -> bool:
        """Whether somebody operated, and does not any more."""
        with self._lock:
            had = visitor is not None and visitor == self._holder
            if had:
                self._holder = None
                self._note(f"{visitor} does not operate any more")
        return had

    def admit(self, visitor: Visitor | None, part: str, value: object = None) -> bool:
        """Whether somebody may do something with a part of the page; if not it is said why, if so it is logged."""
        if not self.guarded:
            return True
        need, what = self._needs.get(part, ("operate", "moves something in the scene"))
        with self._lock:
            why = self._why_not(visitor, need)
            if not why and need != "look":
                self._log(visitor, what, value)
        if why:
            self.refused(why)
        return not why

    def objection(self, visitor: Visitor | None, need: Need) -> str:
        """Why somebody may not do what needs that now; empty when they may, or would once they claim it."""
        if not self.guarded:
            return ""
        with self._lock:
            return self._why_not(visitor, need, claim=False)

    def _why_not(self, visitor: Visitor | None, need: Need, *, claim: bool = True) -> str:
        if need in ("stop", "look"):
            return ""
        role = "operate" if need == "take" else need
        if visitor is None or role not in visitor.roles:
            return f"{visitor or 'This page'} has no token to {role}"
        if need == "tune":
            return ""
        now, before = monotonic(), self._holder
        free = before is None or before == visitor or now - self._acted >= IDLE
        if not free and need != "take":
            return f"{before} operates: Take over, or wait until that is given back"
        if not claim:
            return ""
        if before != visitor:
            self._note(f"{visitor} operates" + (f" instead of {before}" if before is not None else ""))
        self._holder, self._acted = visitor, now
        return ""

    def _log(self, visitor: Visitor | None, what: str, value: object) -> None:
        now = monotonic()
        if now - self._noted.get((visitor, what), -QUIET) >= QUIET:
            shown = "" if value is None else f": {value!r}"[:LONGEST]
            self._note(f"{visitor}: {what}{shown}")
        self._noted[visitor, what] = now
