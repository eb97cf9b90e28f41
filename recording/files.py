"""The files of a recording: only appended to, so that what was written is on its way to the disk, and split by size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from recording.sample import Sample
from recording.writing import ABOUT, RecordingWriter

MOST_STATES = 500  # with which a file begins: those that were said last


class SplitWriter:
    """Writes FILE.mcap, or FILE_0.mcap, FILE_1.mcap, ... of about `max_bytes` each.

    A file after the first begins with the last value of every state and with the same descriptions, so that each can
    be used alone.
    """

    def __init__(self, path: Path, about: Mapping[str, Any], max_bytes: int | None = None) -> None:
        """Create the first file.

        Raises:
            RecordingError: it is there already, or cannot be written.
        """
        self._path = path
        self._most = max_bytes
        self._descriptions: dict[str, Mapping[str, Any]] = {ABOUT: about}
        self._states: dict[tuple[str, str], Sample] = {}
        self._earlier_messages = 0
        self._earlier_bytes = 0
        self.files: list[Path] = []
        self._file = self._open()

    @property
    def messages(self) -> int:
        """Messages in all files; a state that opens a file counts again."""
        return self._earlier_messages + self._file.messages

    @property
    def size(self) -> int:
        """Bytes on disk of all files."""
        return self._earlier_bytes + self._file.size

    def _open(self) -> RecordingWriter:
        numbered = self._path.with_name(f"{self._path.stem}_{len(self.files)}{self._path.suffix}")
        path = self._path if self._most is None else numbered
        writer = RecordingWriter(path, self._descriptions[ABOUT])
        self.files.append(path)
        return writer

    def describe(self, name: str, values: Mapping[str, Any]) -> None:
        """Write a metadata record, also into the files that follow."""
        self._descriptions[name] = values
        self._file.describe(name, values)

    def add(self, sample: Sample) -> bool:
        """Write a message; whether there was room for its key.

        Raises:
            RecordingError: the disk takes no more.
        """
        written = self._file.add(sample)
        if self._most is None or not written:
            return written
        if sample.kind == "state":
            self._states.pop((sample.key, sample.writer), None)
            self._states[sample.key, sample.writer] = sample
            while len(self._states) > MOST_STATES:
                del self._states[next(iter(self._states))]
        if self._file.size >= self._most:
            self._next(sample.log_time)
        return written

    def _next(self, now: int) -> None:
        full = self._file
        full.close()
        self._earlier_messages += full.messages
        self._earlier_bytes += full.size
        self._file = self._open()
        for name, values in self._descriptions.items():
            if name != ABOUT:
                self._file.describe(name, values)
        for state in self._states.values():
            self._file.add(replace(state, log_time=now))

    def flush(self) -> None:
        """Put everything on disk.

        Raises:
            WritingFailed: the disk takes no more.
        """
        self._file.flush()

    def close(self, ended: Mapping[str, Any] | None = None) -> None:
        """Write the rest and how it ended, and close.

        Raises:
            WritingFailed: the disk takes no more.
        """
        self._file.close(ended)

    def abandon(self) -> None:
        """Close as it is, after a failure."""
        self._file.abandon()


