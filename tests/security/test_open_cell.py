"""A cell without certificates is open to its own machine only."""

import asyncio
from pathlib import Path

import pytest

from common.transport.endpoint import port_of
from tests.domains import free_port
from tests.harness import RunningCell
from tests.security.secured_cell import all_processes, ready, sockets_of

pytestmark = [pytest.mark.cell, pytest.mark.timeout(300)]


def test_open_cell_listens_on_the_loopback_address_only_and_does_not_scout(tmp_path: Path) -> None:
    page = free_port()
    small = ("--only", "robot_state_publisher,viewer")  # a service that only connects, and the page
    with RunningCell(tmp_path, "up", "panda", *small, "--viewer-port", str(page)) as cell:
        asyncio.run(ready(cell, 3))
        processes = all_processes(cell)
        listening, datagrams = sockets_of(processes)
        assert set(processes) == {"router", "robot_state_publisher", "viewer", "supervisor"}
        assert listening == {("router", "127.0.0.1", port_of(cell.domain)), ("viewer", "127.0.0.1", page)}
        assert datagrams == set()
        cell.interrupt()
        assert asyncio.run(cell.ended(60)) == 0
        assert "WARNING router" not in cell.text
