"""Reads and sets the digital and analog inputs and outputs that the cell file names under `io`: docs/io.md."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeVar

from pydantic import Field

from common import topics
from common.config import Cups, Io, Tunable
from common.control.signal_server import SignalServer
from common.errors import ConfigError
from common.hardware.backends import has_simulated_world
from common.hardware.signals import WorldSignals, load_io
from common.messages import Message
from common.process.service import main
from common.process.timing import Reopening
from common.transport.bus import Bus
from common.transport.reader import Reader

MAX_TURNS = 100.0  # per second of wall time
M = TypeVar("M", bound=Message)


class Config(Reopening):
    """Rates and timeouts; the signals are those of the cell."""

    io: Io = Io()
    cups: Cups = Cups()
    rate: Tunable[float] = Field(20.0, ge=0.5, le=100, description="all signals are read so often in cell time [Hz]")
    answer_timeout: Tunable[float] = Field(
        1.0, ge=0.05, le=60, description="a backend that takes longer to answer is lost [s, wall time]"
    )
    request_timeout: Tunable[float] = Field(
        2.0, ge=0.1, le=60, description="a request that was decided longer ago is refused [s, wall time]"
    )
    clock_tolerance: Tunable[float] = Field(
        0.2, ge=0.01, le=10, description="a request from this far in the future is refused, too [s, wall time]"
    )
    reopen_at_most: Tunable[float] = Field(2.0, gt=0, le=600, description="longest of these waits [s]")


async def run(bus: Bus, config: Config) -> None:
    """Read all signals in turns, and set outputs on request."""
    if not config.io.signals:
        raise ConfigError("io.signals", ..., f"is missing: the service {bus.service} needs named signals")
    connection = load_io(config.io, bus.clock.now)
    simulated = [name for robot in config.cups.robots if has_simulated_world(robot) for name in robot.cup_signals]
    world = connection if simulated and isinstance(connection, WorldSignals) else None
    sensed = bus.reader(topics.IO_SENSED) if world is not None else None
    if world is not None:
        world.expect(simulated)
    motion, owner = bus.reader(topics.MOTION_STATUS), bus.reader(topics.MOTION_OWNER)
    out = bus.writer(topics.IO_STATE)
    server = SignalServer(config.io, connection, config, bus.clock, bus.log, out.put)
    bus.serve(topics.IO_SET, server.set)
    await bus.ready()
    out.put(server.state)

    async def take(reader: Reader[M], use: Callable[[M], None]) -> None:
        async for message in reader:
            use(message)

    async with asyncio.TaskGroup() as group:
        group.create_task(take(motion, server.set_motion))
        group.create_task(take(owner, server.set_owner))
        if sensed is not None and world is not None:
            group.create_task(take(sensed, world.sense))
        await server.run(lambda: 1 / bus.clock.wall_rate(config.rate, MAX_TURNS))


if __name__ == "__main__":
    main(run, Config)
