"""Recordings: record, show the contents, recover a truncated file."""

from __future__ import annotations

import asyncio
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from cli import choices, options
from cli.target import RUNNING, CellTarget
from common.errors import ConfigError
from common.terminal import echo, rewrite
from recording.formatting import format_bytes, format_contents, require_new

MIN_FILE_SIZE = 1.0  # [MB] of a recording that is split

File = Annotated[str, typer.Argument(metavar="FILE.mcap", help="a recording")]
Keys = Annotated[
    list[str] | None, typer.Argument(metavar="KEY", help="without the cell; * and ** as wildcards",
                                     autocompletion=choices.published)
]
Exclude = Annotated[str | None, typer.Option("--exclude", metavar="RE", help="leave out keys that match RE")]


def record_(
    keys: Keys = None,
    regex: Annotated[str | None, typer.Option("--regex", metavar="RE", help="only keys that match RE")] = None,
    exclude: Exclude = None,
    output: Annotated[str | None, typer.Option("-o", "--output", metavar="FILE.mcap", help="[CELL_TIME.mcap]")] = None,
    duration: Annotated[str | None, typer.Option("--duration", metavar="S", help="stop after this duration "
                                                                                 "[s]")] = None,
    max_size: Annotated[
        str | None, typer.Option("--max-size", metavar="MB", help="split into FILE_1.mcap, ... at this size")
    ] = None,
    at: CellTarget = RUNNING,
    gate: Annotated[bool, typer.Option("--gate", hidden=True, help="under a supervisor: wait for a line")] = False,
    own: Annotated[str, typer.Option("--own", hidden=True, help="under a supervisor: custom topics of the cell")] = "",
) -> None:
    """Record the messages of a cell until Ctrl-C: the given keys, or all."""
    from common.config import load_cell
    from common.transport.credentials import observer_identity
    from recording.capture import CustomTopics
    from recording.recorder import RecordRequest, record, record_gated, require_published
    from recording.selection import Selection

    custom, cell = CustomTopics.read(own) if own else CustomTopics(), at.cell
    if cell is not None and cell.endswith((".yaml", ".yml")):
        loaded = load_cell(cell)
        cell, custom = loaded.name, CustomTopics.of(loaded)
    selection = Selection.of(keys or (), regex, exclude)
    require_published(selection)
    seconds = _positive("--duration", duration)
    megabytes = _positive("--max-size", max_size)
    if megabytes is not None and megabytes < MIN_FILE_SIZE:
        raise ConfigError("--max-size", max_size, f"must be {MIN_FILE_SIZE:g} or more")
    if output:
        require_new(Path(output))
    request = RecordRequest(
        selection, Path(output) if output else None, None if megabytes is None else round(megabytes * 1e6), seconds,
        gate, custom)
    show = rewrite if sys.stderr.isatty() else None
    if gate:
        asyncio.run(record_gated(request, cell, at.domain, at.connect, echo, show))
    else:
        replace(at, cell=cell).visit(lambda bus: record(bus, request, echo, show), identity=observer_identity())


def _positive(option: str, text: str | None) -> float | None:
    if text is None:
        return None
    value = options.number(option, text)
    if value <= 0:
        raise ConfigError(option, text, "must be more than 0")
    return value


def info(file: File, as_json: options.Json = False) -> None:
    """Show the contents of a recording: type, count, rate and size of each topic, duration, lost messages."""
    from recording.reader import Recording
    from recording.summary import summarise

    with Recording(Path(file)) as recording:
        summary = summarise(recording)
    if as_json:
        echo(json.dumps(summary.as_dict()))
        return
    for line in format_contents(file, recording.cell, summary):
        echo(line)


def recover(
    file: File,
    output: Annotated[
        str | None, typer.Option("-o", "--output", metavar="FILE.mcap", help="[FILE_recovered.mcap]")
    ] = None,
) -> None:
    """Write a complete file from a recording that was truncated by a kill or a full disk."""
    from recording.reader import recover as recover_file

    source = Path(file)
    target = Path(output) if output else source.with_name(f"{source.stem}_recovered.mcap")
    require_new(target)
    saved = recover_file(source, target)
    lost = [f"{format_bytes(saved.lost_bytes)} after the cut"] if saved.lost_bytes else []
    lost += [f"{saved.damaged_chunks} damaged chunks"] if saved.damaged_chunks else []
    echo(f"saved {saved.messages:,} messages, {saved.seconds:.1f} s: {target}; "
         f"lost {' and '.join(lost) or 'nothing'}")
