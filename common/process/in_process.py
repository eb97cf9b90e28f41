"""Services inside this process on a network without ports, for tests and for cells in one process."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from typing import TypeVar

from common.clock import Clock
from common.config import Parameters
from common.process.log import BusLog
from common.process.service import serve_parameters
from common.transport.bus import Bus
from common.transport.local import LocalNetwork

C = TypeVar("C")


@asynccontextmanager
async def running_service(
    network: LocalNetwork, run: Callable[[Bus, C], Awaitable[None]], config: C, *, name: str = "service",
    cell: str = "test", clock: Clock | None = None, topics: Mapping[str, str] | None = None,
) -> AsyncIterator[Bus]:
    """Run a service inside the block, which starts when it is ready; its crash ends the block and is raised there."""
    session = network.session()
    bus = Bus(session, service=name, cell=cell, clock=clock or Clock(), topics=topics)
    to_topic = BusLog(bus)
    bus.log.addHandler(to_topic)
    bus.log.setLevel(logging.INFO)
    crash: BaseException | None = None
    body = asyncio.current_task()
    inside = False

    async def run_body() -> None:
        await run(bus, config)

    async def live() -> None:
        nonlocal crash
        try:
            if isinstance(config, Parameters):
                serve_parameters(bus, config)
            await bus.run(run_body())
        except asyncio.CancelledError:
            raise
        except BaseException as error:
            crash = error
            if inside and body is not None:
                body.cancel()

    task = asyncio.create_task(live(), name=f"running {name}")
    is_ready = asyncio.create_task(bus.ready_event.wait())
    try:
        await asyncio.wait({task, is_ready}, return_when=asyncio.FIRST_COMPLETED)
        if not is_ready.done() and crash is None:
            raise RuntimeError(f"{name} ended before it was ready")
        if crash is None:
            inside = True
            yield bus
    except asyncio.CancelledError:
        if crash is None:
            raise
        if body is not None:
            body.uncancel()
    finally:
        inside = False
        is_ready.cancel()
        task.cancel()
        await asyncio.wait({task})
        bus.log.removeHandler(to_topic)
        await bus.close()
        session.close()
        if crash is not None:
            raise crash
