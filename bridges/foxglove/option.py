"""The option `--foxglove PORT`: what it adds to a cell, checked before any process starts."""

from __future__ import annotations

import errno
import importlib.util
import socket
from collections.abc import Sequence

from common.config import find_file, read_yaml
from common.errors import ConfigError
from common.transport.credentials import secure_folder

SERVICE = "foxglove_bridge"
HIGHEST_PORT = 65535
EXTRA = "needs the extra `foxglove`: pip install 'zencell[foxglove]'"
OPEN_ONLY = "needs an open cell: Foxglove's protocol has no passwords, so every user of this host could read it"


def overrides_for(cell: str, port: str | None) -> Sequence[str]:
    """Return the overrides of a cell that add the bridge, or give the one of the cell file this port.

    Args:
        cell: name or path of its file.
        port: of the option; None without it.

    Raises:
        ConfigError: the package is missing, the port is invalid or in use, or the cell is secured.
        UnknownName: there is no such cell.
    """
    if port is None:
        return ()
    if not (port.isascii() and port.isdigit() and 1 <= int(port) <= HIGHEST_PORT):
        raise ConfigError("--foxglove", port, f"must be a whole number from 1 to {HIGHEST_PORT}")
    require_usable("--foxglove", port)
    services = read_yaml(find_file("cells", cell)).get("services")
    if isinstance(services, dict) and SERVICE in services:
        return (f"services.{SERVICE}.port={port}",)
    require_free("--foxglove", "127.0.0.1", int(port))
    return (f"services.{SERVICE}={{port: {port}}}",)


def require_usable(field: str, value: object) -> None:
    """Return if the package of the extra is installed and the cell is open.

    Raises:
        ConfigError: the package is missing, with the extra; or the cell is secured.
    """
    if importlib.util.find_spec("foxglove") is None:
        raise ConfigError(field, value, EXTRA)
    if secure_folder() is not None:
        raise ConfigError(field, value, OPEN_ONLY)


def require_free(field: str, host: str, port: int) -> None:
    """Return if a server can listen at host and port.

    Raises:
        ConfigError: it cannot; with the reason.
    """
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        socket.create_server((host.strip("[]"), port), family=family).close()
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            raise ConfigError(field, port, f"cannot listen at {host}: {error.strerror or error}") from None
        from common.transport.router import port_holder

        raise ConfigError(field, port, f"is in use by {port_holder(port)}") from None
