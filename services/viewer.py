"""Serves the operator's page: a 3D scene, panels and controls in the browser."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import viser
from pydantic import Field

from common import topics
from common.application import find_application
from common.client.operator_motion import OperatorMotion
from common.config import Arms, Io, Members, Parameters, RobotConfig, Run, Surroundings
from common.process.service import main
from common.transport.bus import Bus
from common.transport.credentials import secure_folder
from page.access import Permissions
from page.address import page_url
from page.console import Console
from page.control_socket import ControlSocket
from page.feeds import Feeds, Schedule, Topics
from page.layers import Layers, find_layers
from page.layers.other_arms import other_arms
from page.layout import load_layout
from page.page import Page
from page.recorded_history import recordings_folder
from page.server import close_server, make_server
from security.page_tokens import read_tokens

if TYPE_CHECKING:
    from common.robot.model import RobotModel
    from page.scene import Scene

IDLE_PERIOD = 0.1  # [s] wall: without a browser
STARTUP_TIMEOUT = 15.0  # [s] wall: for the other services to be ready


class Config(Parameters):
    """Address, access and update rates of the page."""

    robot: RobotConfig
    arms: Arms = Arms()
    world: Surroundings
    run: Run
    members: Members
    io: Io = Io()
    host: str = Field(
        "127.0.0.1", min_length=1, description="listening address; any other than this, and secured cells, need a token"
    )
    port: int = Field(8080, ge=0, le=65535, description="TCP port; 0: any free port")
    token: str = Field("", repr=False, description="access token: http://HOST:PORT/?token=TOKEN")
    published: bool = Field(
        False, description="the port is published by a container engine on the host's loopback only (compose.yaml): "
                           "requests from its gateway need no token in an open cell"
    )
    layout: str = Field(
        "", description="layout file; empty: viewer.yaml of this user, in the folder ZENCELL_STATE"
    )
    recordings: str = Field(
        "", description="folder of recordings that the page opens; empty: where the cell was started"
    )
    layers: list[str] = Field([], description="custom layers of the scene: dotted modules such as my_pkg.my_layer")
    rate: float = Field(30.0, ge=1, le=60, description="updates of the moving robot, wall time [Hz]")
    picture_rate: float = Field(10.0, gt=0, le=30, description="maximum updates of each camera image, wall time [Hz]")


def load(server: viser.ViserServer, config: Config, layers: Layers, page: Page) -> tuple[Scene, RobotModel, list[str]]:
    """Return the scene with its meshes, the robot, and the names of the planners; takes seconds."""
    from common.planning.planners import planner_names
    from common.robot.model import RobotModel
    from page.scene import Scene
    from page.viser_client import client_files

    client_files()  # fills a cache
    robot = RobotModel.load(config.robot)
    scene = Scene(server, robot, config.world, layers, page.console, page.timeline.latest, shown=page.shown)
    return scene, robot, planner_names()


async def wait_until_quiet(bus: Bus, config: Config, page: Page) -> None:
    """Return when the cell is up or a browser connects: loading before would slow the start of the other services."""

    async def up() -> None:
        for name in config.members.services:
            await bus.alive.wait(name)

    async def visited() -> None:
        await page.visited.wait()

    tasks = [asyncio.create_task(waiting()) for waiting in (up, visited)]
    try:
        await asyncio.wait(tasks, timeout=STARTUP_TIMEOUT, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()


async def run(bus: Bus, config: Config) -> None:
    """Serve the page until cancelled."""
    layout = load_layout(config.layout, bus.log.warning)
    application = find_application(config.members.application) if config.members.application else None
    layers = {**find_layers(application, config.layers, config.members.keys), **other_arms(config.arms)}
    read = Topics(application, layers.values(), config.members.keys)
    has_io, belts = bool(config.io.signals), config.world.conveyors
    more: list[topics.Topic[Any]] = [topics.IO_STATE] if has_io else []
    more += [topics.CONVEYOR_STATE] if belts else []
    feeds = Feeds(bus, [*read.always, *more], read.on_demand)
    permissions = Permissions(lambda line: bus.log.info("%s", line))
    requests: list[topics.Request[Any, Any]] = [topics.IO_SET] if has_io else []
    requests += [topics.CONVEYOR_SET] if belts else []
    console = Console(bus, config.members, feeds, [*read.requests, *requests], permissions)
    control = ControlSocket(console)
    status = feeds.reader(read.status) if read.status is not None else None
    motions = OperatorMotion(bus, [status] if status is not None else [], owner=lambda: permissions.client_name)
    await bus.acquire_keys()
    folder = secure_folder()
    server = make_server(
        config.host, config.port, config.token, published=config.published, secured=folder is not None,
        tokens=read_tokens(folder, bus.cell) if folder is not None else None, permissions=permissions,
        control=control.serve,
    )
    try:
        page = Page(
            server, feeds, console, motions, config.members, application, layers, control, cell=config.run.cell,
            layout=layout, layout_file=config.layout, robot=config.robot,
            recordings=recordings_folder(config.recordings), schedule=Schedule(images=1 / config.picture_rate),
            io=config.io, belts=[*belts], title=" ".join(filter(None, (config.run.cell, config.arms.own))),
        )
        await bus.ready()
        host = "127.0.0.1" if config.published else config.host
        bus.log.info("the page is at %s", page_url(host, server.get_port()))

        async def complete() -> None:
            await wait_until_quiet(bus, config, page)
            page.complete(*await asyncio.to_thread(load, server, config, layers, page))

        async with asyncio.TaskGroup() as group:
            for task in [*page.tasks(bus.clock.age_ms), complete()]:
                group.create_task(task)
            loop = asyncio.get_running_loop()
            due = loop.time()
            while True:
                page.refresh(loop.time(), bus.alive.names, bus.connected)
                due = max(due + (1 / config.rate if page.pages else IDLE_PERIOD), loop.time())
                await asyncio.sleep(due - loop.time())
    finally:
        close_server(server)


if __name__ == "__main__":
    main(run, Config)
