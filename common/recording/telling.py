"""How a recording goes and went, in lines for people, and what it says about its making."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from common.recording.sink import Figures


def progress(now: Figures, before: Figures, missed: int) -> str:
    """How a recording goes, in one line."""
    apart = max(1e-3, now.seconds - before.seconds)
    rate = (now.size - before.size) / apart
    lost = sum(now.dropped.values()) + missed
    return (f"{now.seconds:6.1f} s  {now.messages:,} messages  {in_bytes(now.size)}  {in_bytes(rate)}/s  "
            f"{lost or 'none'} lost")


def outcome(files: list[str], figures: Figures, missed: dict[str, int]) -> list[str]:
    """How a recording went, for the person who made it."""
    names = files[0] if len(files) == 1 else f"{files[0]} to {files[-1]}"
    line = f"recorded {figures.messages:,} messages, {in_bytes(figures.size)}, {figures.seconds:.1f} s: {names}"
    lost = [f"  {key}: {count} dropped, the disk was too slow" for key, count in sorted(figures.dropped.items())]
    lost += [f"  {key}: {count} lost on the way here" for key, count in sorted(missed.items())]
    return [line, *(lost or ["nothing was lost"])]


def in_bytes(size: float) -> str:
    """A size for people."""
    for unit, least in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= least:
            return f"{size / least:.1f} {unit}"
    return f"{size:.0f} B"


def about(cell: str) -> dict[str, Any]:
    """What a recording says about its making."""
    from importlib.metadata import version

    versions = {name: version(name) for name in ("zencell", "eclipse-zenoh", "msgpack", "pydantic", "numpy", "mcap")}
    return {
        "cell": cell, "made": time.strftime("%Y-%m-%dT%H:%M:%S%z"), "python": sys.version.split()[0],
        "versions": versions, "arguments": sys.argv[1:],
    }
