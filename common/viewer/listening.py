"""The socket that the page listens at."""

from __future__ import annotations

import errno
import ipaddress
import socket
import sys

from common.errors import ConfigError

FIRST_PORT = 8080  # when none is asked for
LAST_PORT = FIRST_PORT + 99


def open_socket(host: str, port: int) -> socket.socket:
    """A socket that listens at host and port (0: any that is free).

    Raises:
        OSError: it can not.
    """
    if host.lower() == "localhost":
        host = "127.0.0.1"  # a browser that tries ::1 first comes back to it
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    family, _, _, _, address = found[0]
    both = family == socket.AF_INET6 and host == str(ipaddress.IPv6Address(0)) and socket.has_dualstack_ipv6()
    return socket.create_server(address[:2], family=family, dualstack_ipv6=both)


def refusal(error: OSError, host: str, port: int, field: str = "") -> ConfigError:
    """What to tell the person who asked for a host and port that can not be listened at.

    Args:
        error: from `open_socket`.
        host: as it was asked for.
        port: as it was asked for.
        field: the option that named the port; by default the parameter of the viewer.
    """
    if error.errno == errno.EADDRINUSE:
        from common.transport.router import holder_of

        return ConfigError(field or "services.viewer.port", port, f"is in use by {holder_of(port)}")
    if error.errno == errno.EACCES:
        return ConfigError(field or "services.viewer.port", port, "may not be used by this user; take 1024 or more")
    reason = error.strerror or str(error)
    return ConfigError("services.viewer.host", host, f"can not be listened at: {reason}")


class FreePort:
    """A port that nobody else who starts a cell takes before its page is there, for as long as this object lives."""

    def __init__(self, number: int) -> None:
        """Claim the port.

        Raises:
            OSError: somebody else has.
        """
        self.number = number
        self._claim: socket.socket | None = None
        if sys.platform == "linux":  # a name that vanishes with its process; elsewhere two at once may meet
            self._claim = socket.socket(socket.AF_UNIX)
            try:
                self._claim.bind(f"\0zencell-page-{number}")
            except OSError:
                self._claim.close()
                raise

    def __del__(self) -> None:
        """Let go of it."""
        if self._claim is not None:
            self._claim.close()


def first_free_port(host: str) -> FreePort:
    """The first port from 8080 on that can be listened at.

    Raises:
        ConfigError: none can, or the host is none of this machine's.
    """
    for number in range(FIRST_PORT, LAST_PORT + 1):
        try:
            port = FreePort(number)
            open_socket(host, number).close()
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise refusal(error, host, number) from None
            continue
        return port
    raise ConfigError("--viewer-port", ..., f"ports {FIRST_PORT} to {LAST_PORT} are all in use; name another")
