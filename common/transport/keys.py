"""Keys beside the topics: those of liveliness tokens. Imports nothing, because a health check has to start fast."""

from __future__ import annotations

ROUTER = "router"  # the process that has no token: whoever reaches it knows that it is there


def alive_key(cell: str, service: str = "*") -> str:
    """Key of the token with which a service says that it is ready."""
    return f"{cell}/alive/{service}"


def owns_key(cell: str, key: str = "*", own: str = "*", service: str = "*", process: str = "*") -> str:
    """Key of the token with which a process says that it writes or serves a key, under a word of its own."""
    return f"{cell}/owns/{key.replace('/', '|')}/{own.replace('/', '|')}/{service}/{process}"


def serves_key(cell: str, key: str, service: str = "*") -> str:
    """Key of the token with which a service says that it serves a request key."""
    return f"{cell}/serves/{key}/{service}"
