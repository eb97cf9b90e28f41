"""Names of files for what a recording calls its topics, which may be anything."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import count

LONGEST = 100  # [characters]


def file_names(topics: Iterable[str]) -> dict[str, str]:
    """For each topic the name of a file or folder of its own, without an ending: none leads out of its folder."""
    names: dict[str, str] = {}
    taken: set[str] = set()
    for topic in topics:
        plain = re.sub(r"[^\w.-]|^\.", "_", topic, flags=re.ASCII)[:LONGEST] or "_"
        name = next(each for k in count(1) if (each := plain if k == 1 else f"{plain}_{k}") not in taken)
        taken.add(name)
        names[topic] = name
    return names
