"""Scene keepers of both cells, for tests: as if another sensor saw what its application does not look for.

They publish what the keeper of the cell says, with what is in `SEEN`, as often as a camera would.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, cast

from common import topics
from common.messages import CollisionObject, PlanningScene
from common.transport.bus import Bus
from common.transport.writer import Writer

RATE = 15.0  # [Hz]
SEEN: dict[str, CollisionObject] = {}
SAID: dict[tuple[str, ...], float] = {}  # when a scene with these was published first [s]


class _More:
    """The bus of a keeper whose scenes have more in them."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._scenes: Writer[PlanningScene] | None = None
        self._newest: PlanningScene | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)

    def writer(self, topic: Any) -> Any:
        if topic is not topics.PLANNING_SCENE:
            return self._bus.writer(topic)
        self._scenes = self._bus.writer(topic)
        return self

    def put(self, scene: PlanningScene) -> None:
        assert self._scenes is not None
        self._newest = scene
        SAID.setdefault(tuple(SEEN), asyncio.get_running_loop().time())
        self._scenes.put(scene.model_copy(update={"objects": [*scene.objects, *SEEN.values()]}))

    async def ready(self) -> None:
        await self._bus.ready()

    async def see(self) -> None:
        published: list[CollisionObject] = []
        while True:
            await asyncio.sleep(1 / RATE)
            if self._newest is not None and published != [*SEEN.values()]:
                published = [*SEEN.values()]
                self.put(self._newest)


def seeing(keeper: Callable[[Bus, Any], Coroutine[Any, Any, None]]) -> Callable[[Bus, Any], Coroutine[Any, Any, None]]:
    """The keeper, with what is in `SEEN`."""

    async def run(bus: Bus, config: Any) -> None:
        more = _More(bus)
        async with asyncio.TaskGroup() as group:
            seen = group.create_task(more.see())
            await keeper(cast(Bus, more), config)
            seen.cancel()

    return run
