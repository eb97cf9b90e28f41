"""The arms of a cell with several: each as a cell of its own, with its arm, gripper, task and planning scene."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Generic, TypeVar

from common import topics
from common.client.arguments import require_text
from common.client.subscriptions import NothingReceived, Part
from common.errors import ConfigError, NoResponder, UnknownName
from common.transport.bus import Bus

A = TypeVar("A")
SUFFIX = f"/{topics.MOTION_EXECUTE.key}"  # of the key that every arm's executor serves


async def arm_names(bus: Bus) -> list[str]:
    """Return the names of the running arms of a cell, sorted; none in a cell with one robot."""
    return sorted(owner.key.removesuffix(SUFFIX) for owner in await bus.owners() if owner.key.endswith(SUFFIX))


@asynccontextmanager
async def chosen_arm(bus: Bus, arm: str) -> AsyncIterator[Bus]:
    """Yield the bus of an arm of the cell, or for no name that of the cell.

    Raises:
        UnknownName: there is no such arm; with the choices.
        ConfigError: no name is given, and a request within the block needs one.
    """
    if arm and arm not in (names := await arm_names(bus)):
        raise UnknownName("arm", arm, names)
    try:
        yield bus.of_arm(arm)
    except (NoResponder, NothingReceived):
        if arm or not (names := await arm_names(bus)):
            raise
        raise ConfigError("--arm", ..., f"is missing: {bus.cell} has the arms {', '.join(names)}") from None


class Arms(Part, Generic[A]):
    """The arms by name: `cell.arms["left"].move("home")`; `async for name in cell.arms` yields their names."""

    def __init__(self, bus: Bus, arm_of: Callable[[str], A]) -> None:
        """The arms of a cell, each of which `arm_of` returns."""
        self._bus, self._arm_of = bus, arm_of
        self._known: dict[str, A] = {}

    def __getitem__(self, name: str) -> A:
        require_text("arm", name)
        if name not in self._known:
            self._known[name] = self._arm_of(name)
        return self._known[name]

    async def __aiter__(self) -> AsyncIterator[str]:
        for name in await arm_names(self._bus):
            yield name
