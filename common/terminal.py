"""Text for a terminal, without control sequences from the network or from files.

All output of the command line, the logs and the live tables goes through here, once.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable

# Control characters, marks that change the direction of text or end a line, and lone surrogates (not encodable).
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]")

STATE_STYLES = {"ready": "green", "starting": "cyan", "waiting": "dim", "restarting": "yellow", "failed": "bold red"}


def printable(value: object, keep: str = "") -> str:
    r"""Return the value as text of one line, with control characters escaped as in JSON, such as \u001b.

    Args:
        value: any object.
        keep: characters that are not escaped, such as line feeds of a text with several lines.
    """
    return _CONTROL.sub(lambda found: found[0] if found[0] in keep else f"\\u{ord(found[0]):04x}", str(value))


def echo(text: str, *, err: bool = False, nl: bool = True) -> None:
    """Write lines to stdout, or to stderr."""
    import typer

    typer.echo(printable(text, keep="\n\t"), err=err, nl=nl)


class Progress:
    """Shows the part of a long task that is done, on stderr if that is a terminal; use it in a `with` block."""

    def __init__(self, what: str) -> None:
        """Show nothing for the first second."""
        self._what, self._next, self._shown = what, time.monotonic() + 1.0, False

    def __enter__(self) -> Callable[[float], None]:
        return self._show

    def __exit__(self, *_: object) -> None:
        if self._shown:
            rewrite("")

    def _show(self, part: float) -> None:
        if (now := time.monotonic()) >= self._next and sys.stderr.isatty():
            self._next, self._shown = now + 0.2, True
            rewrite(f"{self._what}: {100 * part:.0f} %")


def rewrite(text: str) -> None:
    """Replace the unfinished line on stderr; it stays unfinished."""
    sys.stderr.write(f"\r\x1b[K{printable(text)}")
    sys.stderr.flush()
