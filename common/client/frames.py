"""The frames of a cell: the tree that they make, and where one is in another, as figures and in words."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncGenerator, Coroutine
from typing import Any

from common import topics
from common.client.subscriptions import PATIENCE, NothingReceived
from common.errors import ZencellError
from common.robot.transform_tree import MAX_FRAMES, TransformTree
from common.robot.transforms import matrix_to_quaternion, matrix_to_rpy
from common.transport.bus import Bus

GATHER = 0.5  # [s] in which every moving frame surely comes once


class Frames:
    """The tree that tf and tf_static make, kept up to date inside an `async with`."""

    def __init__(self, bus: Bus) -> None:
        """Subscribe to both."""
        self.tree = TransformTree()
        self._told: dict[str, float] = {}  # of what moves, when it was told of last [s, loop]
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
        """What was told of as moving."""
        return frozenset(self._told)

    async def _follow_moving(self) -> None:
        async for message in self._moving:
            self.tree.update(message)
            self._told |= dict.fromkeys((each.child_frame_id for each in message.transforms), _now())
            if len(self._told) > 2 * MAX_FRAMES:
                self._told = {name: at for name, at in self._told.items() if self.tree.parent_of(name) is not None}
            self._changed.set()

    async def _follow_fixed(self) -> None:
        async for message in self._fixed:
            self.tree.update(message)
            self._changed.set()

    async def until_known(self, target: str, source: str) -> None:
        """Return when the pose of source in target is known.

        Raises:
            NothingReceived: nothing came at all.
            UnknownName, NotConnected: it still is not after a while.
        """
        try:
            async with asyncio.timeout(PATIENCE):
                while not self._known(target, source):
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            self._require_some()
            self.tree.path(target, source)

    async def until_moved(self, target: str, source: str) -> None:
        """Return when all that moves between two frames was told anew; at once where nothing does.

        Raises:
            NothingReceived: some of it was not: where it was last is not where it is.
        """
        known = {name: self.tree.stamp_of(name) for name in self._moving_between(target, source)}

        def old() -> list[str]:
            return [name for name, stamp in known.items() if self.tree.stamp_of(name) <= stamp]

        try:
            async with asyncio.timeout(PATIENCE):
                while old():
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            raise self._silence(old()) from None

    def require_told(self, target: str, source: str) -> None:
        """Return when all that moves between two frames was told of lately.

        Raises:
            NothingReceived: some of it was not: where it was last is not where it is.
        """
        if old := [name for name in self._moving_between(target, source) if self._told[name] < _now() - PATIENCE]:
            raise self._silence(old)

    def _moving_between(self, target: str, source: str) -> list[str]:
        return [name for name in self.tree.path(target, source) if name in self._told]

    def _silence(self, frames: list[str]) -> NothingReceived:
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

    async def gather(self) -> None:
        """Return when every frame that comes regularly is in the tree.

        Raises:
            NothingReceived: nothing came at all.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(PATIENCE):
                while not self.tree.frames:
                    self._changed.clear()
                    await self._changed.wait()
        self._require_some()
        await asyncio.sleep(GATHER)


async def poses(bus: Bus, target: str, source: str, period: float) -> AsyncGenerator[dict[str, Any], None]:
    """The figures of the pose of source in target, once it is known, each period [s].

    Raises:
        NothingReceived: it does not become known, or is told of no more.
        UnknownName, NotConnected: it does not become known.
    """
    async with Frames(bus) as frames:
        await frames.until_known(target, source)
        while True:
            frames.require_told(target, source)
            yield pose_figures(frames.tree, target, source)
            await asyncio.sleep(period)


def _now() -> float:
    return asyncio.get_running_loop().time()


def pose_figures(tree: TransformTree, target: str, source: str) -> dict[str, Any]:
    """The pose of source in target as JSON can hold it: position [m], quaternion x, y, z, w, rpy [deg], stamp [ns]."""
    T = tree.pose(target, source)
    # Of all that the pose is made of, what changed last.
    stamp = max(map(tree.stamp_of, tree.path(target, source)))
    return {
        "target": target, "source": source, "stamp": stamp,
        "position": [round(float(value), 6) + 0.0 for value in T[:3, 3]],
        "quaternion": [round(value, 6) + 0.0 for value in matrix_to_quaternion(T[:3, :3])],
        "rpy_degrees": [round(math.degrees(value), 3) + 0.0 for value in matrix_to_rpy(T[:3, :3])],
    }


def describe(figures: dict[str, Any]) -> str:
    """The pose in one line for people."""

    def listed(values: list[float], digits: int) -> str:
        return " ".join(f"{round(value, digits) + 0.0:.{digits}f}" for value in values)

    return (
        f"{figures['source']} in {figures['target']}: position {listed(figures['position'], 4)} m, "
        f"quaternion {listed(figures['quaternion'], 4)}, rpy {listed(figures['rpy_degrees'], 2)} deg"
    )
