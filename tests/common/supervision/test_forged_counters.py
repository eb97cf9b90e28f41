"""A service that is frozen is not kept alive by what another says in its name."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

from common import topics
from common.config import load_cell
from common.messages import ServiceCounters, ServiceStatus
from common.supervision import operation
from common.transport.codec import encode
from common.transport.local import LocalNetwork

SPACING = 0.02  # [s] between two messages of the one that forges


async def test_counters_under_the_key_of_another_are_no_sign_of_life(monkeypatch) -> None:
    monkeypatch.setattr(operation, "PERIOD", SPACING)
    net, cell = LocalNetwork(), load_cell("panda", ["watchdogs.silence=0.5"])
    killed: asyncio.Queue[str] = asyncio.Queue()
    names = ("camera_simulator", "vision_detector")
    supervisor = SimpleNamespace(
        kept=[ServiceStatus(name=name, state="ready", pid=number) for number, name in enumerate(names, 1)],
        stopped=(), waited={},
        kill=lambda name, reason: killed.put_nowait(name),
    )
    camera = net.bus("camera_simulator", cell=cell.name)
    own = camera.raw_publisher(f"{cell.name}/counters/camera_simulator", "", reliable=True)

    async def forge() -> None:
        while True:
            for name in names:
                own.put(encode(ServiceCounters(service=name)), b"")
                await asyncio.sleep(SPACING)

    bus = net.bus("supervisor", cell=cell.name)
    watching = [asyncio.create_task(each) for each in (operation._kill_frozen(bus, cell, supervisor), forge())]
    try:
        async with asyncio.timeout(20):
            assert await killed.get() == "vision_detector"
        assert bus.counters().invalid[topics.COUNTERS.key] > 0
    finally:
        for task in watching:
            task.cancel()
        await asyncio.gather(*watching, return_exceptions=True)
