"""A service for tests: it logs a lot."""

import asyncio

from common.config import Parameters
from common.process.service import main
from common.transport.bus import Bus


class Config(Parameters):
    lines: float = 200.0  # [1/s]


async def run(bus: Bus, config: Config) -> None:
    await bus.ready()
    while True:
        bus.log.info("nothing %s", "in particular " * 60)
        await asyncio.sleep(1 / config.lines)


if __name__ == "__main__":
    main(run, Config)
