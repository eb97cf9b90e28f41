"""Certificates that end."""

from __future__ import annotations

import datetime
from collections.abc import Iterator

from tools.doctor.finding import Finding, fail, ok, warn


def certificates(now: datetime.datetime | None = None) -> Iterator[Finding]:
    """Until when those of `ZENCELL_SECURE` are valid; nothing for an open cell."""
    from common.transport.credentials import expiries_in, expiry_warning, secure_folder

    folder = secure_folder()
    if folder is None:
        return
    at = now or datetime.datetime.now(datetime.UTC)
    ends = expiries_in(folder)
    if not ends:
        yield fail(f"{folder} has no certificates that can be read", "make them with `zencell secure init`")
    found = {name: expiry_warning(name, until, at) for name, until in ends.items()}
    for told in found.values():
        if told is not None:
            urgent, line = told
            yield (fail if urgent else warn)(line, f"zencell secure renew {folder}")
    if ends and not any(found.values()):
        yield ok(f"{len(ends)} certificates in {folder}, the first ends on {min(ends.values()):%Y-%m-%d}")
