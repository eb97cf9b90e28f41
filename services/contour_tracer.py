"""Run the outlining task: reads contour, scene, gripper and motion; requests plans and motions."""

from __future__ import annotations

from applications.outlining.task import Config, Outline, OutlineView
from applications.outlining.topics import CONTOUR_PATH, OUTLINE_STATUS
from common.process.service import main
from common.process.task_runner import run_task
from common.transport.bus import Bus


async def run(bus: Bus, config: Config) -> None:
    """Step the task on every message, and at least 20 times a second."""
    await run_task(bus, config, Outline, OUTLINE_STATUS, OutlineView, path=CONTOUR_PATH)


if __name__ == "__main__":
    main(run, Config)
