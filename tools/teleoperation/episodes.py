"""Records the episodes of a running cell, one file each, into a folder with a manifest."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

from common.config import Cell as CellConfig
from common.errors import ConfigError
from common.time_source import monotonic
from common.transport.bus import Bus
from common.transport.session import call_on_loop
from recording.capture import Capture, CustomTopics, Sink
from recording.datasets.manifest import NAME, Demonstration, Manifest, read_manifest, write_manifest
from recording.formatting import about, format_bytes, format_silent
from recording.sample import RecordingError
from recording.selection import Selection
from recording.writer import SplitWriter


class EpisodeFolder:
    """A folder of demonstrations; a folder that has a manifest of the same cell is continued."""

    def __init__(self, path: Path, cell: str) -> None:
        """Create the folder, or read its manifest.

        Raises:
            ConfigError: it is another cell's, has other files, or cannot be written.
        """
        self.path = path
        if (path / NAME).exists():
            self.manifest = read_manifest(path)
            if self.manifest.cell != cell:
                raise ConfigError("--output", str(path), f"has episodes of the cell {self.manifest.cell}, not {cell}")
            return
        try:
            path.mkdir(exist_ok=True)
            if any(path.iterdir()):
                raise ConfigError("--output", str(path), f"has files, but no {NAME}: choose a new folder")
            self.manifest = Manifest(cell=cell)
            write_manifest(path, self.manifest)
        except OSError as error:
            raise ConfigError("--output", str(path), f"cannot be written: {error.strerror}") from None

    def interrupted(self) -> list[str]:
        """Return the names of recordings without an entry: their program was killed."""
        known = {each.file for each in self.manifest.episodes}
        return sorted(file.name for file in self.path.glob(f"episode_{4 * '[0-9]'}.mcap") if file.name not in known)

    def next_file(self) -> Path:
        """Return the file of the next episode; a file that a killed program left is not used again."""
        number = len(self.manifest.episodes)
        while (file := self.path / f"episode_{number:04d}.mcap").exists():
            number += 1
        return file

    def add(self, file: Path, *, success: bool, task: str, seed: int | None) -> None:
        """Add a recorded episode to the manifest.

        Raises:
            RecordingError: the disk is full.
        """
        self.manifest.episodes.append(Demonstration(file=file.name, success=success, task=task, seed=seed))
        try:
            write_manifest(self.path, self.manifest)
        except OSError as error:
            raise RecordingError(f"{self.path / NAME}: cannot be written: {error.strerror}") from None


class EpisodeRecorder:
    """Records what is published in a cell, from `start` to `stop`."""

    def __init__(self, bus: Bus, cell: CellConfig, folder: EpisodeFolder) -> None:
        """Record nothing yet.

        Args:
            bus: in the cell.
            cell: its configuration.
            folder: of the files.
        """
        self._bus, self._custom, self._folder = bus, CustomTopics.of(cell), folder
        self._running: tuple[Capture, Sink, Path, float] | None = None

    @property
    def running(self) -> bool:
        """Whether an episode is being recorded."""
        return self._running is not None

    @property
    def progress(self) -> str:
        """Duration and size of the running episode."""
        if self._running is None:
            return ""
        _, sink, _, since = self._running
        return f"{monotonic() - since:.1f} s, {format_bytes(sink.stats.size)}"

    async def start(self, on_failure: Callable[[], None]) -> None:
        """Start the next episode; returns when it is being recorded.

        Args:
            on_failure: called on the loop when the disk fails; `stop` then raises the reason.

        Raises:
            RecordingError: the file cannot be written.
        """
        file, loop = self._folder.next_file(), asyncio.get_running_loop()
        sink = Sink(SplitWriter(file, about(self._bus.cell)), on_failure=lambda: call_on_loop(loop, on_failure))
        capture = Capture(self._bus, Selection.of((), None, None), sink, self._custom)
        self._running = capture, sink, file, monotonic()
        await capture.start()

    async def stop(self) -> tuple[Path, str]:
        """End the episode; return its file and a description.

        Raises:
            RecordingError: the disk failed; the file has what was written before.
        """
        assert self._running is not None
        (capture, sink, file, since), self._running = self._running, None
        silent = [line.strip() for line in format_silent(capture.silent())]
        capture.stop()
        missed = dict(capture.sequences.missed)
        seconds = monotonic() - since
        stats = await asyncio.to_thread(sink.close, {"reason": "episode", "missed": missed})
        lost = sum(stats.dropped.values()) + sum(missed.values())
        notes = [f"{seconds:.1f} s", format_bytes(stats.size), *([f"{lost} messages lost"] if lost else []), *silent]
        return file, ", ".join(notes)
