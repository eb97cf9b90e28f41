"""Run the task of one arm of a handover: gives to another arm, or takes from it."""

from __future__ import annotations

import asyncio
from functools import partial

from applications.hand_over.task import Config, Giver, Receiver
from applications.hand_over.topics import HANDOVER_STATUS
from common.process.other_arms import OtherArm
from common.process.service import main
from common.process.task_runner import run_task
from common.tasks.handover import HandoverView
from common.transport.bus import Bus


async def run(bus: Bus, config: Config) -> None:
    """Step the task on every message, and at least 20 times a second."""
    await asyncio.to_thread(config.require_reachable_meeting)
    other = OtherArm(bus, config.partner, config.arms.robots[config.partner], HANDOVER_STATUS)
    await run_task(bus, config, Giver if config.gives_to else Receiver, HANDOVER_STATUS,
                   partial(HandoverView, other=other.now))


if __name__ == "__main__":
    main(run, Config)
