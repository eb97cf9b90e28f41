"""Takes what travels in a cell from the network to a recording."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from common import topics
from common.application import all_topics, import_topics
from common.config import Cell
from common.errors import DecodeError
from common.messages import SupervisorStatus
from common.remapping import Remapping
from common.transport.codec import decode, decode_attachment
from common.transport.credentials import secure_folder
from common.transport.ownership import Owner
from common.transport.session import owns_key
from recording.reader import MOST_SPEED, MOST_TEXT
from recording.sample import Sample, Sequences, message_of
from recording.writer import RUN, run_of

if TYPE_CHECKING:
    from common.transport.bus import Bus
    from common.transport.session import Declaration, RawSample
    from recording.selection import Selection
    from recording.sink import Sink


ASK_TIMEOUT = 1.0  # [s] for the values of states


class Capture:
    """Hands every wanted message to a sink, repetitions left out and gaps counted."""

    def __init__(self, bus: Bus, selection: Selection, sink: Sink, own: CustomTopics | None = None) -> None:
        """Take nothing yet.

        Args:
            bus: in the cell.
            selection: what is wanted.
            sink: where it goes.
            own: what there is in the cell beside what comes with the project.
        """
        self.sequences = Sequences()
        self._bus = bus
        self._selection = selection
        self._sink = sink
        self._lock = threading.Lock()
        self._ahead = time.time_ns() - time.monotonic_ns()  # a step of the system clock must not turn messages round
        own = own or CustomTopics()
        self._known = own.topics()
        self._kinds = own.kinds(self._known)
        self._run_known = False
        self._declared: list[Declaration] = []

    async def begin(self) -> None:
        """Listen from now on; returns when the values of all states that were there are in the recording."""
        wanted = [f"{self._bus.cell}/{key}" for key in self._selection.expressions]
        # Where no file of the cell was given, tokens tell which services have their keys under other names.
        self._declared = [self._bus.raw_watch_tokens(owns_key(self._bus.cell), self._on_owner)]
        status = f"{self._bus.cell}/{topics.SUPERVISOR_STATUS.key}"
        self._declared += [self._bus.raw_subscriber(key, self.on_sample) for key in wanted]
        if f"{self._bus.cell}/**" not in wanted and status not in wanted:
            self._declared.append(self._bus.raw_subscriber(status, self._on_status))
            for sample in await self._bus.raw_get(status, ASK_TIMEOUT):
                self._on_status(sample)
        for answers in await asyncio.gather(*(self._bus.raw_get(key, ASK_TIMEOUT) for key in self._asked(wanted))):
            for sample in answers:
                self.on_sample(sample, kind="state")

    def _asked(self, wanted: list[str]) -> list[str]:
        if secure_folder() is None or f"{self._bus.cell}/**" not in wanted:
            return wanted
        # Who may ask for every key could call every request, so the rules name the states one by one.
        return [f"{self._bus.cell}/{key}" for key, kind in self._kinds.items() if kind == "state"]

    def end(self) -> None:
        """Listen no more."""
        while self._declared:
            self._declared.pop().undeclare()

    def on_sample(self, raw: RawSample, kind: str = "") -> None:
        """Take one message; on any thread. `kind` is what a key that is not ours is then known to be."""
        topic = raw.key.partition("/")[2]
        if topic == topics.SUPERVISOR_STATUS.key:
            self._on_status(raw)
        if not self._selection.wants(topic):
            return
        writer, sequence, trace = _origin(raw)
        with self._lock:  # the order of times is the order in the file
            if writer and not self.sequences.is_new(raw.key, writer, sequence):
                return
            self._sink.offer(Sample(
                raw.key, raw.payload, time.monotonic_ns() + self._ahead, message=message_of(raw.encoding),
                kind=self._kinds.get(topics.general_key(topic)) or kind or "stream", writer=writer, sequence=sequence,
                trace=trace,
            ))

    def _on_owner(self, token: str) -> None:
        owner = Owner.of(token)
        if (topic := self._known.get(owner.own)) is not None:
            self._kinds[owner.key] = str(topic.kind)

    def _on_status(self, raw: RawSample) -> None:
        if self._run_known:
            return
        try:
            status = decode(SupervisorStatus, raw.payload)
        except DecodeError:
            return  # somebody else's
        if status.speed > MOST_SPEED or any(len(text) > MOST_TEXT for text in (status.world, *status.overrides)):
            return  # no supervisor says that, and nobody would read a recording of it
        self._run_known = True
        self._sink.describe(RUN, run_of(status))


def _origin(raw: RawSample) -> tuple[str, int, str]:
    """Writer id, sequence number and trace id of a message; empty for a sender that does not say."""
    try:
        attachment = decode_attachment(raw.attachment)
    except DecodeError:
        attachment = None
    return (attachment.writer, attachment.sequence, attachment.trace) if attachment else ("", 0, "")


@dataclass(frozen=True)
class CustomTopics:
    """Modules of a person's own, and keys under other names."""

    modules: tuple[str, ...] = ()
    renamed: tuple[Mapping[str, str], ...] = ()  # as common/remapping.py has it, by service

    @classmethod
    def of(cls, cell: Cell) -> CustomTopics:
        """That of a cell file."""
        services = cell.services.values()
        named = dict.fromkeys([cell.application, *(entry.module for entry in services)])
        own = (name for name in named if "." in name and not name.startswith("services."))
        return cls(tuple(own), tuple(entry.topics for entry in services if entry.topics))

    @classmethod
    def read(cls, text: str) -> CustomTopics:
        """What `str` wrote."""
        return cls(*(tuple(part) for part in json.loads(text)))

    def __str__(self) -> str:
        return json.dumps([self.modules, self.renamed])

    def topics(self) -> dict[str, Any]:
        """Every topic by its key before it is renamed; the messages of all modules are known from now on."""
        return {**all_topics(), **import_topics(self.modules)}

    def kinds(self, known: Mapping[str, Any]) -> dict[str, str]:
        """Kinds of topics by key in the cell."""
        kinds = {key: str(topic.kind) for key, topic in known.items()}
        return kinds | {Remapping(table).key(key): kind for table in self.renamed for key, kind in kinds.items()}
