"""When certificates end, and who is told: 30 days before, a day before, and when they have."""

from __future__ import annotations

import datetime
import logging
import re
import ssl
import time
from pathlib import Path

from common.transport.credentials import AUTHORITY, secure_folder

SOON, LAST = datetime.timedelta(days=30), datetime.timedelta(days=1)
PERIOD = 3600.0  # [s] between two looks at the files
# Validity in a certificate: two times, in UTC, the first of which is when it begins. Read here and not by a library,
# which would stay in every process.
_TIMES = re.compile(rb"\x30.(?:\x17\x0d\d{12}Z|\x18\x0f\d{14}Z)(?:\x17\x0d(\d{12})Z|\x18\x0f(\d{14})Z)", re.DOTALL)


def end_of(path: Path) -> datetime.datetime | None:
    """Until when the first certificate of a file is valid; None when it cannot be read or holds none."""
    try:
        text = path.read_text(encoding="ascii")
        first = text[: text.index(_END) + len(_END)]
        found = _TIMES.search(ssl.PEM_cert_to_DER_cert(first[first.index("-----BEGIN"):]))
    except (OSError, ValueError):
        return None
    if found is None:
        return None
    digits = (found[2] or b"20" + found[1]).decode()
    return datetime.datetime.strptime(digits, "%Y%m%d%H%M%S").replace(tzinfo=datetime.UTC)


_END = "-----END CERTIFICATE-----"


def ends_in(folder: Path) -> dict[str, datetime.datetime]:
    """Until when each certificate of a folder is valid, by its common name; the authority's is `ca`."""
    found = ((path.stem, end_of(path)) for path in sorted(folder.glob("*.pem")))
    return {name: until for name, until in found if until is not None}


def warning_of(name: str, until: datetime.datetime, now: datetime.datetime) -> tuple[bool, str] | None:
    """Whether it is urgent that a certificate is renewed, and a line that says so; None while there is time."""
    left = until - now
    if left > SOON:
        return None
    whose = "the authority's certificate" if name == AUTHORITY else f"the certificate of {name}"
    if left <= datetime.timedelta(0):
        return True, f"{whose} has ended on {until:%Y-%m-%d %H:%M} UTC: nobody new connects with it"
    hours = left / datetime.timedelta(hours=1)
    return left <= LAST, f"{whose} ends on {until:%Y-%m-%d %H:%M} UTC, in " + (
        f"{hours / 24:.0f} days" if left > 2 * LAST else f"{hours:.0f} hours")


class EndWatch:
    """Says once for each certificate, and once more when it is urgent and when it has ended, that it ends."""

    def __init__(self, folder: Path | None = None, names: frozenset[str] | None = None) -> None:
        """Watch a folder, that of `ZENCELL_SECURE` if none is given.

        Args:
            folder: of certificates.
            names: those that are watched; all that are there when not given.
        """
        self._folder = folder or secure_folder()
        self._names = names
        self._next = 0.0
        self._said: dict[str, tuple[bool, bool]] = {}

    def tell(self, log: logging.Logger) -> None:
        """Log what is to be said now; looked at is once an hour."""
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + PERIOD
            for urgent, line in self.look():
                log.log(logging.ERROR if urgent else logging.WARNING, "%s", line)

    def ending(self, now: datetime.datetime | None = None) -> list[tuple[bool, str]]:
        """All that there is to say: whether it is urgent, and a line."""
        return [(urgent, line) for urgent, line, _, _ in self._ending(now or datetime.datetime.now(datetime.UTC))]

    def look(self, now: datetime.datetime | None = None) -> list[tuple[bool, str]]:
        """What is to be said now and was not said before: whether it is urgent, and a line."""
        found = self._ending(now or datetime.datetime.now(datetime.UTC))
        news = [(urgent, line) for urgent, line, name, ended in found if self._said.get(name) != (urgent, ended)]
        self._said = {name: (urgent, ended) for urgent, _, name, ended in found}
        return news

    def _ending(self, at: datetime.datetime) -> list[tuple[bool, str, str, bool]]:
        """Urgent, line, name, and whether it has ended, of each certificate that is watched and ends soon."""
        found = []
        for name, until in (ends_in(self._folder) if self._folder else {}).items():
            if (self._names is None or name in self._names) and (said := warning_of(name, until, at)):
                line = f"{said[1]}: `zencell secure renew {self._folder}` (docs/security.md)"
                found.append((said[0], line, name, until <= at))
        return found
