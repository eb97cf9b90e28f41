"""Address of the operator's page: listening sockets, free ports, and the URL that is printed for the operator."""

from __future__ import annotations

import errno
import ipaddress
import os
import socket
import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from common.errors import ConfigError
from common.transport.credentials import secure_folder
from security.page_tokens import TOKEN_VARIABLE, VIEWER, make_token

if TYPE_CHECKING:
    from common.config import Cell

FIRST_PORT = 8080  # of the ports that are tried when none is configured
LAST_PORT = FIRST_PORT + 99
HIGHEST_PORT = 65535


@dataclass(frozen=True)
class PageAddress:
    """URL of a cell's page, and what the viewer service needs in order to serve it there."""

    url: str  # with the token if `plan_page` created one
    overrides: tuple[str, ...]
    environment: dict[str, str] = field(repr=False)
    port: FreePort | None = None  # reserved, if no port was configured


def plan_page(cell: Cell, host: str | None, port: str | None) -> PageAddress | None:
    """Return where the page of a cell will be served; None for a cell without a viewer.

    Args:
        cell: resolved, without the services that are switched off.
        host: of `--viewer-host`.
        port: of `--viewer-port`.

    Raises:
        ConfigError: the cell has no viewer, the port is in use, or an option is invalid.
    """
    entry = next((entry for entry in cell.services.values() if entry.kind == VIEWER), None)
    for option, value in (("--viewer-port", port), ("--viewer-host", host)):
        if value is not None and entry is None:
            raise ConfigError(option, value, "needs a cell with a viewer, and not --no-viewer")
    if entry is None:
        return None
    address = str(entry.parameters.get("host", "127.0.0.1")) if host is None else host
    configured = entry.parameters.get("port") if port is None else _parse_port(port)
    free = None
    if configured is None:
        free = find_free_port(address)
        number = free.number
    elif isinstance(configured, int):
        number = configured
        try:
            open_socket(address, number).close()
        except OSError as error:
            raise listen_error(error, address, number, "" if port is None else "--viewer-port") from None
    else:
        raise ConfigError(
            f"services.{entry.name}.port", configured, f"must be a whole number from 1 to {HIGHEST_PORT}")
    overrides = [] if host is None else [f"services.{entry.name}.host={address}"]
    url, environment = page_url(address, number), {}
    needs_no_token = is_loopback(address) and secure_folder() is None
    if not (needs_no_token or entry.parameters.get("token") or os.environ.get(TOKEN_VARIABLE)):
        environment[TOKEN_VARIABLE] = make_token()
        url += f"/?token={environment[TOKEN_VARIABLE]}"
    return PageAddress(url, (*overrides, f"services.{entry.name}.port={number}"), environment, free)


def _parse_port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= HIGHEST_PORT):
        raise ConfigError("--viewer-port", text, f"must be a whole number from 1 to {HIGHEST_PORT}")
    return int(text)


def page_url(host: str, port: int) -> str:
    """Return the URL of a page that listens at host and port."""
    address = parse_address(host)
    if address is not None and address.is_unspecified:
        host = _external_address()
    shown = f"[{host.strip('[]')}]" if ":" in host else host
    return f"http://{shown}:{port}"


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches a listening address; of all names, only localhost counts."""
    address = parse_address(host)
    return host.lower() == "localhost" if address is None else address.is_loopback


def parse_address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Return the IP address, with or without brackets; None for a name."""
    try:
        return ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return None


def _external_address() -> str:
    """Return an address of this machine that other machines may reach; 127.0.0.1 if it has none."""
    import psutil

    for addresses in psutil.net_if_addrs().values():
        for found in addresses:
            if found.family == socket.AF_INET and not is_loopback(found.address):
                return found.address
    return "127.0.0.1"


# --- sockets and ports ---


def open_socket(host: str, port: int) -> socket.socket:
    """Return a socket that listens at host and port (0: any free port).

    Raises:
        OSError: it cannot listen there.
    """
    if host.lower() == "localhost":
        host = "127.0.0.1"  # a browser that tries ::1 first falls back to it
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    family, _, _, _, address = found[0]
    dual_stack = family == socket.AF_INET6 and host == str(ipaddress.IPv6Address(0)) and socket.has_dualstack_ipv6()
    return socket.create_server(address[:2], family=family, dualstack_ipv6=dual_stack)


def listen_error(error: OSError, host: str, port: int, field: str = "") -> ConfigError:
    """Return the error to report when `open_socket` fails.

    Args:
        error: from `open_socket`.
        host: requested address.
        port: requested port.
        field: option that named the port; by default the parameter of the viewer.
    """
    if error.errno == errno.EADDRINUSE:
        from common.transport.router import port_holder

        return ConfigError(field or "services.viewer.port", port, f"is in use by {port_holder(port)}")
    if error.errno == errno.EACCES:
        return ConfigError(field or "services.viewer.port", port, "may not be used by this user; take 1024 or more")
    reason = error.strerror or str(error)
    return ConfigError("services.viewer.host", host, f"cannot listen at this address: {reason}")


class FreePort:
    """Reserves a port against other zencell processes for as long as this object exists."""

    def __init__(self, number: int) -> None:
        """Reserve the port.

        Raises:
            OSError: another process has reserved it.
        """
        self.number = number
        self._claim: socket.socket | None = None
        if sys.platform == "linux":  # an abstract name ends with its process; other systems may collide
            self._claim = socket.socket(socket.AF_UNIX)
            try:
                self._claim.bind(f"\0zencell-page-{number}")
            except OSError:
                self._claim.close()
                raise

    def __del__(self) -> None:
        """Release the port."""
        if self._claim is not None:
            self._claim.close()


def find_free_port(host: str) -> FreePort:
    """Return the first free port from 8080 on.

    Raises:
        ConfigError: all ports are in use, or the host is no address of this machine.
    """
    for number in range(FIRST_PORT, LAST_PORT + 1):
        try:
            port = FreePort(number)
            open_socket(host, number).close()
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise listen_error(error, host, number) from None
            continue
        return port
    raise ConfigError("--viewer-port", ..., f"ports {FIRST_PORT} to {LAST_PORT} are all in use; name another")
