"""Recordings: make one, look what is in it, repair one that was cut."""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli import completion, options
from common.errors import ConfigError
from common.recording.telling import about, in_bytes, outcome, progress
from common.terminal import echo, printable

if TYPE_CHECKING:
    from collections.abc import Callable

    from common.recording.own import Own
    from common.recording.selection import Selection
    from common.recording.sink import Sink
    from common.supervision.interrupts import Interrupts
    from common.transport.bus import Bus

NAME = "recorder"
SHOW_PERIOD = 0.5  # [s]
MOST_SHOWN = 200  # [characters] of what a recording tells
LEAST_FILE = 1.0  # [MB] of a recording that is split

File = Annotated[str, typer.Argument(metavar="FILE.mcap", help="a recording")]
Keys = Annotated[
    list[str] | None, typer.Argument(metavar="KEY", help="without the cell; * and ** as wildcards",
                                     autocompletion=completion.published)
]
Exclude = Annotated[str | None, typer.Option("--exclude", metavar="RE", help="leave out keys in which RE is found")]


def record(
    keys: Keys = None,
    regex: Annotated[str | None, typer.Option("--regex", metavar="RE", help="keys in which RE is found")] = None,
    exclude: Exclude = None,
    output: Annotated[str | None, typer.Option("-o", "--output", metavar="FILE.mcap", help="[CELL_TIME.mcap]")] = None,
    duration: Annotated[str | None, typer.Option("--duration", metavar="S", help="end after so long [s]")] = None,
    max_size: Annotated[
        str | None, typer.Option("--max-size", metavar="MB", help="begin another file, FILE_1.mcap, after so much")
    ] = None,
    cell: options.CellName = None,
    domain: options.Domain = None,
    connect: options.Connect = None,
    gate: Annotated[bool, typer.Option("--gate", hidden=True, help="under a supervisor: wait for a line")] = False,
    own: Annotated[str, typer.Option("--own", hidden=True, help="under a supervisor: what is in the cell's file")] = "",
) -> None:
    """Record what travels in a cell, all keys if none are given, until Ctrl-C."""
    from cli.inspection import inspect
    from common.config import load_cell
    from common.recording.own import Own
    from common.recording.selection import Selection
    from common.transport.credentials import identity_of_listener

    beside = Own.read(own) if own else Own()
    if cell is not None and cell.endswith((".yaml", ".yml")):
        loaded = load_cell(cell)
        cell, beside = loaded.name, Own.of(loaded)
    selection = Selection.of(keys or (), regex, exclude)
    _require_published(selection)
    seconds = _positive("--duration", duration)
    megabytes = _positive("--max-size", max_size)
    if megabytes is not None and megabytes < LEAST_FILE:
        raise ConfigError("--max-size", max_size, f"must be {LEAST_FILE:g} or more")
    asked = _Asked(output, None if megabytes is None else round(megabytes * 1e6), seconds, gate, beside)
    if gate:
        asyncio.run(_gated(selection, asked, cell, domain, connect))
    else:
        inspect(lambda bus: _record(bus, selection, asked), cell=cell, domain=domain, connect=connect,
                identity=identity_of_listener())


class _Asked:
    """What a person asked for."""

    def __init__(
        self, output: str | None, most_bytes: int | None, seconds: float | None, gate: bool, own: Own
    ) -> None:
        self.output = Path(output) if output else None
        self.most_bytes = most_bytes
        self.seconds = seconds
        self.gate = gate
        self.own = own
        if self.output is not None:
            require_new(self.output)


def require_new(path: Path, option: str = "-o") -> None:
    """Return when a recording can be made there.

    Raises:
        ConfigError: the folder is not there, or the file is.
    """
    if path.suffix != ".mcap":
        raise ConfigError(option, str(path), "must end in .mcap")
    if not path.absolute().parent.is_dir():
        raise ConfigError(option, str(path), "is in a folder that does not exist")
    if path.exists():
        raise ConfigError(option, str(path), "is there already; choose another name")


def _positive(option: str, text: str | None) -> float | None:
    if text is None:
        return None
    value = options.number(option, text)
    if value <= 0:
        raise ConfigError(option, text, "must be more than 0")
    return value


def _require_published(selection: Selection) -> None:
    """Return when no key is one that answers requests: these do not travel as messages that can be heard."""
    from cli.topic import published
    from common.application import find_topic

    for key in selection.keys:
        if find_topic(key) is not None:
            published(key)


async def _gated(
    selection: Selection, asked: _Asked, cell: str | None, domain: str | None, connect: str | None
) -> None:
    """Record under a supervisor: be ready before its services are let through, end with its SIGTERM or with it."""
    from common.transport.connect import connect as connect_to
    from common.transport.credentials import RECORDER
    from common.transport.endpoint import endpoint_of

    endpoint = endpoint_of(domain, connect)
    joining = connect_to(cell=cell or "_", service=NAME, endpoint=endpoint, timeout=None, identity=RECORDER)
    async with joining as bus:
        await _record(bus, selection, asked)


