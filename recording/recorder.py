"""A recording of a cell, made until a signal, the end of its time or of the disk."""

from __future__ import annotations

import asyncio
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from common.application import find_topic
from common.client.keys import published_topic, require_messages
from common.supervision.lifecycle import Interrupts
from common.transport.bus import Bus
from common.transport.connect import connect as connect_to
from common.transport.credentials import RECORDER
from common.transport.endpoint import endpoint_of
from common.transport.handoff import call_on_loop
from recording.capture import Capture, CustomTopics
from recording.selection import Selection
from recording.sink import Sink
from recording.summary import about, outcome, progress
from recording.writer import SplitWriter

SHOW_PERIOD = 0.5  # [s]

Tell = Callable[[str], None]


@dataclass(frozen=True)
class RecordRequest:
    """What is to be recorded.

    Attributes:
        selection: of the messages.
        output: the file; one named after cell and time if None.
        most_bytes: after which another file is begun.
        seconds: after which it ends.
        gate: it is under a supervisor: ready before its services are let through, ended with it.
        own: what there is in the cell beside what comes with the project.
    """

    selection: Selection
    output: Path | None = None
    most_bytes: int | None = None
    seconds: float | None = None
    gate: bool = False
    own: CustomTopics = field(default_factory=CustomTopics)


def require_published(selection: Selection) -> None:
    """Return when no key is one that answers requests: these do not travel as messages that can be heard.

    Raises:
        UnknownName: with the keys that are published.
    """
    for key in selection.keys:
        if find_topic(key) is not None:
            published_topic(key)


async def record_gated(
    asked: RecordRequest, cell: str | None, domain: str | None, connect: str | None, tell: Tell, show: Tell | None
) -> None:
    """Record under a supervisor: be ready before its services are let through, end with its SIGTERM or with it."""
    endpoint = endpoint_of(domain, connect)
    joining = connect_to(cell=cell or "_", service=RECORDER, endpoint=endpoint, timeout=None, identity=RECORDER)
    async with joining as bus:
        await record(bus, asked, tell, show)


async def record(bus: Bus, asked: RecordRequest, tell: Tell, show: Tell | None) -> None:
    """Record in a cell.

    Args:
        bus: in the cell.
        asked: what.
        tell: is called with lines for a person.
        show: is called with a line that takes the place of the one before, empty at the end; None: nobody looks.

    Raises:
        SilentKey: nothing came on a key that the project does not have: it may be a slip of the hand.
    """
    interrupts = Interrupts()
    interrupts.install()
    loop = asyncio.get_running_loop()
    if asked.gate:
        _end_with_stdin(interrupts)
    for key in asked.selection.keys:
        if find_topic(key) is None and "*" not in key:
            await require_messages(bus, key)
    path = asked.output or Path(f"{bus.cell}_{time.strftime('%Y%m%d_%H%M%S')}.mcap")
    writer = SplitWriter(path, about(bus.cell), asked.most_bytes)
    sink = Sink(writer, on_failure=lambda: call_on_loop(loop, interrupts.stop.set))
    capture = Capture(bus, asked.selection, sink, asked.own)
    reason = "interrupted"
    try:
        await capture.begin()
        tell(f"recording {bus.cell} to {path}")
        if asked.gate:
            await bus.ready()
        if await _until_ended(interrupts, asked.seconds, sink, capture, show):
            reason = "duration"
    finally:
        capture.end()
        figures = await asyncio.to_thread(sink.close, {"reason": reason, "missed": dict(capture.sequences.missed)})
    for line in outcome([str(file) for file in writer.files], figures, dict(capture.sequences.missed)):
        tell(line)


def _end_with_stdin(interrupts: Interrupts) -> None:
    loop = asyncio.get_running_loop()

    def look() -> None:
        if not os.read(sys.stdin.fileno(), 4096):
            loop.remove_reader(sys.stdin.fileno())
            interrupts.stop.set()  # the supervisor is gone

    loop.add_reader(sys.stdin.fileno(), look)


async def _until_ended(
    interrupts: Interrupts, seconds: float | None, sink: Sink, capture: Capture, show: Tell | None
) -> bool:
    """Show how it goes until a signal, the end of the time (then True) or of the disk."""
    began = time.monotonic()
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
        if show:
            now = sink.figures
            show(progress(now, before, sum(capture.sequences.missed.values())))
            before = now
    if show:
        show("")
    return not interrupts.stop.is_set()
