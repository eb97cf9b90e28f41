"""Listens to a cell for the summary of a run and for the table that a person watches."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

from common import topics
from common.application import all_topics
from common.applications.outlining.topics import CONTOUR_PATH, OUTLINE_STATUS
from common.applications.pick_place.topics import PICK_PLACE_STATUS, REJECTED_TARGETS, SCENE_BALLS, VALIDATED_TARGETS
from common.config import RobotConfig
from common.messages import Message, TaskStatus
from common.sources import monotonic
from common.supervision.rates import Rates
from common.supervision.summary import Summary, is_settled, progress_line

if TYPE_CHECKING:
    from common.transport.bus import Bus, Reader

SETTLE_TIMEOUT = 2.0  # [s] for what still falls after the task ended
ENDED = ("DONE", "ERROR")

M = TypeVar("M", bound=Message)

# On which topic a task says how far it is, where it is not pick_place_status.
STATUS_OF_TASK = {"contour_tracer": OUTLINE_STATUS}


class Collector:
    """Feeds a `Summary` and `Rates` from a cell's topics."""

    def __init__(
        self, bus: Bus, task: str, summary: Summary, started_at: float, on_progress: Callable[[str], None],
        robot: RobotConfig | None = None,
    ) -> None:
        """Declare what is listened to.

        Args:
            bus: of the cell.
            task: the service whose status says when the run has ended.
            summary: is fed.
            started_at: when this process began [s, monotonic].
            on_progress: called with a line whenever the task got further.
            robot: whose tool tip is followed in a cell that outlines objects.
        """
        self.summary = summary
        self.rates = Rates(all_topics())
        self.task_status: TaskStatus | None = None
        self.ended = asyncio.Event()
        self._clock = bus.clock
        self._started_at = started_at
        self._on_progress = on_progress
        self._progress = ""
        self._status: Reader[Any] = bus.reader(STATUS_OF_TASK.get(task, PICK_PLACE_STATUS))
        self._motion = bus.reader(topics.MOTION_STATUS)
        self._targets = bus.reader(VALIDATED_TARGETS)
        self._rejected = bus.reader(REJECTED_TARGETS)
        self._balls = bus.reader(SCENE_BALLS)
        self._counters = bus.reader(topics.COUNTERS)
        self._noted: list[tuple[Reader[Any], Callable[[Any], None]]] = []
        if robot is not None and STATUS_OF_TASK.get(task) is OUTLINE_STATUS:
            from common.supervision.traced import Traced

            traced = summary.traced = Traced(robot)
            self._noted = [
                (bus.reader(topics.JOINT_STATES), traced.on_joints),
                (bus.reader(CONTOUR_PATH), traced.on_path),
                (bus.reader(topics.SCENE_OBJECTS), traced.on_truth),
            ]

    async def run(self) -> None:
        """Listen until cancelled."""
        following = [
            asyncio.create_task(follow)
            for follow in (
                self._follow_status(), self._follow_motion(), self._follow_targets(), self._follow_rejections(),
                self._follow_counters(), *(_follow(reader, note) for reader, note in self._noted),
            )
        ]
        try:
            await asyncio.gather(*following)
        finally:
            for task in following:
                task.cancel()

    async def settle(self) -> None:
        """Wait until nothing is on its way any more, for a short time at most, and read the truth."""
        deadline = monotonic() + SETTLE_TIMEOUT
        try:
            async with asyncio.timeout(SETTLE_TIMEOUT):
                while not is_settled(self._balls.latest):
                    await self._balls.next()
        except TimeoutError:
            pass
        # The task may say DONE a moment before the world says that the last ball has come to rest.
        await asyncio.sleep(min(0.2, max(0.0, deadline - monotonic())))
        self.read_truth()

    def read_truth(self) -> None:
        """Take note of where everything really lies now."""
        self.summary.truth = self._balls.latest

    async def _follow_status(self) -> None:
        async for status in self._status:
            self.task_status = status
            self.summary.on_status(status)
            if (line := progress_line(status)) != self._progress:
                self._progress = line
                self._on_progress(line)
            if status.state in ENDED:
                self.ended.set()

    async def _follow_motion(self) -> None:
        async for status in self._motion:
            self.summary.on_motion(status, monotonic() - self._started_at)

    async def _follow_targets(self) -> None:
        async for targets in self._targets:
            self.summary.on_latency(self._clock.age_ms(targets.header.stamp))

    async def _follow_rejections(self) -> None:
        async for rejections in self._rejected:
            self.summary.rejected.add(rejections.rejected)

    async def _follow_counters(self) -> None:
        async for counters in self._counters:
            self.rates.update(counters, monotonic())


async def _follow(reader: Reader[M], note: Callable[[M], None]) -> None:
    async for message in reader:
        note(message)
