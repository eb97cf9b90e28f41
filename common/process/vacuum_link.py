"""Connects suction cups that are driven by I/O with the I/O service of the cell."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Sequence

from common import topics
from common.config import RobotConfig
from common.control.vacuum import VacuumCup
from common.errors import ZencellError
from common.messages import IoSignal, IoState
from common.transport.bus import Bus

ANSWER = 1.0  # [s] wall time for the answer to a request to set an output
RETRY = 0.1  # [s] wall time after a refusal: interlocks and owner may reach the I/O service later than the executor


class VacuumLink:
    """Cups of one process: sets their outputs, and publishes what the simulated world determines."""

    def __init__(self, bus: Bus, robots: Iterable[RobotConfig], simulated: bool) -> None:
        """Declare what the cups of these robots need."""
        self._bus = bus
        self._used = any(robot.gripper is not None and robot.gripper.vacuum is not None for robot in robots)
        if self._used:
            self._states, self._set = bus.reader(topics.IO_STATE), bus.client(topics.IO_SET)
            self._sensed = bus.writer(topics.IO_SENSED) if simulated else None
        self._published: list[IoSignal] = []
        self._calls: dict[VacuumCup, asyncio.Task[None]] = {}

    def update(self, cups: Sequence[VacuumCup]) -> None:
        """Pass newest states to the cups, send their orders, and publish what has changed; once a cycle."""
        if not cups:
            return
        for cup in cups:
            cup.state = self._states.latest if self._set.available else None
            if cup.order is not None and (cup not in self._calls or self._calls[cup].done()):
                self._calls[cup] = asyncio.create_task(self._order(cup), name="set the output of a cup")
        sensed = [signal for cup in cups for signal in cup.sensed]
        if self._sensed is not None and sensed != self._published:
            self._published = sensed
            self._sensed.put(IoState(header=self._bus.header(), signals=sensed))

    async def _order(self, cup: VacuumCup) -> None:
        order = cup.order
        assert order is not None
        try:
            await self._set.call(order.model_copy(update={"header": self._bus.header()}), ANSWER)
        except ZencellError as error:
            if cup.order is order:
                cup.refusal = str(error)
            await asyncio.sleep(RETRY)
        else:
            if cup.order is order:
                cup.order = None

    async def close(self) -> None:
        """Cancel requests without an answer."""
        for call in self._calls.values():
            call.cancel()
        await asyncio.gather(*self._calls.values(), return_exceptions=True)
