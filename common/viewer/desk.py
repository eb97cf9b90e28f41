"""Brings what a person does on the page from viser's threads to the loop of the service, where it is done in order."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable, Coroutine
from typing import Any, Protocol, TypeVar

import viser

from common.errors import ZencellError
from common.viewer.words import problem

Act = Callable[[], Coroutine[Any, Any, None] | None]
V = TypeVar("V")
V_co = TypeVar("V_co", covariant=True)

log = logging.getLogger(__name__)


class Field(Protocol[V_co]):
    """Something on the page that has a value, as mypy sees it."""

    @property
    def value(self) -> V_co:
        """What it shows."""


def assign(handle: Field[V], value: V) -> None:
    """Show a value in a field of the page, in every browser."""
    handle.value = value  # type: ignore[misc]  # it has a setter, behind a decorator


def can_be_given(handle: object, value: object) -> bool:
    """Whether a browser can give that value: whoever has the page open may send what no field of it takes."""
    if isinstance(value, float) and not math.isfinite(value):
        return False
    return not isinstance(handle, viser.GuiDropdownHandle) or value in handle.options


class Desk:
    """Takes orders on any thread and carries them out on the loop: plain calls in order, coroutines side by side.

    What goes wrong in a way that a person can understand is told; anything else is a bug and ends `run`.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, tell: Callable[[str], None]) -> None:
        """Make a desk.

        Args:
            loop: of the service.
            tell: called on the loop with a line about what could not be done.
        """
        self._loop = loop
        self._tell = tell
        self._orders: asyncio.Queue[Act] = asyncio.Queue()

    def put(self, act: Act) -> None:
        """Have something done; from any thread. A loop that has ended does nothing more."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._orders.put_nowait, act)

    async def run(self) -> None:
        """Carry out orders until cancelled."""
        async with asyncio.TaskGroup() as group:
            while True:
                act = await self._orders.get()
                try:
                    doing = act()
                except ZencellError as error:
                    self._tell(problem(error))
                    continue
                if doing is not None:
                    group.create_task(self._see_through(doing))

    async def _see_through(self, doing: Coroutine[Any, Any, None]) -> None:
        try:
            await doing
        except ZencellError as error:
            self._tell(problem(error))

    # Callbacks of viser that are coroutines run on its loop at once; others would wait for a thread.

    def on_click(self, button: viser.GuiButtonHandle, act: Act) -> None:
        """Do something whenever a button is clicked."""

        async def clicked(_event: object) -> None:
            self.put(act)

        button.on_click(clicked)

    def on_choice(
        self, buttons: viser.GuiButtonGroupHandle, act: Callable[[str], Coroutine[Any, Any, None] | None]
    ) -> None:
        """Do something with the text of the button that was clicked in a group."""

        async def clicked(event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
            chosen = event.target.value
            if chosen in event.target.options:
                self.put(lambda: act(chosen))

        buttons.on_click(clicked)

    def on_change(
        self, handle: viser.GuiInputHandle[V], act: Callable[[V], Coroutine[Any, Any, None] | None]
    ) -> None:
        """Do something with the value that a person gave; not with one that the service sets itself."""

        async def changed(event: viser.GuiEvent[viser.GuiInputHandle[V]]) -> None:
            value = event.target.value
            if event.client_id is not None and can_be_given(event.target, value):
                self.put(lambda: act(value))

        handle.on_update(changed)
