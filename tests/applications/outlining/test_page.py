"""Selecting an object on the page starts its trace once the path is known, unless the arm is stopped before."""

import asyncio

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
    """Task, executor and detector, as far as the page uses them."""

    def __init__(self):
        network = LocalNetwork()
        self.bus, page = network.bus("cell"), network.bus("viewer")
        self.motion = self.bus.writer(topics.MOTION_STATUS)
        self.status, self.path = self.bus.writer(OUTLINE_STATUS), self.bus.writer(CONTOUR_PATH)
        self.commands, self.notices = [], []
        self.executor_answers, self.labels = True, ["Object_0"]
        self.bus.serve(OUTLINE_SELECT, self._select)
        self.bus.serve(topics.TASK_COMMAND, self._command)
        self.bus.serve(topics.MOTION_STOP, self._stop)
        feeds = Feeds(page, [topics.MOTION_STATUS, OUTLINE_STATUS, CONTOUR_PATH])
        self.console = Console(page, Members(services=[], task="task"), feeds, [OUTLINE_SELECT])
        self.console.notify = lambda line, _kind="bad": self.notices.append(line)

    async def until(self, condition):
        async with asyncio.timeout(10):
            while not condition():  # noqa: ASYNC110
                await asyncio.sleep(0)

    async def _select(self, _wanted):
        return OutlineSelection(index=0, label=self.labels.pop(0))

    async def _command(self, command):
        self.commands.append((command.command, command.acknowledged))
        return m.TaskStatus()

    async def _stop(self, _request):
        if not self.executor_answers:
            raise Refused("busy", "too many requests")
        return m.MotionStatus(interlocks=[STOP_SINCE])

    async def start_choosing(self):
        """Select an object; its path is not known yet."""
        count = len(self.labels)
        choosing = asyncio.create_task(choose(self.console, OutlineSelect()))
        await self.until(lambda: len(self.labels) < count)
        for _ in range(50):
            await asyncio.sleep(0)
        return choosing


@pytest.fixture
async def cell():
    cell = Cell()
    await cell.bus.ready()
    cell.status.put(OutlineStatus())
    cell.motion.put(m.MotionStatus(interlocks=[STOP_BEFORE]))
    await cell.until(lambda: None not in map(cell.console.latest, (topics.MOTION_STATUS, OUTLINE_STATUS)))
    return cell


async def test_selection_releases_an_earlier_stop(cell):
    choosing = await cell.start_choosing()
    cell.path.put(OutlinePoints(object="Object_0"))
    await choosing
    assert cell.commands == [("start", 3)]


@pytest.mark.parametrize("by", ["the page", "the page without an answer", "the command line"])
async def test_stop_after_the_selection_stays(cell, by):
    choosing = await cell.start_choosing()
    cell.executor_answers = by == "the page"
    if by == "the command line":
        cell.motion.put(m.MotionStatus(interlocks=[STOP_BEFORE, STOP_SINCE]))
        await cell.until(lambda: STOP_SINCE in getattr(cell.console.latest(topics.MOTION_STATUS), "interlocks", ()))
    else:
        try:
            await cell.console.stop()
        except RequestFailed:
            assert not cell.executor_answers
    cell.path.put(OutlinePoints(object="Object_0"))
    await choosing
    assert [command for command, _ in cell.commands if command != "stop"] == []
    assert cell.notices[-1].startswith("Object_0 is chosen, but not traced")


async def test_only_the_second_of_two_selections_is_traced_once(cell):
    cell.labels = ["Object_0", "Object_1"]
    first, second = await cell.start_choosing(), await cell.start_choosing()
    cell.path.put(OutlinePoints(object="Object_1"))
    await second
    cell.path.put(OutlinePoints(object="Object_0"))  # as the next image numbers it
    await first
    assert cell.commands == [("start", 3)] and cell.notices[-1] == "Object_1 is chosen"
