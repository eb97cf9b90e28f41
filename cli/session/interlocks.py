"""What persons decided of a robot before the cell came up, which outlives restarts."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from common.config import Cell
    from common.messages import Interlock
    from common.transport.bus import Bus

FIRST_WORD = 2.0  # [s] in which the executor of a cell that is up has said how the robot is
EXECUTOR, OURSELVES = "trajectory_executor", ("watchdog", "controller", "scene_monitor")


async def persisted_interlocks(bus: Bus, cell: Cell, note: Callable[[str], None]) -> list[Interlock]:
    """What persons stopped or hold since before the cell came up; notes when they made it slower."""
    from common import topics

    if not any(entry.kind == EXECUTOR for entry in cell.services.values()):
        return []  # on another host, or a cell without an arm
    reader, motion = bus.reader(topics.MOTION_STATUS), None
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(FIRST_WORD):
            motion = reader.latest or await reader.next()
    if motion is None:
        return []
    if motion.speed_scaling < 1:
        set_it = f"`zencell param set services.{EXECUTOR}.speed_scaling=1`"
        note(f"Motions go at {100 * motion.speed_scaling:.0f} % of their speed: {set_it} ends that")
    return [interlock for interlock in motion.interlocks if interlock.by not in OURSELVES]
