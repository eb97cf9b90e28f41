"""Keys of the terminal while a recording plays."""

from __future__ import annotations

import asyncio
import os
import sys
import termios
import tty
from collections.abc import Callable
from types import TracebackType
from typing import Any

NAMES = {b"\x1b[C": "right", b"\x1b[D": "left", b"\x1b[B": "down", b"\x1b[A": "up", b" ": "space"}


class Keys:
    """Calls back with the name of each key during the block; does nothing without a terminal.

    The end of the block restores the terminal. Ctrl-C stays a signal.
    """

    def __init__(self, on_key: Callable[[str], None], *, on_terminal: bool) -> None:
        """Prepare without changing the terminal; the block needs a running loop."""
        self._on_terminal = on_terminal
        self._on_key = on_key
        self._before: list[Any] | None = None

    def __enter__(self) -> Keys:
        if self._on_terminal:
            self._before = termios.tcgetattr(sys.stdin.fileno())
            tty.setcbreak(sys.stdin.fileno())
            asyncio.get_running_loop().add_reader(sys.stdin.fileno(), self._read)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._before is not None:
            asyncio.get_running_loop().remove_reader(sys.stdin.fileno())
            termios.tcsetattr(sys.stdin.fileno(), termios.TCSADRAIN, self._before)

    def _read(self) -> None:
        data = os.read(sys.stdin.fileno(), 64)
        if not data:  # the terminal was closed
            asyncio.get_running_loop().remove_reader(sys.stdin.fileno())
        for name in names_of(data):
            self._on_key(name)


def names_of(data: bytes) -> list[str]:
    """Return the keys of bytes from a terminal: right, left, up, down, space, or a letter."""
    names = []
    while data:
        known = next((code for code in NAMES if data.startswith(code)), None)
        if known is not None:
            names.append(NAMES[known])
        elif data[0] != 0x1B:
            names.append(chr(data[0]))
        else:  # another escape sequence, whose letters are no keys
            break
        data = data[len(known) if known else 1 :]
    return names
