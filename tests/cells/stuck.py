"""A service for tests whose event loop is stuck once its parameter is set."""

import asyncio
import time

from common.config import Parameters, Tunable
from common.process.service import main
from common.transport.bus import Bus


class Config(Parameters):
    stuck: Tunable[bool] = False


async def run(bus: Bus, config: Config) -> None:
    def retuned() -> None:
        if config.stuck:
            time.sleep(1000)

    bus.on_parameters(retuned)
    await bus.ready()
    await asyncio.Event().wait()


if __name__ == "__main__":
    main(run, Config)
