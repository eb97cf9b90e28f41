"""A tiny service with a chosen behaviour; first, middle and last are three of them."""

import asyncio
from pathlib import Path

from applications.pick_place.topics import PICK_PLACE_STATUS, PickPlaceStatus
from common.config import Parameters
from common.errors import ConfigError
from common.transport.bus import Bus


class Config(Parameters):
    behave: str = "well"
    placed: int = 0


def crash_once() -> None:
    if not (crashed := Path("crashed")).exists():
        crashed.touch()
        raise RuntimeError("a bug")


async def run(bus: Bus, config: Config) -> None:
    print("hello from", bus.service, flush=True)  # noqa: T201 -- tests wait for it
    if config.behave == "never ready":
        bus.log.info("waiting for the moon")
        await asyncio.Event().wait()
    if config.behave == "wrong":
        raise ConfigError("behave", config.behave, "cannot be done")
    if config.behave == "crash once":
        crash_once()
    status = bus.writer(PICK_PLACE_STATUS) if bus.service == "last" else None
    await bus.ready()
    if status is not None:
        state = {"done": "DONE", "error": "ERROR"}.get(config.behave, "IDLE")
        status.put(PickPlaceStatus(header=bus.header(), state=state, started=True, placed=config.placed, targets=2))
    await asyncio.Event().wait()
