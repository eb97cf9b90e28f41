"""Publish the planning scene of a cell without perception: fixtures, and solids that operators added."""

from __future__ import annotations

import asyncio

from common.config import Parameters, Surroundings
from common.messages import PlanningScene
from common.process.planning_scene import SceneWriter
from common.process.service import main
from common.scene.fixtures import fixed_objects
from common.transport.bus import Bus


class Config(Parameters):
    """The surroundings of the robot."""

    world: Surroundings


async def run(bus: Bus, config: Config) -> None:
    """Publish the scene, and again when an operator changes it."""
    out = SceneWriter(bus)
    await out.begin(PlanningScene(header=bus.header("world"), objects=fixed_objects(config.world)))
    await bus.ready()
    await asyncio.Event().wait()


if __name__ == "__main__":
    main(run, Config)
