"""Who writes and serves which key: a token for each of them, by which a second one finds the first and gives way."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass

from common.errors import ConfigError
from common.topics import general_key
from common.transport.keys import owns_key

# What the supervisors of linked hosts say under one key; the readers tell them apart.
SHARED = ("log/supervisor", "counters/supervisor", "supervisor/status")
GIVE_UP = 3.0  # [s] longer than a link that was cut stands: the one before may be gone and its tokens not yet
LOOK_PERIOD = 0.2  # [s]


@dataclass(frozen=True)
class Owner:
    """Somebody who writes or serves a key: under which word of its own, as which service, and in which process."""

    key: str
    own: str
    service: str
    process: str

    @property
    def token(self) -> str:
        """Its token, without the cell."""
        return owns_key("", self.key, self.own, self.service, self.process)

    @classmethod
    def of(cls, token: str) -> Owner:
        """Who holds a token."""
        key, own, service, process = token.split("/")[2:]
        return cls(key.replace("|", "/"), own.replace("|", "/"), service, process)


async def require_only(mine: Mapping[str, Owner], look: Callable[[], Awaitable[list[Owner]]]) -> None:
    """Return when nobody else writes or serves what is ours; our own tokens are declared, so that one of two gives way.

    Args:
        mine: by key.
        look: who owns what now.

    Raises:
        ConfigError: somebody else does, and goes on doing so; names both and what helps.
    """
    deadline = asyncio.get_running_loop().time() + GIVE_UP
    while True:
        others = [each for each in await look() if each.key in mine and each.process != mine[each.key].process]
        if not others:
            return
        if asyncio.get_running_loop().time() > deadline:
            other = min(others, key=lambda each: (general_key(each.key) != each.key, each.service, each.key))
            raise ConfigError(f"services.{mine[other.key].service}", ..., refusal(mine[other.key], other))
        await asyncio.sleep(LOOK_PERIOD)


def refusal(mine: Owner, other: Owner) -> str:
    """Why a key cannot be ours too, and what helps."""
    if mine.service == other.service:
        return f"another {mine.service} is up, which has {mine.key} already: end it first, or start one"
    folder, slash, last = mine.own.rpartition("/")
    example = f"{folder}/*: {mine.service}/*" if slash else f"{last}: {mine.service}/{last}"
    return (f"{other.service} has {mine.key} already, and a key is written or served by one service: give "
            f"{mine.service} or {other.service} keys of its own, as in topics: {{{example}}}")
