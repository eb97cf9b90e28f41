"""A service with parameters that can be changed while it runs."""

import asyncio
from typing import Literal

from pydantic import Field

from common.config import Parameters, Tunable
from common.process.service import main
from common.transport.bus import Bus


class Config(Parameters):
    rate: Tunable[float] = Field(10.0, gt=0, le=100, description="turns each second [Hz]")
    mode: Tunable[Literal["fast", "slow"]] = "fast"
    spots: Tunable[list[tuple[float, float]]] = Field([], description="places [m]")
    file: str = Field("", description="read at the start")


async def run(bus: Bus, config: Parameters) -> None:
    await bus.ready()
    await asyncio.Event().wait()


if __name__ == "__main__":
    main(run, Config)
