"""Demonstrations by an operator: start, success, failure and discard by key, and a reset between episodes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, Literal

from common.client.cell import Cell
from common.errors import RequestFailed
from recording.sample import RecordingError
from tools.teleoperation.devices import Action
from tools.teleoperation.episodes import EpisodeFolder, EpisodeRecorder
from tools.teleoperation.operation import Operation

Reset = Literal["home", "hand"]
HELP = "n: start, y: success, x: failure, z: discard"


class Demonstrating(Operation):
    """Operates a cell and records episodes until as many as requested were not discarded."""

    def __init__(
        self, cell: Cell, recorder: EpisodeRecorder, folder: EpisodeFolder, *, episodes: int, task: str,
        seed: int | None, reset: Reset, say: Callable[[str], None], **operation: Any,
    ) -> None:
        """Record demonstrations.

        Args:
            cell: joined.
            recorder: of this cell.
            folder: of the episodes.
            episodes: how many to record.
            task: what they show.
            seed: of the cell, for the manifest.
            reset: after each episode the arm moves home with its gripper open and the simulated world is restored, or
                nothing moves.
            say: called with a line that stays.
            operation: arguments of `Operation`.
        """
        super().__init__(cell, **operation)
        self._recorder, self._folder, self._say = recorder, folder, say
        self._task, self._seed, self._reset = task, seed, reset
        self._count, self._done = episodes, 0
        self.failed: RecordingError | None = None

    def act(self, action: Action) -> None:
        """Carry out an action, also one of episodes."""
        recording = self._recorder.running
        match action:
            case "start" if not recording and self._done < self._count:
                self.start("recording", self._begin(), moves=False)
            case "success" | "failure" | "discard" if recording:
                self.start("end of the episode", self._end(action), moves=False)
            case "start" if recording:
                self.message = f"an episode is being recorded; {HELP}"
            case "success" | "failure" | "discard":
                self.message = "no episode is being recorded; n: start"
            case _:
                super().act(action)

    def describe(self) -> str:
        """Return the progress of the episodes."""
        state = f"RECORDING {self._recorder.progress}; y: success, x: failure, z: discard" if self._recorder.running \
            else "n: start"
        return f"episode {min(self._done + 1, self._count)} of {self._count}: {state}  "

    async def run(self) -> None:
        """Operate until all episodes are recorded, or the operator quits: an episode that is not ended is discarded.

        Raises:
            DeviceLost: a device was unplugged.
            RecordingError: the disk failed.
        """
        try:
            await super().run()
        finally:
            if self._recorder.running:
                await self._end_recording("discard")
        if self.failed is not None:
            raise self.failed

    async def _begin(self) -> None:
        try:
            await self._recorder.start(self._on_failure)
        except RecordingError as error:
            self._fail(error)

    def _on_failure(self) -> None:
        if self._recorder.running:
            self._spawn(self._end("discard"), moves=False)

    def _fail(self, error: RecordingError) -> None:
        self.failed = self.failed or error
        super().act("quit")

    async def _end(self, action: Action) -> None:
        await self._end_recording(action)
        if self.failed is None and self._done == self._count:
            super().act("quit")
        elif self.failed is None and self._reset == "home":
            self._spawn(self._reported(self._restore()), moves=True)

    async def _end_recording(self, action: Action) -> None:
        try:
            file, size = await self._recorder.stop()
            if action == "discard":
                file.unlink()
                self._say(f"episode discarded: {size}")
                return
            self._folder.add(file, success=action == "success", task=self._task, seed=self._seed)
        except RecordingError as error:
            self._fail(error)
            return
        self._done += 1
        self._say(f"episode {self._done} of {self._count}: {action}, {size}: {file}")

    async def _restore(self) -> None:
        """Open the gripper, move home, and restore the simulated world if there is one."""
        self.message = "reset ..."
        if (await self.cell.arm.description()).gripper:
            await self.cell.gripper.open()
        await self.go_home()
        with contextlib.suppress(RequestFailed):  # a real world
            await self.cell.world.reset()
