"""What the operator's page costs its process while the arm moves: processor and memory without a page, with some.

`python -m benchmarks.viewer` needs about a minute. Pages are connections that take everything and draw nothing: what a
browser needs is not measured.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import socket
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import msgspec
import psutil
import viser
from websockets import Subprotocol
from websockets.asyncio.client import connect

from common import topics
from tests.harness import RunningCell, until

PAGES = (0, 1, 10)
SECONDS = 12.0  # measured for each number of pages
SETTLED = 4.0  # [s] after pages were opened: they were sent the meshes
EYE = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [1.0, 2.0, 3.0], "fov": 1.0, "near": 0.1,
    "far": 100.0, "image_height": 600, "image_width": 800, "look_at": [0.0, 0.0, 0.5], "up_direction": [0.0, 0.0, 1.0],
}


class Page:
    """A connection that takes everything."""

    def __init__(self) -> None:
        """Nothing has come yet."""
        self.bytes = 0

    @asynccontextmanager
    async def opened(self, port: int) -> AsyncIterator[None]:
        """The page is open inside the block."""
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        url = f"ws://127.0.0.1:{port}/"
        async with connect(url, proxy=None, max_size=None, subprotocols=[protocol]) as socket_:

            async def take() -> None:
                async for data in socket_:
                    self.bytes += len(data)

            await socket_.send(msgspec.msgpack.encode(EYE))
            taking = asyncio.create_task(take())
            try:
                yield
            finally:
                taking.cancel()


def free_port() -> int:
    """Return a free port of this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


async def share_of(process: psutil.Process, port: int, pages: int) -> str:
    """A row of the table: what the process needs with so many pages."""
    async with AsyncExitStack() as stack:
        opened = [Page() for _ in range(pages)]
        for page in opened:
            await stack.enter_async_context(page.opened(port))
        await asyncio.sleep(SETTLED)
        first = sum(page.bytes for page in opened)
        cpu, began = process.cpu_times(), time.monotonic()
        await asyncio.sleep(SECONDS)
        now, seconds = process.cpu_times(), time.monotonic() - began
        rate = (sum(page.bytes for page in opened) - first) / seconds / max(pages, 1)
    share = (now.user + now.system - cpu.user - cpu.system) / seconds
    memory = process.memory_full_info().pss / 1e6
    opening = first / max(pages, 1)
    return f"| {pages} | {share:.1%} | {memory:.0f} | {rate / 1e3:.0f} | {opening / 1e6:.1f} |"


async def measure(cell: str, folder: Path) -> None:
    """Bring a cell up and print a table."""
    port = free_port()
    with RunningCell(folder, "up", cell, "--viewer-port", str(port)) as running:
        async with running.listen() as bus:
            await until(bus.reader(topics.MOTION_STATUS), lambda status: status.progress > 0)
        process = running.processes()["viewer"]
        print("| pages | of one core | PSS [MB] | kB/s a page | MB when it opens |\n|---|---|---|---|---|")
        for pages in PAGES:
            print(await share_of(process, port, pages), flush=True)
        running.interrupt()
        await running.ended(15.0)


def main() -> int:
    """Read the options and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.viewer", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("cell", nargs="?", default="panda")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="zencell-viewer-"))
    print(f"{options.cell}; logs are in {folder}; load {os.getloadavg()[0]:.1f} before it begins")
    asyncio.run(measure(options.cell, folder))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
