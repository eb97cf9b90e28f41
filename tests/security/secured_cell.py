"""A running cell with certificates, a page with a token, and a recording of everything."""

import asyncio
import socket
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from common import messages as m
from common import topics
from common.transport.credentials import credentials_of
from tests.domains import free_port
from tests.harness import RunningCell, ask, command_line, environment, until
from tests.security.raw_client import RawClient

TOKEN = "the-token-of-this-page-0123456789"
SERVICES = 9
# A process that ends was then ended by an attack.
NO_WATCHDOGS = ("--set", "watchdogs.silence=0", "--set", "watchdogs.loop=0")
Socket = tuple[str, str, int]


@dataclass
class Secured:
    """A running cell, and the folder of its certificates."""

    cell: RunningCell
    folder: Path
    page: int
    recording: Path

    def client(self, name: str) -> RawClient:
        return RawClient(self.cell.endpoint, credentials_of(name, self.folder))

    @property
    def port(self) -> int:
        return int(self.cell.endpoint.rpartition(":")[2])

    @property
    def variables(self) -> dict[str, str]:
        return {"ZENCELL_SECURE": str(self.folder), "ZENCELL_DOMAIN": str(self.cell.domain)}

    def tool(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a zencell command within this process."""
        return ask(self.cell.folder, *arguments, environment=self.variables)

    def process(self, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
        """Run a zencell command as a process to its end, with further environment variables."""
        return subprocess.run(command_line(*arguments), env={**environment(), **self.variables, **variables},
                              cwd=self.cell.folder, capture_output=True, text=True, timeout=60, check=False)

    @property
    def processes(self) -> dict[str, psutil.Process]:
        return all_processes(self.cell)


def all_processes(cell: RunningCell) -> dict[str, psutil.Process]:
    return {**cell.processes(), "supervisor": psutil.Process(cell.process.pid)}


def sockets_of(processes: Mapping[str, psutil.Process]) -> tuple[set[Socket], set[Socket]]:
    """Return the listening and the datagram sockets by process, address and port."""
    listening, datagrams = set(), set()
    for name, process in processes.items():
        for found in process.net_connections("inet"):
            if found.type == socket.SOCK_DGRAM:
                datagrams.add((name, *found.laddr))
            elif found.status == psutil.CONN_LISTEN:
                listening.add((name, *found.laddr))
    return listening, datagrams


async def ready(cell: RunningCell, services: int) -> None:
    """Return when the cell has that many services or more, and all are ready."""

    def all_ready(status: m.SupervisorStatus) -> bool:
        return len(status.services) >= services and all(service.state == "ready" for service in status.services)

    async with cell.listen() as bus:
        await until(bus.reader(topics.SUPERVISOR_STATUS), all_ready, timeout=120)


@contextmanager
def running_secured(certificates: Path, folder: Path) -> Iterator[Secured]:
    """Run a cell at speed 1 whose task waits, recorded from its start."""
    page, recording = free_port(), folder / "all.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ZENCELL_SECURE", str(certificates))  # for the listeners in this process
        with RunningCell(
            folder, "up", "panda", "--secure", str(certificates), "--set", "autostart=false", *NO_WATCHDOGS,
            "--viewer-port", str(page), "--record", str(recording), secrets={"ZENCELL_VIEWER_TOKEN": TOKEN},
        ) as cell:
            asyncio.run(ready(cell, SERVICES + 1))
            yield Secured(cell, certificates, page, recording)
