"""Records a cell until a signal, the end of the requested time, or a full disk."""

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
from common.transport.credentials import RECORDER
from common.transport.endpoint import endpoint_of
from common.transport.session import call_on_loop
from common.transport.zenoh_session import connect as connect_to
from recording.capture import Capture, CustomTopics, Sink
from recording.formatting import about, format_progress, format_result, format_silent
from recording.selection import Selection
from recording.writer import SplitWriter

SHOW_PERIOD = 0.5  # [s]

Echo = Callable[[str], None]


@dataclass(frozen=True)
class RecordRequest:
    """What to record.

    Attributes:
        selection: of the messages.
        output: the file; None names it after cell and time.
        max_bytes: size after which another file is started.
        seconds: duration; None records until a signal.
        gate: whether a supervisor starts the recorder: it is ready before the services start, and ends with them.
        custom: topics of the cell that do not come with the project.
    """

    selection: Selection
    output: Path | None = None
    max_bytes: int | None = None
    seconds: float | None = None
    gate: bool = False
    custom: CustomTopics = field(default_factory=CustomTopics)


def require_published(selection: Selection) -> None:
    """Return if no selected key is that of a request, whose messages cannot be subscribed to.

    Raises:
        UnknownName: with the published keys.
    """
    for key in selection.keys:
        if find_topic(key) is not None:
            published_topic(key)


async def record_gated(
    request: RecordRequest, cell: str | None, domain: str | None, connect: str | None, echo: Echo, show: Echo | None
) -> None:
    """Record under a supervisor: be ready before its services start, end with its SIGTERM or its death."""
    endpoint = endpoint_of(domain, connect)
    joining = connect_to(cell=cell or "_", service=RECORDER, endpoint=endpoint, timeout=None, identity=RECORDER)
    async with joining as bus:
        await record(bus, request, echo, show)


async def record(bus: Bus, request: RecordRequest, echo: Echo, show: Echo | None) -> None:
    """Record a cell.

    Args:
        bus: in the cell.
        request: what to record.
        echo: called with lines for the user.
        show: called with a line that replaces the one before, empty at the end; None without a terminal.

    Raises:
        SilentKey: no message arrived on a key that the project does not know: it may be misspelled.
    """
    interrupts = Interrupts()
    interrupts.install()
    loop = asyncio.get_running_loop()
    if request.gate:
        _end_with_stdin(interrupts)
    for key in request.selection.keys:
        if find_topic(key) is None and "*" not in key:
            await require_messages(bus, key)
    path = request.output or Path(f"{bus.cell}_{time.strftime('%Y%m%d_%H%M%S')}.mcap")
    writer = SplitWriter(path, about(bus.cell), request.max_bytes)
    sink = Sink(writer, on_failure=lambda: call_on_loop(loop, interrupts.stop.set))
    capture = Capture(bus, request.selection, sink, request.custom)
    reason = "interrupted"
    try:
        await capture.start()
        echo(f"recording {bus.cell} to {path}")
        if request.gate:
            await bus.ready()
        if await _wait_for_end(interrupts, request.seconds, sink, capture, show):
            reason = "duration"
    finally:
        silent = capture.silent()
        capture.stop()
        stats = await asyncio.to_thread(sink.close, {"reason": reason, "missed": dict(capture.sequences.missed)})
    for line in format_result([str(file) for file in writer.files], stats, dict(capture.sequences.missed)):
        echo(line)
    for line in format_silent(silent):
        echo(line)


def _end_with_stdin(interrupts: Interrupts) -> None:
    """End the recording at the end of stdin, which the supervisor holds open."""
    loop = asyncio.get_running_loop()

    def read() -> None:
        if not os.read(sys.stdin.fileno(), 4096):
            loop.remove_reader(sys.stdin.fileno())
            interrupts.stop.set()

    loop.add_reader(sys.stdin.fileno(), read)


async def _wait_for_end(
    interrupts: Interrupts, seconds: float | None, sink: Sink, capture: Capture, show: Echo | None
) -> bool:
    """Show the progress until a signal, the end of the time (then return True) or a full disk."""
    started_at = time.monotonic()
    before = sink.stats
    while not interrupts.stop.is_set():
        wait = SHOW_PERIOD if seconds is None else min(SHOW_PERIOD, started_at + seconds - time.monotonic())
        if wait <= 0:
            break
        try:
            async with asyncio.timeout(wait):
                await interrupts.stop.wait()
        except TimeoutError:
            pass
        if show:
            now = sink.stats
            show(format_progress(now, before, sum(capture.sequences.missed.values())))
            before = now
    if show:
        show("")
    return not interrupts.stop.is_set()
