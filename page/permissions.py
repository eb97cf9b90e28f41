"""Permissions of open pages: roles come from the access token, and one page at a time operates the robot.

Without access tokens every page may do everything. Every page may stop the robot.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Literal

from common.time_source import monotonic

Permission = Literal["stop", "look", "operate", "tune", "take"]  # take: become the operating page

PAGE = "page"  # name of the client where pages are not distinguished
OPERATE_TIMEOUT = 60.0  # [s] without an operation, after which the operating page loses control
LOG_INTERVAL = 2.0  # [s] between log lines for the same control, such as a slider that is dragged
MAX_LOGGED_VALUE = 60  # characters


@dataclass(frozen=True)
class PageSession:
    """One open page, for as long as its connection exists."""

    number: int  # 0: a control socket that has not identified its page yet
    address: str
    roles: frozenset[str]

    def __str__(self) -> str:
        """Return the name for labels and log lines."""
        return f"page {self.number} ({', '.join(sorted(self.roles - {'look'})) or 'look'}, {self.address})"


CURRENT_SESSION: ContextVar[PageSession | None] = ContextVar("session", default=None)  # that sent the current message


class Permissions:
    """Decides what each page may do. Thread-safe.

    Attributes:
        enforced: whether access tokens are required; otherwise everything is allowed.
        on_denied: called with the reason when something is denied.
    """

    def __init__(self, log: Callable[[str], None] = lambda line: None) -> None:
        """Allow everything until `enforced` is set; operations are logged by `log`."""
        self.enforced = False
        self.on_denied: Callable[[str], None] = lambda reason: None
        self._log = log
        self._required: dict[str, tuple[Permission, str]] = {}  # with the label, by element id
        self._operating: PageSession | None = None
        self._last_operation = 0.0  # [s, monotonic]
        self._last_logged: dict[tuple[PageSession | None, str], float] = {}
        self._sessions: dict[str, PageSession] = {}  # by secret key
        self._lock = threading.Lock()

    def require(self, element: str, permission: Permission, label: str) -> None:
        """Set the permission that an element of the page requires; by default it is "operate"."""
        self._required[element] = (permission, label)

    # --- sessions ---

    def issue_key(self, session: PageSession) -> str:
        """Return a secret key by which the control socket of the same page identifies itself."""
        key = secrets.token_urlsafe(16)
        with self._lock:
            self._sessions[key] = session
        return key

    def session_of(self, key: str) -> PageSession | None:
        """Return the session that has this key while its page is open."""
        with self._lock:
            return self._sessions.get(key)

    def is_open(self, session: PageSession | None) -> bool:
        """Return whether the page of a session is open and has a key."""
        with self._lock:
            return session in self._sessions.values()

    def remove(self, session: PageSession | None) -> None:
        """Forget a closed page; it no longer operates."""
        with self._lock:
            self._last_logged = {known: when for known, when in self._last_logged.items() if known[0] != session}
            self._sessions = {key: known for key, known in self._sessions.items() if known != session}
            if session is not None and session == self._operating:
                self._operating = None
                self._log(f"{session} was closed and no longer operates")

    # --- control ---

    @property
    def client_name(self) -> str:
        """Owner name for requests of the current session: pages of one host share it, as one operator uses them."""
        session = CURRENT_SESSION.get()
        return f"{PAGE} {session.address}" if self.enforced and session is not None else PAGE

    @property
    def operating_page(self) -> str:
        """The page that operates; empty if none does."""
        with self._lock:
            active = self._operating is not None and monotonic() - self._last_operation < OPERATE_TIMEOUT
            return str(self._operating) if active else ""

    def release(self, session: PageSession | None) -> bool:
        """End the control of a page; return whether it had control."""
        with self._lock:
            had_control = session is not None and session == self._operating
            if had_control:
                self._operating = None
                self._log(f"{session} no longer operates")
        return had_control

    def allow(self, session: PageSession | None, element: str, value: object = None) -> bool:
        """Return whether a session may use an element of the page; log the use, or report the reason."""
        if not self.enforced:
            return True
        permission, label = self._required.get(element, ("operate", "moves an object in the scene"))
        with self._lock:
            reason = self._deny_reason(session, permission)
            if not reason and permission != "look":
                self._log_use(session, label, value)
        if reason:
            self.on_denied(reason)
        return not reason

    def check(self, session: PageSession | None, permission: Permission) -> str:
        """Return why a session lacks a permission; empty if it has it, or would get it by using it."""
        if not self.enforced:
            return ""
        with self._lock:
            return self._deny_reason(session, permission, claim=False)

    def _deny_reason(self, session: PageSession | None, permission: Permission, *, claim: bool = True) -> str:
        if permission in ("stop", "look"):
            return ""
        role = "operate" if permission == "take" else permission
        if session is None or role not in session.roles:
            return f"{session or 'This page'} has no token for the role {role!r}"
        if permission == "tune":
            return ""
        now, before = monotonic(), self._operating
        free = before is None or before == session or now - self._last_operation >= OPERATE_TIMEOUT
        if not free and permission != "take":
            return f"{before} has control: press Take page control, or wait until it is released"
        if not claim:
            return ""
        if before != session:
            self._log(f"{session} operates" + (f" instead of {before}" if before is not None else ""))
        self._operating, self._last_operation = session, now
        return ""

    def _log_use(self, session: PageSession | None, label: str, value: object) -> None:
        now = monotonic()
        if now - self._last_logged.get((session, label), -LOG_INTERVAL) >= LOG_INTERVAL:
            shown = "" if value is None else f": {value!r}"[:MAX_LOGGED_VALUE]
            self._log(f"{session}: {label}{shown}")
        self._last_logged[session, label] = now
