"""Where the operator's page of a cell is to be served, found before its service is started."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from common.errors import ConfigError
from common.transport.credentials import secure_folder
from page.access import (
    TOKEN_VARIABLE,
    VIEWER,
    FreePort,
    address_of,
    first_free_port,
    is_loopback,
    make_token,
    open_socket,
    refusal,
)

if TYPE_CHECKING:
    from common.config import Cell

HIGHEST_PORT = 65535


@dataclass(frozen=True)
class Page:
    """Where the page of a cell will be, and what its service has to be told for that."""

    address: str  # for the person, with the token if that was made here
    overrides: tuple[str, ...]
    environment: dict[str, str] = field(repr=False)
    port: FreePort | None = None  # kept for it, if none was named


def page_of(cell: Cell, host: str | None, port: str | None) -> Page | None:
    """Where the page of a cell is to be served; None for a cell without one.

    Args:
        cell: resolved, without the services that are not wanted.
        host: of `--viewer-host`.
        port: of `--viewer-port`.

    Raises:
        ConfigError: there is no page, the port is taken, or one of the options cannot be used.
    """
    entry = next((entry for entry in cell.services.values() if entry.kind == VIEWER), None)
    for option, value in (("--viewer-port", port), ("--viewer-host", host)):
        if value is not None and entry is None:
            raise ConfigError(option, value, "needs a cell with a viewer, and not --no-viewer")
    if entry is None:
        return None
    at = str(entry.parameters.get("host", "127.0.0.1")) if host is None else host
    wanted = entry.parameters.get("port") if port is None else _port(port)
    free = None
    if wanted is None:
        free = first_free_port(at)
        number = free.number
    elif isinstance(wanted, int):
        number = wanted
        try:
            open_socket(at, number).close()
        except OSError as error:
            raise refusal(error, at, number, "" if port is None else "--viewer-port") from None
    else:
        raise ConfigError(f"services.{entry.name}.port", wanted, f"must be a whole number from 1 to {HIGHEST_PORT}")
    overrides = [] if host is None else [f"services.{entry.name}.host={at}"]
    address, environment = address_of(at, number), {}
    near = is_loopback(at) and secure_folder() is None
    if not (near or entry.parameters.get("token") or os.environ.get(TOKEN_VARIABLE)):
        environment[TOKEN_VARIABLE] = make_token()
        address += f"/?token={environment[TOKEN_VARIABLE]}"
    return Page(address, (*overrides, f"services.{entry.name}.port={number}"), environment, free)


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= HIGHEST_PORT):
        raise ConfigError("--viewer-port", text, f"must be a whole number from 1 to {HIGHEST_PORT}")
    return int(text)
