"""Check the pickled cell from stdin quickly and write the pickled findings to stdout; see `warnings_in_subprocess`.

A module of its own: `python -m tools.check.cell` would load that one twice, and the parent could not unpickle findings.
"""

from __future__ import annotations

import os
import pickle
import sys

from common.plugins import extend_path
from common.process.lifeline import die_when_orphaned
from tools.check.cell import NICE, quick_warnings


def main() -> None:
    """Run the check."""
    die_when_orphaned()
    os.nice(NICE)
    with os.fdopen(os.dup(1), "wb") as answer:
        os.dup2(2, 1)  # so that prints of the user's modules do not mix with the answer
        extend_path(*pickle.load(sys.stdin.buffer))  # with the modules that the cell names
        answer.write(pickle.dumps(quick_warnings(pickle.load(sys.stdin.buffer))))


if __name__ == "__main__":
    main()
