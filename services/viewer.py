"""Serves the operator's page: a 3D scene, panels and controls in the browser."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import viser
from pydantic import Field

from common.application import find_application
from common.client.operator_motion import OperatorMotion
from common.config import Members, Parameters, RobotConfig, Run, Surroundings
from common.process.service import main
from common.transport.bus import Bus
from common.transport.credentials import secure_folder
from page.access import address_of, tokens_in
from page.console import Console
from page.doors import Doors
from page.feeds import Feeds, Latest, Periods, Topics
from page.guard import close_server, make_server
from page.layers import Layers, find_layers
from page.layout import load_layout
from page.line import Line
from page.page import Page
from page.recorded import folder_of

if TYPE_CHECKING:
    from common.robot.model import RobotModel
    from page.scene import Scene

IDLE_PERIOD = 0.1  # [s] wall: without a browser
START_PATIENCE = 15.0  # [s] wall: for the other services to be ready


class Config(Parameters):
    """Where the page is served and how often it is brought up to date."""

    robot: RobotConfig
    world: Surroundings
    run: Run
    members: Members
    host: str = Field(
        "127.0.0.1", min_length=1, description="address to listen at; others than this, and secured cells, need a token"
    )
    port: int = Field(8080, ge=0, le=65535, description="TCP port; 0: any that is free")
    token: str = Field("", repr=False, description="that a browser has to bring: http://HOST:PORT/?token=TOKEN")
    published: bool = Field(
        False, description="the port is reached through a loopback only, as compose.yaml has it: from its gateway no "
                           "token is needed in an open cell"
    )
    layout: str = Field(
        "", description="file of the layout; empty: viewer.yaml of this user, in the folder ZENCELL_STATE"
    )
    recordings: str = Field(
        "", description="folder of recordings that the page opens; empty: where the cell was started"
    )
    layers: list[str] = Field([], description="layers of the scene of your own: dotted modules, as my_pkg.my_layer")
    rate: float = Field(30.0, ge=1, le=60, description="of the moving robot, wall time [Hz]")
    picture_rate: float = Field(10.0, gt=0, le=30, description="of each camera picture at most, wall time [Hz]")


def load(
    server: viser.ViserServer, config: Config, layers: Layers, console: Console, latest: Latest, shown: dict[str, bool]
) -> tuple[Scene, RobotModel, list[str]]:
    """The scene with its meshes, the robot and the names of the planners; takes seconds."""
    from common.planning.planners import planner_names
    from common.robot.model import RobotModel
    from page.scene import Scene
    from page.viser_inside import client_files

    client_files()  # kept from now on
    robot = RobotModel.load(config.robot)
    scene = Scene(server, robot, config.world, layers, console, latest, shown=shown)
    return scene, robot, planner_names()


async def quiet(bus: Bus, config: Config, page: Page) -> None:
    """Return when the cell is up, or somebody wants to see it: until then the machine has better things to do."""

    async def up() -> None:
        for name in config.members.services:
            await bus.alive.wait(name)

    either = [asyncio.create_task(waiting) for waiting in (up(), _visited(page))]
    try:
        await asyncio.wait(either, timeout=START_PATIENCE, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in either:
            task.cancel()


async def _visited(page: Page) -> None:
    await page.visited.wait()


async def run(bus: Bus, config: Config) -> None:
    """Show the cell to whoever looks, until cancelled."""
    layout = load_layout(config.layout, bus.log.warning)
    application = find_application(config.members.application) if config.members.application else None
    layers = find_layers(application, config.layers, config.members.keys)
    read = Topics(application, layers.values(), config.members.keys)
    feeds = Feeds(bus, read.always, read.on_demand)
    doors = Doors(lambda line: bus.log.info("%s", line))
    console = Console(bus, config.members, feeds, read.requests, doors)
    line = Line(console)
    status = feeds.reader(read.status) if read.status is not None else None
    motions = OperatorMotion(bus, [status] if status is not None else [], owner=lambda: doors.person)
    await bus.acquire_keys()
    folder = secure_folder()
    server = make_server(
        config.host, config.port, config.token, published=config.published, secured=folder is not None,
        tokens=tokens_in(folder, bus.cell) if folder is not None else None, doors=doors, beside=line.serve,
    )
    try:
        page = Page(
            server, feeds, console, motions, config.members, application, layers, line, cell=config.run.cell,
            layout=layout, layout_file=config.layout, robot=config.robot,
            recordings=folder_of(config.recordings), periods=Periods(picture=1 / config.picture_rate),
        )
        await bus.ready()
        host = "127.0.0.1" if config.published else config.host
        bus.log.info("the page is at %s", address_of(host, server.get_port()))

        async def complete() -> None:
            await quiet(bus, config, page)
            page.complete(*await asyncio.to_thread(
                load, server, config, layers, console, page.timeline.latest, page.shown))

        async with asyncio.TaskGroup() as group:
            for activity in [*page.activities(bus.clock.age_ms), complete()]:
                group.create_task(activity)
            loop = asyncio.get_running_loop()
            due = loop.time()
            while True:
                page.refresh(loop.time(), bus.alive.names, bus.connected)
                due = max(due + (1 / config.rate if page.pages else IDLE_PERIOD), loop.time())  # late: from now on
                await asyncio.sleep(due - loop.time())
    finally:
        close_server(server)


if __name__ == "__main__":
    main(run, Config)
