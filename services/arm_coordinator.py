"""Lets several arms of one cell move at the same time: proves their motions against each other (docs/two_arms.md)."""

from __future__ import annotations

import asyncio

from pydantic import Field

from common import topics
from common.config import Arms, Motion, Parameters
from common.errors import ConfigError
from common.messages import ReserveReply, ReserveRequest
from common.planning.arms.arm import Options
from common.planning.arms.band import Delays
from common.planning.arms.coordinator import Coordinator
from common.planning.arms.pair_world import ArmGeometry
from common.planning.kernel.world import KernelUnavailable
from common.process.arm_readers import ArmLink, CoordinatorLoop, Scenes
from common.process.service import main
from common.robot.model import RobotModel
from common.transport.bus import Bus

RATE = 50.0  # [Hz] of steps in cell time, and limit of wall time


class Config(Parameters):
    """Distances and patience."""

    arms: Arms
    motion: Motion = Motion()
    clearance: float = Field(0.02, ge=0.005, le=0.3, description="between two arms with what they carry [m]")
    carried: float = Field(0.06, ge=0, le=0.5, description="radius about the TCP while a gripper holds what no "
                                                           "planning scene knows [m]")
    patience: float = Field(1.0, ge=0, le=60, description="an arm at rest that obstructs an older request moves "
                                                          "back after this time [s]")
    overtaken: float = Field(5.0, ge=0, le=60, description="a request that waited longer is not overtaken any more [s]")
    longest_wait: float = Field(120.0, ge=1, le=3600, description="a request that waited longer is refused [s]")
    turns: bool = Field(False, description="one arm moves at a time, as for comparison or a first start")
    message: float = Field(0.03, ge=0.001, le=0.5, description="longest time of a message to or from an executor [s]")


def coordinator_of(config: Config, service: str) -> tuple[Coordinator, Scenes]:
    """Return the coordinator, and the planning scenes of its arms.

    Raises:
        ConfigError: the cell has one robot, two arms touch at home, or the kernel is missing.
    """
    if len(config.arms.robots) < 2:
        raise ConfigError(f"services.{service}", ..., "is for a cell with several robots: leave it out")
    robots = {name: RobotModel.load(robot) for name, robot in config.arms.robots.items()}
    options = Options(config.clearance, config.patience, config.overtaken, config.longest_wait,
                      delays=Delays(message=config.message), turns=config.turns)
    scenes = Scenes(robots, config.motion.object_padding)
    try:
        geometries = [ArmGeometry(name, robot) for name, robot in robots.items()]
        return Coordinator(geometries, options, scenes.line_free), scenes
    except KernelUnavailable as error:
        raise ConfigError(f"services.{service}", ..., f"needs the compiled planning kernel: {error}") from None
    except ValueError as error:
        raise ConfigError("robots", ", ".join(robots), str(error)) from None


async def run(bus: Bus, config: Config) -> None:
    """Answer requests, and hold and release arms, until cancelled."""
    links = {name: ArmLink(bus, name) for name in config.arms.robots}
    status = bus.writer(topics.ARMS_STATUS)
    loaded = asyncio.Event()
    coordinator: Coordinator

    async def reserve(request: ReserveRequest) -> ReserveReply:
        await loaded.wait()
        if request.arm not in links:
            return ReserveReply(header=bus.header(), state="refused", error="unknown_arm",
                                message=f"{request.arm} is no arm of this cell; choices: {', '.join(links)}")
        decision = links[request.arm].ask(request, coordinator, bus.clock.now())
        return ReserveReply(header=bus.header(), state=decision.state, error=decision.error,
                            message=decision.message, waits_for=list(decision.waits_for), waited=decision.waited)

    bus.serve(topics.RESERVE, reserve)
    coordinator, scenes = await asyncio.to_thread(coordinator_of, config, bus.service)
    for link in links.values():
        link.load(coordinator, scenes, config.carried)
    loop = CoordinatorLoop(coordinator, links, status.put, bus.header)
    loaded.set()
    await bus.ready()
    period, due = 1 / bus.clock.wall_rate(RATE, 2 * RATE), asyncio.get_running_loop().time()
    try:
        while True:
            loop.step(bus.clock.now())
            due = max(due + period, asyncio.get_running_loop().time())
            await asyncio.sleep(due - asyncio.get_running_loop().time())
    finally:
        for link in links.values():
            link.close()


if __name__ == "__main__":
    main(run, Config)
