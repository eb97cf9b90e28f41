"""What a task is to know when it is started again: a small file beside it, for as long as the cell is up."""

from __future__ import annotations

import asyncio
from typing import Any

from common.atomic_file import AtomicFile, Unreadable, runtime_folder
from common.tasks.engine import Task
from common.transport.bus import Bus

SAVE_AGAIN = 2.0  # [s] wall after a memory could not be written


class Memory:
    """A file in which the memory of a task outlives it, where there is a folder for that."""

    def __init__(self, bus: Bus, task: Task[Any]) -> None:
        """Keep nothing yet."""
        self._bus, self._task = bus, task
        self._kept = task.memory
        self._file: AtomicFile[Any] | None = None
        self._saving: asyncio.Task[None] | None = None

    async def begin(self) -> None:
        """Have the task remember what was kept, if it has a memory at all."""
        folder = runtime_folder()
        if self._kept is None or folder is None:
            return
        await self._bus.acquire_keys()  # before, another process of this name may still write the file
        self._file = AtomicFile(folder / f"{self._bus.cell}.{self._bus.service}.json", type(self._kept))
        try:
            kept = self._file.find()
        except Unreadable as error:  # the next that is kept takes its place
            self._bus.log.warning("what was done before is not known: %s", error)
            return
        if kept is not None:
            self._kept = kept
            self._task.remember(kept)

    def keep(self, group: asyncio.TaskGroup) -> None:
        """Write down what has changed, beside everything else; what changes meanwhile has its turn after it."""
        now = self._task.memory
        if self._file is None or now is None or now is self._kept or (self._saving and not self._saving.done()):
            return
        self._saving = group.create_task(self._save(self._file), name="memory")

    async def _save(self, file: AtomicFile[Any]) -> None:
        """Write the newest, as often as it takes: until then a task that is started again knows what was before."""
        told = False
        while True:
            memory = self._task.memory
            assert memory is not None
            try:
                await asyncio.to_thread(file.save, memory)
            except OSError as error:
                if not told:
                    self._bus.log.warning("%s cannot be written (%s): until it can, a task that is started again does "
                                          "not know what was done since", file.path, error.strerror or error)
                told = True
                await asyncio.sleep(SAVE_AGAIN)
                continue
            self._kept = memory
            return