async def _record(bus: Bus, selection: Selection, asked: _Asked) -> None:
    from common.client.capturing import Capture
    from common.recording.files import SplitWriter
    from common.recording.sink import Sink
    from common.supervision.interrupts import Interrupts
    from common.transport.handoff import call_on_loop

    interrupts = Interrupts()
    interrupts.install()
    loop = asyncio.get_running_loop()
    if asked.gate:
        _end_with_stdin(interrupts)
    await _require_heard(bus, selection)
    path = asked.output or Path(f"{bus.cell}_{time.strftime('%Y%m%d_%H%M%S')}.mcap")
    writer = SplitWriter(path, about(bus.cell), asked.most_bytes)
    sink = Sink(writer, on_failure=lambda: call_on_loop(loop, interrupts.stop.set))
    capture = Capture(bus, selection, sink, asked.own)
    reason = "interrupted"
    try:
        await capture.begin()
        echo(f"recording {bus.cell} to {path}")
        if asked.gate:
            await bus.ready()
        if await _until_ended(interrupts, asked.seconds, sink, lambda: sum(capture.sequences.missed.values())):
            reason = "duration"
    finally:
        capture.end()
        figures = await asyncio.to_thread(sink.close, {"reason": reason, "missed": dict(capture.sequences.missed)})
    for line in outcome([str(file) for file in writer.files], figures, dict(capture.sequences.missed)):
        echo(line)


def _end_with_stdin(interrupts: Interrupts) -> None:
    loop = asyncio.get_running_loop()

    def look() -> None:
        if not os.read(sys.stdin.fileno(), 4096):
            loop.remove_reader(sys.stdin.fileno())
            interrupts.stop.set()  # the supervisor is gone

    loop.add_reader(sys.stdin.fileno(), look)


async def _require_heard(bus: Bus, selection: Selection) -> None:
    """Return when somebody writes the keys that the project does not have: each may be a slip of the hand.

    Raises:
        SilentKey: nothing came on one of them.
    """
    from common.application import find_topic
    from common.client.foreign import require_heard

    for key in selection.keys:
        if find_topic(key) is None and "*" not in key:
            await require_heard(bus, key)


async def _until_ended(
    interrupts: Interrupts, seconds: float | None, sink: Sink, missed: Callable[[], int]
) -> bool:
    """Show how it goes until a signal, the end of the time (then True) or of the disk."""
    began = time.monotonic()
    live = sys.stderr.isatty()
    before = sink.figures
    while not interrupts.stop.is_set():
        left = SHOW_PERIOD if seconds is None else min(SHOW_PERIOD, began + seconds - time.monotonic())
        if left <= 0:
            break
        try:
            async with asyncio.timeout(left):
                await interrupts.stop.wait()
        except TimeoutError:
            pass
        if live:
            now = sink.figures
            sys.stderr.write(f"\r\x1b[K{progress(now, before, missed())}")
            sys.stderr.flush()
            before = now
    if live:
        sys.stderr.write("\r\x1b[K")
        sys.stderr.flush()
    return not interrupts.stop.is_set()


def info(file: File, as_json: options.Json = False) -> None:
    """Show what is in a recording: each topic with its type, count, rate and size, how long it is, what was lost."""
    from common.recording.reading import Recording
    from common.recording.summary import summarise

    with Recording(Path(file)) as recording:
        summary = summarise(recording)
    if as_json:
        echo(json.dumps(summary.as_dict()))
        return
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(summary.start * 1e-9)) if summary.messages else "never"
    echo(f"{file}: {recording.cell}, {summary.seconds:.1f} s from {when}, "
               f"{summary.messages:,} messages, {in_bytes(summary.size)}")
    if summary.run:
        told = {key: printable(value)[:MOST_SHOWN] for key, value in summary.run.items() if value and key != "epoch"}
        echo("  " + ", ".join(f"{printable(key)} {value}" for key, value in told.items()))
    if not summary.finished:
        echo(f"  not finished: the recorder was killed or still records. Make it whole: zencell recover {file}")
    echo(f"{'topic':<30} {'type':<16} {'messages':>9} {'Hz':>8} {'payload':>10}")
    for name, topic in summary.topics.items():
        rate = f"{topic.hz:8.2f}" if topic.messages > 1 else " " * 8
        lost = f"  {topic.dropped + topic.missed} lost" if topic.dropped + topic.missed else ""
        named = f"{printable(name):<30} {printable(topic.type):<16}"
        echo(f"{named} {topic.messages:>9,} {rate} {in_bytes(topic.bytes):>10}{lost}")


def recover(
    file: File,
    output: Annotated[
        str | None, typer.Option("-o", "--output", metavar="FILE.mcap", help="[FILE_recovered.mcap]")
    ] = None,
) -> None:
    """Make a whole file of a recording that was cut by a kill or a full disk."""
    from common.recording.recovery import recover as recover_file

    source = Path(file)
    target = Path(output) if output else source.with_name(f"{source.stem}_recovered.mcap")
    require_new(target)
    saved = recover_file(source, target)
    lost = [f"{in_bytes(saved.lost_bytes)} after the cut"] if saved.lost_bytes else []
    lost += [f"{saved.damaged_chunks} damaged chunks"] if saved.damaged_chunks else []
    echo(f"saved {saved.messages:,} messages, {saved.seconds:.1f} s: {target}; "
               f"lost {' and '.join(lost) or 'nothing'}")
