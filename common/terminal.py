"""Text for a terminal: what came over the wire or out of a file cannot steer it.

Everything that the command line, the logs and the live tables show goes through here, once.
"""

from __future__ import annotations

import re
import sys

# Control characters, marks that turn the direction of text or end a line, and halves of characters, which no
# terminal can be sent.
_STEERING = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]")

STATE_STYLES = {"ready": "green", "starting": "cyan", "waiting": "dim", "restarting": "yellow", "failed": "bold red"}


def printable(value: object, keep: str = "") -> str:
    r"""The value as text of one line; what could steer a terminal is written as JSON does, such as \u001b.

    Args:
        value: anything.
        keep: characters that stay as they are, such as the ends of lines of a text that has some.
    """
    return _STEERING.sub(lambda found: found[0] if found[0] in keep else f"\\u{ord(found[0]):04x}", str(value))


def echo(text: str, *, err: bool = False, nl: bool = True) -> None:
    """Write lines for a person or a program to stdout, or to stderr."""
    import typer

    typer.echo(printable(text, keep="\n\t"), err=err, nl=nl)


def rewrite(text: str) -> None:
    """Have the line on stderr that is being written be another one; it stays open."""
    sys.stderr.write(f"\r\x1b[K{printable(text)}")
    sys.stderr.flush()
