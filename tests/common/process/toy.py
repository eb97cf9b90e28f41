"""A service that tests run as a process: it shows every result of a request and every way to end."""

import asyncio
import time
from typing import Literal

from applications.pick_place.topics import PICK_PLACE_STATUS, PickPlaceStatus
from common import topics
from common.config import Parameters
from common.errors import ConfigError, Refused
from common.messages import TaskCommand, TaskStatus
from common.process.service import main
from common.transport.bus import Bus


class Config(Parameters):
    mode: Literal["serve", "busy", "stubborn", "crash", "bad_config", "end", "stuck", "native"] = "serve"
    placed: int = 7


def hang() -> None:
    time.sleep(1000)


async def run(bus: Bus, config: Config) -> None:
    status = bus.writer(PICK_PLACE_STATUS)

    async def handle(request: TaskCommand) -> TaskStatus:
        if request.command == "pause":
            bus.log.info("holding")
            await asyncio.Event().wait()
        if request.command == "stop":
            raise Refused("busy", "not now")
        if request.command == "resume":
            raise RuntimeError("the handler has a bug")
        return TaskStatus(stage=str(config.placed))

    bus.serve(topics.TASK_COMMAND, handle)
    await bus.ready()
    status.put(PickPlaceStatus(state="GRASPING", placed=config.placed))
    bus.log.info("is ready")
    if config.mode == "busy":
        await asyncio.to_thread(lambda: [None for _ in iter(int, 1)])
    if config.mode == "stuck":
        hang()
    if config.mode == "native":
        await asyncio.to_thread(time.sleep, 2.0)
        bus.log.info("woke up")
    if config.mode == "stubborn":
        while True:
            try:
                await asyncio.sleep(1000)
            except asyncio.CancelledError:
                bus.log.info("ignores the cancellation")
    if config.mode == "crash":
        raise RuntimeError("the service has a bug")
    if config.mode == "bad_config":
        raise ConfigError("services.toy.mode", config.mode, "cannot be used")
    if config.mode != "end":
        await asyncio.Event().wait()


if __name__ == "__main__":
    main(run, Config)
