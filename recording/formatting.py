"""Text for users about recordings: progress, result and contents. Light to import: each `zencell` command does."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from common.errors import ConfigError
from common.terminal import printable

if TYPE_CHECKING:
    from recording.capture import RecordingStats
    from recording.reader import Recovered
    from recording.summary import Summary

MOST_HOLES = 3  # that a line lists
MOST_SHOWN = 200  # [characters] of each value that describes the run


def format_progress(now: RecordingStats, before: RecordingStats, missed: int) -> str:
    """Return the progress of a recording in one line."""
    seconds = max(1e-3, now.seconds - before.seconds)
    rate = (now.size - before.size) / seconds
    lost = sum(now.dropped.values()) + missed
    return (f"{now.seconds:6.1f} s  {now.messages:,} messages  {format_bytes(now.size)}  {format_bytes(rate)}/s  "
            f"{lost or 'none'} lost")


def format_silent(silent: dict[str, float]) -> list[str]:
    """Return a line for each stream that has ceased, with the time since its last message [s]."""
    return [f"  {topic}: no message in the last {seconds:.0f} s" for topic, seconds in sorted(silent.items())]


def format_result(files: list[str], stats: RecordingStats, missed: dict[str, int]) -> list[str]:
    """Return the result of a recording as lines."""
    names = files[0] if len(files) == 1 else f"{files[0]} to {files[-1]}"
    line = f"recorded {stats.messages:,} messages, {format_bytes(stats.size)}, {stats.seconds:.1f} s: {names}"
    why = "the disk was too slow, or there were too many keys"
    lost = [f"  {key}: {count} dropped, {why}" for key, count in sorted(stats.dropped.items())]
    lost += [f"  {key}: {count} lost on the network" for key, count in sorted(missed.items())]
    return [line, *(lost or ["no message was lost"])]


def format_recovery(saved: Recovered, target: Path) -> str:
    """Return what was saved to a file, and what was lost, in one line."""
    lost = [f"{format_bytes(size)} in a hole" for size in saved.holes[:MOST_HOLES]]
    if more := saved.holes[MOST_HOLES:]:
        lost.append(f"{format_bytes(sum(more))} in {len(more)} more holes")
    lost += [f"{format_bytes(saved.lost_bytes)} after the last record"] if saved.lost_bytes else []
    lost += [f"{saved.damaged_chunks} damaged chunks"] if saved.damaged_chunks else []
    lost += [f"{saved.unknown:,} messages whose topic is unknown"] if saved.unknown else []
    return (f"saved {saved.messages:,} messages, {saved.seconds:.1f} s: {target}; "
            f"lost {' and '.join(lost) or 'nothing'}")


def cell_to_play(recorded: str, file: str, named: str | None) -> str:
    """Return the cell as which a recording is played: the named one, else that of the recording.

    Raises:
        ConfigError: there is none, or its name is not valid.
    """
    from common.remapping import is_cell

    name = named or recorded
    if not name:
        raise ConfigError("--cell", ..., f"{file} does not name its cell: name one")
    if not is_cell(name):
        raise ConfigError("--cell", name, "is not a valid name of a cell")
    return name


def format_bytes(size: float) -> str:
    """Return a size with its unit."""
    for unit, least in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= least:
            return f"{size / least:.1f} {unit}"
    return f"{size:.0f} B"


def about(cell: str) -> dict[str, Any]:
    """Return the description that a new recording of a cell starts with."""
    from importlib.metadata import version

    versions = {name: version(name) for name in ("zencell", "eclipse-zenoh", "msgpack", "pydantic", "numpy", "mcap")}
    return {
        "cell": cell, "made": time.strftime("%Y-%m-%dT%H:%M:%S%z"), "python": sys.version.split()[0],
        "versions": versions, "arguments": sys.argv[1:],
    }


def format_contents(file: str, cell: str, summary: Summary) -> list[str]:
    """Return the contents of a recording as lines."""
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(summary.start * 1e-9)) if summary.messages else "never"
    lines = [f"{file}: {cell}, {summary.seconds:.1f} s from {when}, "
             f"{summary.messages:,} messages, {format_bytes(summary.size)}"]
    if summary.run:
        values = {key: printable(value)[:MOST_SHOWN] for key, value in summary.run.items() if value and key != "epoch"}
        lines.append("  " + ", ".join(f"{printable(key)} {value}" for key, value in values.items()))
    if summary.flaw:
        lines.append(f"  {summary.flaw}. To repair it: zencell recover {file}")
    lines.append(f"{'topic':<30} {'type':<16} {'messages':>9} {'Hz':>8} {'payload':>10}")
    for name, topic in summary.topics.items():
        rate = f"{topic.hz:8.2f}" if topic.messages > 1 else " " * 8
        lost = f"  {topic.dropped + topic.missed} lost" if topic.dropped + topic.missed else ""
        label = f"{printable(name):<30} {printable(topic.type):<16}"
        lines.append(f"{label} {topic.messages:>9,} {rate} {format_bytes(topic.bytes):>10}{lost}")
    return lines


def require_new(path: Path, option: str = "-o", suffix: str = ".mcap") -> None:
    """Return if a file can be created there.

    Raises:
        ConfigError: the folder does not exist, or the file does.
    """
    if path.suffix != suffix:
        raise ConfigError(option, str(path), f"must end in {suffix}")
    if not path.absolute().parent.is_dir():
        raise ConfigError(option, str(path), "is in a folder that does not exist")
    if path.exists():
        raise ConfigError(option, str(path), "exists already; choose another name")
