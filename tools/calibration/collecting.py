"""Keeps views of a calibration board from a cell that is up, while a person or a script moves the arm."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from common import topics
from common.errors import ZencellError
from common.messages import Image
from common.transport.bus import Bus
from common.transport.reader import Reader
from tools.calibration.views import ViewCollector

FIRST_PICTURE = 5.0  # [s] of wall time in which one comes


class NoPicture(ZencellError):
    """Nobody sends pictures."""

    exit_code = 1


async def collect_views(bus: Bus, key: str, collector: ViewCollector, wanted: int, tell: Callable[[str], None]) -> None:
    """Hand joints and pictures to a collector until it has so many views.

    Args:
        bus: in the cell.
        key: of the camera's pictures.
        collector: decides which count.
        wanted: views.
        tell: is called with what became of a picture, whenever that is not what it was before.

    Raises:
        NoPicture: none comes.
    """
    pictures, joints = bus.reader(replace(topics.CAMERA_IMAGE, key=key)), bus.reader(topics.JOINT_STATES)

    async def take_note() -> None:
        async for state in joints:
            q = dict(zip(state.name, state.position, strict=True))
            if all(name in q for name in collector.joint_names):  # else it is of another robot
                collector.joints(state.header.stamp * 1e-9, np.array([q[name] for name in collector.joint_names]))

    noting, said = asyncio.create_task(take_note()), ""
    try:
        while collector.count < wanted:
            image = await _next_of(pictures, noting)
            why = await asyncio.to_thread(collector.look, image)
            line = why or f"view {collector.count} of {wanted}; {collector.hint}"
            if line != said:
                tell(line)
            said = line
    finally:
        noting.cancel()


async def _next_of(pictures: Reader[Image], noting: asyncio.Task[None]) -> Image:
    """The next picture.

    Raises:
        NoPicture: none comes.
    """
    coming = asyncio.ensure_future(pictures.next())
    done, _ = await asyncio.wait({coming, noting}, timeout=FIRST_PICTURE, return_when=asyncio.FIRST_COMPLETED)
    if coming in done:
        return coming.result()
    coming.cancel()
    if noting in done:
        noting.result()
    raise NoPicture(f"no picture came for {FIRST_PICTURE:g} s: is a camera up, and its key right (--key)?")
