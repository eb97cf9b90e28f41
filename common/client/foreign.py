"""Keys that common/topics.py does not have, such as those of a person's own services: shown as the msgpack they are."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from contextlib import aclosing
from typing import TYPE_CHECKING

from common.errors import UnknownName

if TYPE_CHECKING:
    from common.transport.bus import Bus
    from common.transport.session import RawSample

PATIENCE = 2.0  # [s] until a key on which nothing came is taken for a slip of the hand


class SilentKey(UnknownName):
    """A key that is not known, and nothing says that somebody writes it."""

    def __init__(self, key: str, why: str) -> None:
        super().__init__("key", key, _published())
        self.args = (f"{self}; {why}",)


def require_key(key: str, *, several: bool = True) -> None:
    """Return when somebody may have a key of that name; with `several` also when it stands for some, by * and **.

    Raises:
        UnknownName: nobody can, as with a slash in front; with the keys that are known.
    """
    from common.remapping import is_key

    parts = ("x" if several and part in ("*", "**") else part for part in key.split("/"))
    if not is_key("/".join(parts)):
        raise UnknownName("key", key, _published())


def _published() -> list[str]:
    from common.application import all_topics
    from common.topics import Topic

    return [known for known, topic in all_topics().items() if isinstance(topic, Topic)]


async def samples(bus: Bus, key: str) -> AsyncGenerator[RawSample, None]:
    """What comes on a key of the cell, the last value first where it can be asked for; repetitions are left out.

    Raises:
        SilentKey: nothing came in the first moments.
    """
    from common.transport.reader import SequenceFilter

    full = f"{bus.cell}/{key}"
    newness = SequenceFilter()
    arriving = bus.raw_reader(full)
    following = asyncio.ensure_future(anext(arriving))
    try:
        latched = await bus.raw_get(full, PATIENCE)
        for sample in latched:
            if newness.is_new_payload(sample.attachment):
                yield sample
        if not latched:
            await asyncio.wait({following}, timeout=PATIENCE)
            if not following.done():
                raise SilentKey(key, f"nothing came on {full} within {PATIENCE:g} s")
        while True:
            sample = await following
            following = asyncio.ensure_future(anext(arriving))
            if newness.is_new_payload(sample.attachment):
                yield sample
    finally:
        following.cancel()  # which closes what it waits for
        await asyncio.wait({following})


async def require_messages(bus: Bus, key: str) -> None:
    """Return when something came on a key: somebody writes it.

    Raises:
        SilentKey: nothing did in the first moments.
    """
    async with aclosing(samples(bus, key)) as coming:
        await anext(coming)
