"""Picks a peg where the camera sees it, and inserts it into a hole by the force at the tool."""

from __future__ import annotations

from applications.peg_in_hole.task import Config, Inserting
from applications.peg_in_hole.topics import INSERTION_STATUS
from common.process.service import main
from common.process.task_runner import run_task
from common.tasks.stages import View
from common.transport.bus import Bus


async def run(bus: Bus, config: Config) -> None:
    """Step the task on every message, and at least 20 times a second."""
    await run_task(bus, config, Inserting, INSERTION_STATUS, View)


if __name__ == "__main__":
    main(run, Config)
