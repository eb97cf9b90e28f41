"""Logs a fingerprint of its token, and serves no page."""

import asyncio
import hashlib
import os

from common.config import Parameters
from common.process.service import main
from common.transport.bus import Bus
from security.page_tokens import TOKEN_VARIABLE


class Config(Parameters):
    host: str = ""
    port: int = 0


async def run(bus: Bus, config: Config) -> None:
    bus.log.info("token %s", hashlib.sha256(os.environ.get(TOKEN_VARIABLE, "").encode()).hexdigest())
    await bus.ready()
    await asyncio.Event().wait()


if __name__ == "__main__":
    main(run, Config)
