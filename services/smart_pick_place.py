"""Run the pick-and-place task: reads targets, scene, gripper and motion; requests plans and motions."""

from __future__ import annotations

from applications.pick_place.choice import PickPlaceView
from applications.pick_place.grasping import Config
from applications.pick_place.task import PickPlace
from applications.pick_place.topics import PICK_PLACE_STATUS, VALIDATED_TARGETS
from common.process.service import main
from common.process.task_runner import run_task
from common.transport.bus import Bus


async def run(bus: Bus, config: Config) -> None:
    """Step the task on every message, and at least 20 times a second."""
    await run_task(bus, config, PickPlace, PICK_PLACE_STATUS, PickPlaceView, seen=VALIDATED_TARGETS)


if __name__ == "__main__":
    main(run, Config)
