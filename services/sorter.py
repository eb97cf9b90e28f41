"""Run the sorting task: reads heap, scene, gripper and motion; requests plans and motions."""

from __future__ import annotations

from applications.sorting.settings import Config, SortingView
from applications.sorting.task import Sorting
from applications.sorting.topics import HEAP, SORTING_STATUS
from common.process.service import main
from common.process.task_runner import run_task
from common.transport.bus import Bus


async def run(bus: Bus, config: Config) -> None:
    """Step the task on every message, and at least 20 times a second."""
    await run_task(bus, config, Sorting, SORTING_STATUS, SortingView, heap=HEAP)


if __name__ == "__main__":
    main(run, Config)
