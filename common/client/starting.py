"""Starting a cell for a program, in processes of its own, and ending it."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from common.client.joining import is_listening, joined, supervisor_status
from common.config import load_cell
from common.errors import RequestFailed, ZencellError
from common.supervision.launch import module_command, pythonpath, require_free_port
from common.transport.endpoint import MAX_DOMAIN, endpoint_of, parse_domain
from common.transport.router import PortInUse

START_TIMEOUT = 60.0  # [s] wall
POLL_PERIOD = 0.1  # [s] between two checks of its state
END_TIMEOUT = 15.0  # [s] after which it is killed
ATTEMPTS, IN_USE = 3, "is in use by"  # domains to try; text in the output of `up` about a domain in use
LAST_LINES = 5  # of the output, in the error of a failed start


class NotStarted(ZencellError):
    """The cell did not come up."""

    exit_code = 1

    def __init__(self, cell: str, why: str) -> None:
        super().__init__(f"{cell} did not come up: {why}")


class StartedCell:
    """A cell that runs inside `async with`, with its `name` and `domain`."""

    def __init__(
        self, cell: str, *, speed: float, world: str | None, seed: int | None, overrides: Sequence[str], viewer: bool,
        domain: int | str | None,
    ) -> None:
        """Describe the cell to start; see `Cell.start`."""
        self._domain = domain
        self.name, self.domain = "", -1
        self._arguments = ["up", cell, "--until-stdin-ends", "--speed", f"{speed:g}"]
        self._arguments += [] if viewer else ["--no-viewer"]
        self._arguments += [] if world is None else ["--world", world]
        self._arguments += [] if seed is None else ["--seed", str(seed)]
        self._arguments += [part for value in overrides for part in ("--set", value)]
        self._loaded = (cell, tuple(overrides), world, seed)
        self._process: subprocess.Popen[bytes] | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._log = Path()

    async def __aenter__(self) -> StartedCell:
        cell, overrides, world, seed = self._loaded
        loaded = await asyncio.to_thread(load_cell, cell, overrides, world=world, seed=seed)  # raises on bad input
        self.name = loaded.name
        for left in reversed(range(ATTEMPTS)):
            self.domain = free_domain() if self._domain is None else parse_domain(self._domain)
            try:
                return await self._bring_up()
            except NotStarted as error:  # another program may have taken the same free domain
                if IN_USE not in str(error) or self._domain is not None or not left:
                    raise
        raise AssertionError

    async def _bring_up(self) -> StartedCell:
        self._folder = tempfile.TemporaryDirectory(prefix="zencell-")
        self._log = Path(self._folder.name, "log")
        self._process = await asyncio.to_thread(self._spawn)
        try:
            async with asyncio.timeout(START_TIMEOUT):
                await self._until_up()
        except BaseException as error:
            output = self._last_lines()
            await self._end()
            if isinstance(error, TimeoutError):
                raise NotStarted(self.name, f"not within {START_TIMEOUT:g} s; {output}") from None
            raise
        return self

    def _spawn(self) -> subprocess.Popen[bytes]:
        with self._log.open("wb") as out:
            return subprocess.Popen(
                [*module_command("zencell"), *self._arguments, "--domain", str(self.domain)],
                stdin=subprocess.PIPE, stdout=out, stderr=subprocess.STDOUT, start_new_session=True,
                env={**os.environ, "PYTHONPATH": pythonpath()})

    async def _until_up(self) -> None:
        """Return when all services are ready.

        Raises:
            NotStarted: the process has ended instead.
        """
        while not await self._is_up():
            assert self._process is not None
            if self._process.poll() is not None:
                raise NotStarted(self.name, self._last_lines())
            await asyncio.sleep(POLL_PERIOD)

    async def _is_up(self) -> bool:
        if not await asyncio.to_thread(is_listening, endpoint_of(self.domain)):
            return False
        try:
            async with joined(self.name, domain=self.domain) as bus:
                status = await supervisor_status(bus)
        except RequestFailed:
            return False
        return status is not None and all(service.state == "ready" for service in status.services)

    def _last_lines(self) -> str:
        lines = [line for line in self._log.read_text(errors="replace").splitlines() if line.strip()]
        return " | ".join(lines[-LAST_LINES:]) or "it wrote nothing"

    async def __aexit__(self, *_: object) -> None:
        await self._end()

    async def _end(self) -> None:
        process, folder = self._process, self._folder
        self._process = self._folder = None
        if process is not None:
            await asyncio.shield(_end_process(process))
        if folder is not None:
            folder.cleanup()


async def _end_process(process: subprocess.Popen[bytes]) -> None:
    """End a process without a thread: none can be started while the interpreter exits."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    if process.stdin is not None:
        process.stdin.close()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(END_TIMEOUT):
            while process.poll() is None:  # noqa: ASYNC110 - there is no event for it
                await asyncio.sleep(POLL_PERIOD / 2)
    if process.poll() is None:
        process.kill()
        process.wait()


def free_domain() -> int:
    """Return a random domain whose port is free.

    Raises:
        NotStarted: all are in use.
    """
    for domain in random.SystemRandom().sample(range(MAX_DOMAIN + 1), MAX_DOMAIN + 1):
        try:
            require_free_port(endpoint_of(domain))
        except PortInUse:
            continue
        return domain
    raise NotStarted("the cell", "all domains are in use")
