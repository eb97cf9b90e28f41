"""Run the task that picks from a conveyor: reads scene, belts, gripper and motion; requests plans and motions."""

from __future__ import annotations

from applications.belt_picking.task import BeltPicking, BeltView, Config
from applications.belt_picking.topics import BELT_PICKING_STATUS
from common import topics
from common.process.service import main
from common.process.task_runner import run_task
from common.transport.bus import Bus


async def run(bus: Bus, config: Config) -> None:
    """Step the task on every message, and at least 20 times a second."""
    await run_task(bus, config, BeltPicking, BELT_PICKING_STATUS, BeltView, belts=topics.CONVEYOR_STATE)


if __name__ == "__main__":
    main(run, Config)
