"""Conveyor belts in the Move tab: speed, encoder and light barrier, and a switch for each."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import viser

from common import topics
from common.config import check
from common.messages import ConveyorSet
from page.console import Console
from page.markup import Html, block, press, row, span, table, text


class BeltPanel:
    """A table of all belts. The rules for a start are those of motion; a stop is open to every operator."""

    def __init__(self, gui: viser.GuiApi, console: Console, belts: Collection[str]) -> None:
        """Build the panel; `belts` are the names of the cell's conveyors."""
        self._console, self._belts, self._html = console, belts, Html(gui)
        for name in belts:
            for running in (True, False):
                console.on_press(f"belt:{name}:{running}", self._switch(name, running),
                                 f"{'start' if running else 'stop'} {name}")

    def show(self, disabled: str) -> None:
        """Update values and switches; `disabled` is why no operator may start a belt now."""
        available = self._console.is_available(topics.CONVEYOR_SET)
        state = self._console.latest(topics.CONVEYOR_STATE) if available else None
        problem, rows = "" if state is not None else "the drive of the belts does not respond", []
        for name in self._belts:
            belt = state.find(name) if state is not None else None
            value = "?" if belt is None else f"{belt.speed:.3f} m/s, at {belt.position:.2f} m"
            barrier = "light barrier blocked" if belt is not None and belt.blocked else ""
            runs = belt is not None and belt.running
            blocked = problem or ("" if runs else disabled)
            switch = press("Stop" if runs else "Start", f"belt:{name}:{not runs}", blocked, arm=True)
            rows.append(row(text(name), span(value, "bad" if problem else "big"), barrier, switch, belt=name))
        self._html.set(block(table((), rows) + (span(problem, "bad") if problem else ""), "belts", belts=len(rows)))

    def _switch(self, name: str, running: bool) -> Callable[[], Any]:
        async def switch() -> None:
            request = check(ConveyorSet, {
                "header": self._console.header(), "acknowledged": self._console.acknowledged, "name": name,
                "owner": self._console.permissions.client_name, "running": running}, "conveyor")
            await self._console.call(topics.CONVEYOR_SET, request)
            self._console.notify(f"{name}: {'on' if running else 'off'}", "good")

        return switch
