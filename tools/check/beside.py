"""The quick look at a cell in a process of its own: what is loaded for that, half a planner, is gone with it.

`python -m tools.check.beside` reads a cell from stdin and writes what it found to stdout, both as pickles.
"""

from __future__ import annotations

import asyncio
import os
import pickle
import sys
from collections.abc import Mapping

from common.config import Cell
from common.errors import ZencellError
from common.supervision.launch import module_command
from tools.check.finding import Finding

NICE = 10  # the cell goes first


class NotLooked(ZencellError):
    """The process ended without a word of what it found."""


async def doubts_beside(cell: Cell, environ: Mapping[str, str]) -> list[Finding]:
    """What will not work in a cell, as `tools.check.cell.doubts` tells it; the process dies with the call.

    Args:
        cell: as it was loaded.
        environ: of the process; its PYTHONPATH leads to what the cell names.

    Raises:
        NotLooked: it failed; what it said of that is on stderr.
    """
    process = await asyncio.create_subprocess_exec(
        *module_command(__name__), stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, env=environ,
        start_new_session=True,  # Ctrl-C is for us
    )
    try:
        told, _ = await process.communicate(pickle.dumps(cell))
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode:
        raise NotLooked(f"the quick look at the cell failed (exit code {process.returncode}); see `zencell check`")
    found: list[Finding] = pickle.loads(told)
    return found


def main() -> None:
    """Look at the cell from stdin."""
    from common.process.lifeline import die_when_orphaned

    die_when_orphaned()
    os.nice(NICE)
    with os.fdopen(os.dup(1), "wb") as answer:
        os.dup2(2, 1)  # what a module of a person's own prints is no part of the answer
        from tools.check.cell import doubts

        answer.write(pickle.dumps(doubts(pickle.load(sys.stdin.buffer))))


if __name__ == "__main__":
    main()
