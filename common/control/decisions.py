"""What persons decided about a cell, kept in its file: decided is what was written."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from common.control.interlocks import Interlocks
from common.control.record_file import RecordFile

TRY_AGAIN = 1.0  # [s] after what was decided could not be written


class Decisions:
    """What persons decided, in memory and in its file."""

    def __init__(self, file: RecordFile, log: logging.Logger) -> None:
        """Begin with what the file says."""
        self._file, self._log, self._writing = file, log, asyncio.Lock()
        self._written, problem = file.load()
        self._unkept = ""  # why what was decided last is not written
        self._trying: asyncio.Task[None] | None = None
        self.on_change: Callable[[], None] = lambda: None  # what is written, and what is not
        self.interlocks = Interlocks(self._written)
        if problem:
            log.error("%s; the robot counts as stopped: look at the cell, then `zencell task start`", problem)
        for interlock in self.interlocks.all:
            log.warning("%s: `zencell task %s` lets it go", interlock.description,
                        "start" if interlock.kind == "stopped" else "resume")

    async def keep(self) -> str:
        """What is wrong, once all that was decided so far is written; empty when it is."""
        async with self._writing:
            record = self.interlocks.record
            if record == self._written and not self._unkept:
                return ""
            before = self._unkept
            try:
                await asyncio.to_thread(self._file.save, record)
            except OSError as error:
                why = error.strerror or str(error)
                self._unkept = f"{self._file.path} cannot be written ({why}): this does not outlive the executor"
                self.interlocks.note_kept(self._written, why)
                if self._unkept != before:
                    self._log.error("%s; it is tried again every second", self._unkept)
                if self._trying is None:
                    self._trying = asyncio.create_task(self._try_again(), name="keep")
            else:
                self._written, self._unkept = record, ""
                self.interlocks.note_kept(record)
                if before:
                    self._log.warning("%s is written again: what was decided outlives the executor", self._file.path)
            if before or self._unkept:
                self.on_change()
            return self._unkept

    async def _try_again(self) -> None:
        while self._unkept:
            await asyncio.sleep(TRY_AGAIN)
            await self.keep()
        self._trying = None

    def close(self) -> None:
        """Try no longer."""
        if self._trying is not None:
            self._trying.cancel()
