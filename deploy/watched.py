"""Which files that change concern the service of this container: the filter of compose.dev.yaml for watchfiles.

The folder of all services is watched, not the one file: most editors put a new file in the place of the old one, and
who watches a file then goes on watching the one that is gone. It imports nothing of the project, which may be broken
just now.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence

SERVICES = "/app/services/"


def own_file(arguments: Sequence[str]) -> str:
    """The file of the service that watchfiles was told to start: `... "python -m services.viewer" ...`."""
    found = re.search(r"-m services\.(\w+)", " ".join(arguments))
    return f"{SERVICES}{found[1]}.py" if found else ""


OWN = own_file(sys.argv)


def concerns(_change: object, path: str, own: str = OWN) -> bool:
    """Whether the service is to be started again: its own file has changed, or one that all share."""
    return path.endswith(".py") and (not path.startswith(SERVICES) or path == own)
