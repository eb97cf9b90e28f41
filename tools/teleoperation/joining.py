"""The cell to operate: the running one, or one that is started for it without its task."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import AsyncIterator, Callable, Sequence

from common.client.cell import Cell
from common.client.joining import is_listening
from common.config import Cell as CellConfig
from common.errors import ConfigError
from common.transport.endpoint import CONNECT_VARIABLE, endpoint_of, parse_domain

VIEWER = "viewer"  # service of the operator's page


@contextlib.asynccontextmanager
async def joined_or_started(
    cell: str, config: CellConfig, overrides: Sequence[str], world: str | None, seed: int | None, domain: str | None,
    connect: str | None, say: Callable[[str], None],
) -> AsyncIterator[Cell]:
    """Yield the cell if its router is running, or start it with its page; the task waits for a start.

    Args:
        cell: name or path.
        config: of the cell.
        overrides: values of the cell, for one that is started.
        world: of one that is started.
        seed: of one that is started.
        domain: as for --domain.
        connect: as for --connect.
        say: called with lines for the operator.

    Raises:
        ConfigError: no router is running at the endpoint of --connect.
        RequestFailed: a router is running, but not this cell.
        NotStarted: it cannot be started.
    """
    endpoint = endpoint_of(domain, connect)
    if is_listening(endpoint):
        client = Cell(config.name, domain=domain, connect=connect)
    elif connect is not None or os.environ.get(CONNECT_VARIABLE):
        raise ConfigError("--connect", endpoint, "has no router: start the cell first")
    else:
        number = None if domain is None else parse_domain(domain)
        client = _started(cell, config, list(overrides), world, seed, number, say)
    async with client:
        yield client


def _started(
    cell: str, config: CellConfig, overrides: list[str], world: str | None, seed: int | None, domain: int | None,
    say: Callable[[str], None],
) -> Cell:
    """Return the cell, to be started, and say where its page will be."""
    page = next((each for each in config.services.values() if each.kind == VIEWER), None)
    say(f"starting {config.name} ...")
    if page is not None:
        port = page.parameters.get("port")
        if port is None:
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                port = free.getsockname()[1]
            overrides.append(f"services.{page.name}.port={port}")
        say(f"to see it: http://127.0.0.1:{port}")
    return Cell.start(cell, world=world, seed=seed, overrides=overrides, viewer=page is not None, domain=domain)
