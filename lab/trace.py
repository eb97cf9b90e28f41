"""What travels in a simulated cell as a recording, which `info`, `play`, `report` and the page open."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from common import topics
from common.messages import SupervisorStatus
from common.transport.codec import decode, decode_attachment
from common.transport.reader import SequenceFilter
from common.transport.session import RawSample
from recording.own import Own
from recording.sample import Sample, message_of
from recording.writing import RUN, RecordingWriter, run_of

FLUSH_NS = 800_000_000  # of virtual time


class Trace:
    """Writes every message once, at its virtual time."""

    def __init__(self, path: Path, about: Mapping[str, Any], own: Own) -> None:
        """Create the file.

        Args:
            path: of the file.
            about: what is recorded.
            own: what there is in the cell beside what comes with the project.

        Raises:
            RecordingError: it is there already, or cannot be written.
        """
        self._writer = RecordingWriter(path, about)
        self._kinds = own.kinds(own.topics())
        self._newness: dict[str, SequenceFilter] = {}
        self._run_known = False
        self._flushed = 0

    @property
    def messages(self) -> int:
        """How many were written."""
        return self._writer.messages

    def add(self, raw: RawSample, now: int) -> None:
        """Write a message that is put now [ns since the Unix epoch], unless it is put again."""
        origin = decode_attachment(raw.attachment)
        if origin is None or not self._newness.setdefault(raw.key, SequenceFilter()).is_new(origin):
            return
        topic = raw.key.partition("/")[2]
        if topic == topics.SUPERVISOR_STATUS.key and not self._run_known:
            self._run_known = True
            status = decode(SupervisorStatus, raw.payload)
            self._writer.describe(RUN, run_of(status))
        kind = self._kinds.get(topics.general_key(topic), "stream")
        self._writer.add(Sample(
            raw.key, raw.payload, now, message=message_of(raw.encoding), kind=kind,
            writer=origin.writer, sequence=origin.sequence, trace=origin.trace,
        ))
        if now - self._flushed > FLUSH_NS:
            self._flushed = now
            self._writer.flush()

    def close(self, reason: str) -> None:
        """Write how it ended, and the rest."""
        self._writer.close({"reason": reason, "missed": {}, "dropped": {}})
