"""Who writes and serves which key: a token for each of them, by which a second one finds the first and gives way.

Whoever asks for a key that is alive is refused at its start. Two that are both up, because the network was split when
they started, see each other when it is whole again: the one that was ready first goes on, the other ends.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass

from common.errors import ConfigError
from common.topics import general_key
from common.transport.keys import owns_key

# What the supervisors of linked hosts say under one key; the readers tell them apart.
SHARED = ("log/supervisor", "counters/supervisor", "supervisor/status")
GIVE_UP = 3.0  # [s] longer than a link that was cut stands: the one before may be gone and its tokens not yet
LOOK_PERIOD = 0.2  # [s]
MEET = 0.5  # [s] that somebody else must own what is ours before one of the two ends: tokens of who is gone go at once
_ASKS = "f" * 16  # instead of a time: later than everybody who is ready


def process_name(life: str, since: int | None = None) -> str:
    """What a process is called in its tokens.

    Args:
        life: id of the process.
        since: when it became ready [ns since the Unix epoch]; None: it is not yet.
    """
    return f"{_ASKS if since is None else format(max(since, 0), '016x')}-{life}"


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

    @property
    def life(self) -> str:
        """Id of the process, whether it is ready or asks."""
        return self.process.rpartition("-")[2]

    @property
    def asks(self) -> bool:
        """Whether it is not ready yet, and gives way to who is."""
        return self.process.startswith(_ASKS)

    def was_before(self, other: Owner) -> bool:
        """Whether this one stays and the other ends, where both are ready."""
        return self.process < other.process

    @classmethod
    def of(cls, token: str) -> Owner:
        """Who holds a token."""
        key, own, service, process = token.split("/")[2:]
        return cls(key.replace("|", "/"), own.replace("|", "/"), service, process)


def who_owns(tokens: Iterable[str]) -> list[Owner]:
    """Each owner once, by service and key; who just became ready has both its tokens for a moment."""
    found: dict[tuple[str, str, str], Owner] = {}
    for owner in map(Owner.of, tokens):
        one = (owner.service, owner.key, owner.life)
        if one not in found or not owner.asks:
            found[one] = owner
    return [found[one] for one in sorted(found)]


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
        others = [each for each in await look() if each.key in mine and each.life != mine[each.key].life]
        if not others:
            return
        if asyncio.get_running_loop().time() > deadline:
            other = min(others, key=lambda each: (general_key(each.key) != each.key, each.service, each.key))
            raise ConfigError(f"services.{mine[other.key].service}", ..., refusal(mine[other.key], other))
        await asyncio.sleep(LOOK_PERIOD)


class Meetings:
    """Those who own what is ours, as far as they have shown up since we are ready."""

    def __init__(self, mine: Mapping[str, Owner]) -> None:
        """Know of nobody.

        Args:
            mine: by key.
        """
        self._mine = mine
        self._there: set[Owner] = set()
        self._told: set[str] = set()  # processes

    def hear(self, token: str, there: bool) -> Owner | None:
        """Take note of a token; who is to be looked at again in a moment, if it is of another owner of ours."""
        other = Owner.of(token)
        if (mine := self._mine.get(other.key)) is None or other.life == mine.life:
            return None
        (self._there.add if there else self._there.discard)(other)
        return other if there else None

    def judge(self, other: Owner) -> tuple[bool, str]:
        """Whether we stay, and what is to be said, if it is news."""
        mine = self._mine[other.key]
        stays = mine.was_before(other)
        if other not in self._there or (stays and other.life in self._told):
            return True, ""
        self._told.add(other.life)
        who = f"another {other.service}" if other.service == mine.service else other.service
        if stays:
            return True, f"{who} (process {other.life}) claims {mine.key} too and gives way: this one was there first"
        return False, f"{who} (process {other.life}) has {mine.key} and was there first: this one ends"


def refusal(mine: Owner, other: Owner) -> str:
    """Why a key cannot be ours too, and what helps."""
    if mine.service == other.service:
        return f"another {mine.service} is up, which has {mine.key} already: end it first, or start one"
    folder, slash, last = mine.own.rpartition("/")
    example = f"{folder}/*: {mine.service}/*" if slash else f"{last}: {mine.service}/{last}"
    return (f"{other.service} has {mine.key} already, and a key is written or served by one service: give "
            f"{mine.service} or {other.service} keys of its own, as in topics: {{{example}}}")
