"""The coordinate frames of a cell: a tree that follows tf and tf_static."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Coroutine
from typing import Any

from common import topics
from common.client.subscriptions import TIMEOUT, NothingReceived
from common.errors import ZencellError
from common.robot.transform_tree import MAX_FRAMES, TransformTree
from common.transport.bus import Bus

GATHER_TIME = 0.5  # [s] in which every moving frame is published at least once


class Frames:
    """The transform tree of a cell, updated inside `async with`."""

    def __init__(self, bus: Bus) -> None:
        """Subscribe to tf and tf_static."""
        self.tree = TransformTree()
        self._last_seen: dict[str, float] = {}  # of each moving frame [s, loop]
        self._cell = bus.cell
        self._changed = asyncio.Event()
        self._moving, self._fixed = bus.reader(topics.TF), bus.reader(topics.TF_STATIC)
        self._following: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Frames:
        followed: list[Coroutine[Any, Any, None]] = [self._follow_moving(), self._follow_fixed()]
        self._following = [asyncio.create_task(each) for each in followed]
        return self

    async def __aexit__(self, *_: object) -> None:
        for task in self._following:
            task.cancel()
        await asyncio.gather(*self._following, return_exceptions=True)

    @property
    def moving(self) -> frozenset[str]:
        """Frames that were received on tf."""
        return frozenset(self._last_seen)

    async def _follow_moving(self) -> None:
        async for message in self._moving:
            self.tree.update(message)
            self._last_seen |= dict.fromkeys((each.child_frame_id for each in message.transforms), _now())
            if len(self._last_seen) > 2 * MAX_FRAMES:
                self._last_seen = {
                    name: at for name, at in self._last_seen.items() if self.tree.parent_of(name) is not None}
            self._changed.set()

    async def _follow_fixed(self) -> None:
        async for message in self._fixed:
            self.tree.update(message)
            self._changed.set()

    async def until_known(self, target: str, source: str) -> None:
        """Return when the pose of `source` in `target` is known.

        Raises:
            NothingReceived: no transform was received.
            UnknownName, NotConnected: the pose is still unknown after `TIMEOUT`.
        """
        try:
            async with asyncio.timeout(TIMEOUT):
                while not self._known(target, source):
                    await self._wait_for_transform()
        except TimeoutError:
            self._require_some()
            self.tree.path(target, source)

    async def until_moved(self, target: str, source: str) -> None:
        """Return when all moving frames between two frames were received again; at once if none moves.

        Raises:
            NothingReceived: some were not: their last pose may be outdated.
        """
        known = {name: self.tree.stamp_of(name) for name in self._moving_between(target, source)}

        def outdated() -> list[str]:
            return [name for name, stamp in known.items() if self.tree.stamp_of(name) <= stamp]

        try:
            async with asyncio.timeout(TIMEOUT):
                while outdated():
                    await self._wait_for_transform()
        except TimeoutError:
            raise self._silent(outdated()) from None

    def require_recent(self, target: str, source: str) -> None:
        """Check that all moving frames between two frames were received within `TIMEOUT`.

        Raises:
            NothingReceived: some were not: their last pose may be outdated.
        """
        oldest = _now() - TIMEOUT
        if old := [name for name in self._moving_between(target, source) if self._last_seen[name] < oldest]:
            raise self._silent(old)

    async def gather(self) -> None:
        """Return when every frame that is published regularly is in the tree.

        Raises:
            NothingReceived: no transform was received.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(TIMEOUT):
                while not self.tree.frames:
                    await self._wait_for_transform()
        self._require_some()
        await asyncio.sleep(GATHER_TIME)

    async def _wait_for_transform(self) -> None:
        self._changed.clear()
        await self._changed.wait()

    def _moving_between(self, target: str, source: str) -> list[str]:
        return [name for name in self.tree.path(target, source) if name in self._last_seen]

    def _silent(self, frames: list[str]) -> NothingReceived:
        return NothingReceived(f"{self._cell}/tf of {', '.join(frames)}")

    def _known(self, target: str, source: str) -> bool:
        try:
            self.tree.path(target, source)
        except ZencellError:
            return False
        return True

    def _require_some(self) -> None:
        if not self.tree.frames:
            raise NothingReceived(f"{self._cell}/tf and {self._cell}/tf_static")


def _now() -> float:
    return asyncio.get_running_loop().time()
