"""One executor at a time keeps what persons decided, and the simulated world, under one name in one folder."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import socket
from collections.abc import AsyncIterator
from pathlib import Path

from common.atomic_file import STATE_VARIABLE
from common.errors import ConfigError
from common.time_source import monotonic

PATIENCE = 3.0  # [s] for a process that ends just now: it brakes first
LOOK_AGAIN = 0.02  # [s]
ROOM = 512  # [bytes] for the name of who has it


@contextlib.asynccontextmanager
async def sole_use(record: Path, name: str) -> AsyncIterator[None]:
    """Inside the block no other process has this record, nor what lies beside it; told of us is the `name`.

    Raises:
        ConfigError: another one has, and goes on; it is named. Or a lock cannot be had here.
    """
    folder = str(record.parent)
    try:
        record.parent.mkdir(parents=True, exist_ok=True)
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        descriptor = os.open(record.with_suffix(".lock"), flags, 0o600)
    except OSError as error:
        told = f"cannot be written ({error.strerror}): stops and holds would not outlive a restart"
        raise ConfigError(STATE_VARIABLE, folder, told) from None
    try:
        latest = monotonic() + PATIENCE
        while not _locked(descriptor, folder):
            if monotonic() > latest:
                owner = os.pread(descriptor, ROOM, 0).decode(errors="replace").strip() or "another process"
                told = f"is in use by {owner}: a stop of one would be undone by the other; choose another folder"
                raise ConfigError(STATE_VARIABLE, folder, told)
            await asyncio.sleep(LOOK_AGAIN)
        with contextlib.suppress(OSError):  # a full disk: then nobody is named
            told = f"{name}, process {os.getpid()} on {socket.gethostname()}"
            os.pwrite(descriptor, told.encode()[:ROOM - 1].ljust(ROOM - 1) + b"\n", 0)
        yield
    finally:
        os.close(descriptor)


def _locked(descriptor: int, folder: str) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        raise ConfigError(STATE_VARIABLE, folder, f"cannot be locked ({error.strerror})") from None
    return True
