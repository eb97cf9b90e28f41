"""A cell without certificates is open to its own machine only."""

import asyncio
from pathlib import Path

import psutil
import pytest

from common import topics
from common.messages import SupervisorStatus
from common.transport.endpoint import port_of
from tests.harness import RunningCell, until
from tests.security.raw_client import free_port
from tests.security.secured_cell import sockets_of

pytestmark = [pytest.mark.cell, pytest.mark.timeout(300)]


def all_ready(status: SupervisorStatus) -> bool:
    return len(status.services) > 2 and all(service.state == "ready" for service in status.services)


def test_open_cell_listens_on_the_loopback_address_only_and_does_not_scout(tmp_path: Path) -> None:
    async def ready() -> None:
        async with cell.listen() as bus:
            await until(bus.reader(topics.SUPERVISOR_STATUS), all_ready, timeout=120)

    page = free_port()
    small = ("--only", "robot_state_publisher,viewer")  # a service that only connects, and the page
    with RunningCell(tmp_path, "up", "panda", *small, "--viewer-port", str(page)) as cell:
        asyncio.run(ready())
        processes = cell.processes()
        assert set(processes) == {"router", "robot_state_publisher", "viewer"}
        listening, datagrams = sockets_of({**processes, "supervisor": psutil.Process(cell.process.pid)})
        assert listening == {("router", "127.0.0.1", port_of(cell.domain)), ("viewer", "127.0.0.1", page)}
        assert datagrams == set()
        cell.interrupt()
        assert asyncio.run(cell.ended(60)) == 0
        assert "WARNING router" not in cell.text
