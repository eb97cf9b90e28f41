"""Filter of compose.dev.yaml for watchfiles: select the changes that concern the service of this container.

watchfiles watches the folder of all services, not one file: most editors replace the file, and a watch on the old file
would miss the new one. This module imports nothing of the project, which may be broken during an edit.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence

SERVICES = "/app/services/"


def own_file(arguments: Sequence[str]) -> str:
    """Return the file of the service in the watchfiles command: `... "python -m services.viewer" ...`."""
    found = re.search(r"-m services\.(\w+)", " ".join(arguments))
    return f"{SERVICES}{found[1]}.py" if found else ""


OWN = own_file(sys.argv)


def concerns(_change: object, path: str, own: str = OWN) -> bool:
    """Return whether the change restarts the service: in its own file, or in a shared one."""
    return path.endswith(".py") and (not path.startswith(SERVICES) or path == own)
