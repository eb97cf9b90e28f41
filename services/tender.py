"""Run the tending task: reads scene, gripper, motion and signals; requests plans, motions and outputs."""

from __future__ import annotations

from applications.tending.task import Config, Tending
from applications.tending.topics import TENDING_STATUS
from common.process.service import main
from common.process.task_runner import run_task
from common.tasks.stages import View
from common.transport.bus import Bus


async def run(bus: Bus, config: Config) -> None:
    """Step the task on every message, and at least 20 times a second."""
    await run_task(bus, config, Tending, TENDING_STATUS, View)


if __name__ == "__main__":
    main(run, Config)
