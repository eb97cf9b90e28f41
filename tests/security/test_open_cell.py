"""A cell without certificates is open to its own machine only, unless --listen says otherwise, with a warning."""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path

import psutil
import pytest

from common import topics
from common.messages import SupervisorStatus
from common.transport.endpoint import port_of
from tests.harness import RunningCell, until
from tests.security.raw_client import RawClient
from tests.security.test_routers import free_port

pytestmark = [pytest.mark.cell, pytest.mark.timeout(300)]

SMALL = ("--only", "robot_state_publisher,viewer")  # a service that only connects, and the page
Socket = tuple[str, str, int]


def all_ready(status: SupervisorStatus) -> bool:
    return len(status.services) > 2 and all(service.state == "ready" for service in status.services)


async def until_ready(cell: RunningCell) -> None:
    async with cell.listen() as bus:
        await until(bus.reader(topics.SUPERVISOR_STATUS), all_ready, timeout=120)


def sockets_of(cell: RunningCell) -> tuple[set[Socket], set[Socket]]:
    """Return the listening and the datagram sockets of a cell, by process, address and port."""
    listening, datagrams = set(), set()
    for name, process in {**cell.processes(), "supervisor": psutil.Process(cell.process.pid)}.items():
        for found in process.net_connections("inet"):
            if found.type == socket.SOCK_DGRAM:
                datagrams.add((name, *found.laddr))
            elif found.status == psutil.CONN_LISTEN:
                listening.add((name, *found.laddr))
    return listening, datagrams


def warnings_in(cell: RunningCell) -> list[str]:
    return [line for line in cell.text.splitlines() if "WARNING router" in line]


def test_open_cell_listens_on_the_loopback_address_only_and_does_not_scout(tmp_path: Path) -> None:
    page = free_port()
    with RunningCell(tmp_path, "up", "panda", *SMALL, "--viewer-port", str(page)) as cell:
        asyncio.run(until_ready(cell))
        listening, datagrams = sockets_of(cell)
        assert set(cell.processes()) == {"router", "robot_state_publisher", "viewer"}
        assert listening == {("router", "127.0.0.1", port_of(cell.domain)), ("viewer", "127.0.0.1", page)}
        assert datagrams == set()
        cell.interrupt()
        assert asyncio.run(cell.ended(60)) == 0
        assert warnings_in(cell) == []


@pytest.mark.slow
def test_open_cell_that_listens_on_all_addresses_warns_with_the_remedy(tmp_path: Path) -> None:
    endpoint = f"tcp/0.0.0.0:{free_port()}"
    with RunningCell(tmp_path, "up", "panda", "--only", "robot_state_publisher,vision_detector", "--listen",
                     endpoint) as cell:
        asyncio.run(until_ready(cell))
        with RawClient(endpoint.replace("0.0.0.0", "127.0.0.1"), None) as client:
            assert client.connected
        listening, datagrams = sockets_of(cell)
        assert listening == {("router", "127.0.0.1", port_of(cell.domain)),
                             ("router", "0.0.0.0", int(endpoint.rpartition(":")[2]))}
        assert datagrams == set()
        cell.interrupt()
        assert asyncio.run(cell.ended(60)) == 0
        (warning,) = warnings_in(cell)  # at the end: the router accepts clients before it logs its endpoints
        assert f"every client that reaches {endpoint} can read and command every cell of this router" in warning
        assert "`zencell secure init DIR`, then --secure DIR" in warning
