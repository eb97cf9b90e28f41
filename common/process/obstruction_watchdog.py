"""Hold the arm while an object in the newest planning scene obstructs the rest of the running motion."""

from __future__ import annotations

import asyncio
from typing import Any, Literal

from common import topics
from common.config import RobotConfig
from common.errors import RemoteError, RequestFailed
from common.messages import FollowedRequest, HoldRequest, MotionStatus, PlanningScene
from common.planning.scene_monitor import NotMonitored, SceneMonitor
from common.transport.bus import Bus
from common.transport.reader import Reader

HOLDER: Literal["scene_monitor"] = "scene_monitor"
REQUEST_TIMEOUT = 0.2  # [s] wall; the request is repeated after that
RETRY_DELAY = 0.05  # [s] wall


class ObstructionWatchdog:
    """Checks the running motion on every scene message, and requests a hold from the executor or releases it.

    It computes on the event loop, for about a millisecond if an object has moved; planning runs in threads.
    """

    monitor: SceneMonitor  # set by `load`

    def __init__(self, bus: Bus, scenes: Reader[PlanningScene]) -> None:
        self._bus, self._scenes, self._motion = bus, scenes, bus.reader(topics.MOTION_STATUS)
        self._hold, self._followed = bus.client(topics.MOTION_HOLD), bus.client(topics.MOTION_FOLLOWED)
        self._changed = asyncio.Event()
        self._answer: MotionStatus | None = None  # to the newest hold request

    async def load(self, robot: RobotConfig, padding: float) -> None:
        """Load the robot; new perceived objects get `padding` [m] more distance."""
        self.monitor = await asyncio.to_thread(SceneMonitor, robot, padding)

    async def run(self) -> None:
        """Check until cancelled."""
        async with asyncio.TaskGroup() as group:
            for reader in (self._scenes, self._motion):
                group.create_task(self._trigger_on(reader))
            while True:
                await self._changed.wait()
                self._changed.clear()
                try:
                    await self._check()
                except NotMonitored as error:
                    self._bus.log.warning("the running motion is not checked for obstructions: %s", error)
                except RequestFailed as error:
                    self._bus.log.warning("%s", error)
                    group.create_task(self._retry())

    async def _trigger_on(self, reader: Reader[Any]) -> None:
        async for _ in reader:
            self._changed.set()

    async def _retry(self) -> None:
        await asyncio.sleep(RETRY_DELAY)
        self._changed.set()

    async def _check(self) -> None:
        status, scene = self._motion.latest, self._scenes.latest
        if status is not None and self._answer is not None and self._answer.header.stamp > status.header.stamp:
            status = self._answer
        if status is None or scene is None or status.state != "active" or not status.id:
            self.monitor.unfollow()
            return
        if status.id != self.monitor.goal:
            await self._follow(status)
        problem, held = self.monitor.find_obstruction(scene, status.progress), HOLDER in status.held_by
        if bool(problem) == held:
            return
        request = HoldRequest(hold=bool(problem), reason=problem, by=HOLDER, goal=status.id)
        self._answer = await self._hold.call(request, REQUEST_TIMEOUT)
        if problem and HOLDER not in self._answer.held_by:
            self._changed.set()  # the motion ended meanwhile: check the one that runs now
        elif problem:
            self._bus.log.warning("the arm is held: %s", problem)
        else:
            self._bus.log.info("the hold is released: nothing obstructs the motion any more")

    async def _follow(self, status: MotionStatus) -> None:
        if self.monitor.has_plan(status.plan):
            self.monitor.follow(status.id, status.plan)
            return
        try:
            execution = await self._followed.call(FollowedRequest(id=status.id), REQUEST_TIMEOUT)
        except RemoteError as error:  # the motion has ended meanwhile
            self.monitor.unfollow(status.id)
            raise NotMonitored(str(error)) from None
        self.monitor.follow(status.id, execution.plan, execution.trajectory)
