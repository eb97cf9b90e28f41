"""Selecting an object on the page starts its trace once the path is known, unless the arm is stopped before."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from applications.outlining.page import choose
from applications.outlining.topics import (
    CONTOUR_PATH,
    OUTLINE_SELECT,
    OUTLINE_STATUS,
    OutlinePoints,
    OutlineSelect,
    OutlineSelection,
    OutlineStatus,
)
from common import messages as m
from common import topics
from common.config import Members
from common.errors import Refused, RequestFailed
from common.transport.local import LocalNetwork
from page.console import Console
from page.feeds import Feeds

STOP_BEFORE, STOP_SINCE = (m.Interlock(kind="stopped", by="page", since=since) for since in (3, 8))


class Cell:
    """Task, executor and detector, as far as the page has to do with them."""

    def __init__(self) -> None:
        network = LocalNetwork()
        self.bus, page = network.bus("cell"), network.bus("viewer")
        self.motion = self.bus.writer(topics.MOTION_STATUS)
        self.status, self.path = self.bus.writer(OUTLINE_STATUS), self.bus.writer(CONTOUR_PATH)
        self.commands: list[tuple[str, int | None]] = []
        self.executor_answers, self.labels = True, ["Object_0"]
        self.bus.serve(OUTLINE_SELECT, self._select)
        self.bus.serve(topics.TASK_COMMAND, self._command)
        self.bus.serve(topics.MOTION_STOP, self._stop)
        feeds = Feeds(page, [topics.MOTION_STATUS, OUTLINE_STATUS, CONTOUR_PATH])
        self.console = Console(page, Members(services=[], task="task"), feeds, [OUTLINE_SELECT])

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(10):
            while not condition():  # noqa: ASYNC110
                await asyncio.sleep(0)

    async def _select(self, _wanted: OutlineSelect) -> OutlineSelection:
        return OutlineSelection(index=0, label=self.labels.pop(0))

    async def _command(self, command: m.TaskCommand) -> m.TaskStatus:
        self.commands.append((command.command, command.acknowledged))
        return m.TaskStatus()

    async def _stop(self, _request: m.StopRequest) -> m.MotionStatus:
        if not self.executor_answers:
            raise Refused("busy", "too much is asked")
        return m.MotionStatus(interlocks=[STOP_SINCE])


@pytest.fixture
async def cell() -> Cell:
    cell = Cell()
    await cell.bus.ready()
    cell.status.put(OutlineStatus())
    cell.motion.put(m.MotionStatus(interlocks=[STOP_BEFORE]))
    await cell.until(lambda: None not in map(cell.console.latest, (topics.MOTION_STATUS, OUTLINE_STATUS)))
    return cell


async def chosen(cell: Cell, meanwhile: Any) -> list[tuple[str, int | None]]:
    """Return the task commands after a selection, an event, and the arrival of the path."""
    choosing = asyncio.create_task(choose(cell.console, OutlineSelect()))
    for _ in range(50):
        await asyncio.sleep(0)
    await meanwhile()
    cell.path.put(OutlinePoints(object="Object_0"))
    await choosing
    return cell.commands


async def test_selection_releases_an_earlier_stop(cell: Cell) -> None:
    async def nothing() -> None:
        pass

    assert await chosen(cell, nothing) == [("start", 3)]


@pytest.mark.parametrize("by", ["the page", "the page, and the arm does not answer", "the command line"])
async def test_stop_after_the_selection_stays(cell: Cell, by: str) -> None:
    notices: list[str] = []
    cell.console.notify = lambda line, _kind="bad": notices.append(line)
    cell.executor_answers = by == "the page"

    async def stop() -> None:
        if by == "the command line":
            cell.motion.put(m.MotionStatus(interlocks=[STOP_BEFORE, STOP_SINCE]))
            await cell.until(lambda: STOP_SINCE in getattr(cell.console.latest(topics.MOTION_STATUS), "interlocks", ()))
            return
        try:
            await cell.console.stop()
        except RequestFailed:
            assert not cell.executor_answers

    assert [command for command, _ in await chosen(cell, stop) if command != "stop"] == []
    assert notices[-1].startswith("Object_0 is chosen, but not traced")


async def test_only_the_second_of_two_selections_is_traced_once(cell: Cell) -> None:
    notices: list[str] = []
    cell.console.notify = lambda line, _kind="bad": notices.append(line)
    cell.labels = ["Object_0", "Object_1"]
    first = asyncio.create_task(choose(cell.console, OutlineSelect()))
    await cell.until(lambda: cell.labels == ["Object_1"])
    second = asyncio.create_task(choose(cell.console, OutlineSelect()))
    await cell.until(lambda: not cell.labels)
    cell.path.put(OutlinePoints(object="Object_1"))
    await second
    cell.path.put(OutlinePoints(object="Object_0"))  # as the next picture counts
    await first
    assert cell.commands == [("start", 3)]
    assert notices[-1] == "Object_1 is chosen"
