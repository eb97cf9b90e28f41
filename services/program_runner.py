"""Run programs that an operator writes, and serve their commands, edits and dry runs."""

from __future__ import annotations

from applications.programming.serving import ProgramMemory, ProgramRunner
from applications.programming.settings import Config
from applications.programming.task import ProgramTask
from applications.programming.topics import PROGRAM_STATUS
from common.process.service import main
from common.process.task_runner import run_task
from common.tasks.stages import View
from common.transport.bus import Bus


async def run(bus: Bus, config: Config) -> None:
    """Run the task as a service."""
    await run_task(bus, config, ProgramTask, PROGRAM_STATUS, View, runner=ProgramRunner, memory=ProgramMemory)


if __name__ == "__main__":
    main(run, Config)
