"""The viewer among fake services."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar

import pytest

from applications.outlining.topics import (
    OUTLINE_SELECT,
    OutlineSelect,
    OutlineSelection,
)
from common import messages as m
from common import topics
from common.clock import Clock
from common.config import Cell, load_cell, service_config
from common.errors import Refused
from common.process.in_process import running_service
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from services import viewer
from tests.page.fake_browser import PATIENCE, FakeBrowser, opened

TOKEN = "a-token-that-is-long-enough"
MIN_AREA = "services.vision_detector.min_area"


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


class FakeScene:
    """Replaces the 3D scene, whose meshes take seconds to read."""

    made: ClassVar[list[FakeScene]] = []

    def __init__(self, *arguments: Any, shown: Mapping[str, bool]) -> None:
        self.layers, self.console, self.latest = arguments[3:6]
        self.goal_pose = m.Pose(position=m.Vector3(x=0.4, z=0.5))
        self.calls: list[tuple[str, tuple[Any, ...]]] = []
        self.visible = dict(shown)
        self.started = False  # connected to the page
        FakeScene.made.append(self)

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *arguments: self.calls.append((name, arguments))

    def set_shown(self, layer: str, on: bool) -> None:
        self.visible[layer] = on
        self.started = True

    def calls_of(self, name: str) -> list[tuple[Any, ...]]:
        return [arguments for called, arguments in self.calls if called == name]


@pytest.fixture(autouse=True)
def scenes(monkeypatch: pytest.MonkeyPatch) -> list[FakeScene]:
    monkeypatch.setattr("page.scene.Scene", FakeScene)
    monkeypatch.setattr(viewer, "STARTUP_TIMEOUT", 0.0)
    monkeypatch.setattr(FakeScene, "made", [])
    return FakeScene.made


@dataclass
class FakeServices:
    """Services that answer the page and record its requests."""

    net: LocalNetwork
    bus: Bus
    port: int = 0
    commands: list[str] = field(default_factory=list)
    holder: str = ""
    stops: list[str] = field(default_factory=list)
    orders: list[tuple[str, str]] = field(default_factory=list)
    sets: list[tuple[dict[str, object], str]] = field(default_factory=list)
    selects: list[OutlineSelect] = field(default_factory=list)
    area: float = 60.0

    async def command(self, request: m.TaskCommand) -> m.TaskStatus:
        self.commands.append(request.command)
        if self.holder and not request.override:
            raise Refused("held", f"the robot is held by {self.holder}")
        return m.TaskStatus()

    async def stop(self, request: m.StopRequest) -> m.MotionStatus:
        self.stops.append(request.reason)
        return m.MotionStatus()

    async def order(self, request: m.RobotCommand) -> m.RobotStatus:
        self.orders.append((request.act, request.owner))
        if request.act == "enable":
            raise Refused("robot", "enable: the emergency stop is pressed")
        return m.RobotStatus(mode="running", controller=True)

    async def select(self, request: OutlineSelect) -> OutlineSelection:
        self.selects.append(request)
        return OutlineSelection(index=request.index or 0, label=f"Object_{request.index or 0}")

    async def parameters(self, request: m.ParameterRequest) -> m.ParameterReply:
        for path, value in request.set.items():
            self.sets.append((request.set, request.by))
            if not isinstance(value, int | float) or value > 500:
                raise Refused("bad_value", f"{path}: {value!r} must be less than or equal to 500")
            self.area = value
        return m.ParameterReply(service="vision_detector", parameters=[
            m.Parameter(path=MIN_AREA, value=self.area, default=60.0, type="number", minimum=0, maximum=1000,
                        unit="px^2", description="least area [px^2]", runtime=True),
            m.Parameter(path="services.vision_detector.fixed", value=1, type="integer"),
        ])

    def serve(self) -> None:
        self.bus.serve(topics.TASK_COMMAND, self.command)
        self.bus.serve(topics.MOTION_STOP, self.stop)
        self.bus.serve(topics.ROBOT_COMMAND, self.order)
        self.bus.serve(OUTLINE_SELECT, self.select)
        self.bus.serve(topics.parameters_of("vision_detector"), self.parameters)


def config_of(cell: Cell, **changes: object) -> viewer.Config:
    return service_config(cell, "viewer", viewer.Config).model_copy(update={"port": 0, **changes})


@asynccontextmanager
async def serve_page(cell: str, serve: bool = True, **changes: object) -> AsyncIterator[FakeServices]:
    """A viewer among fake services."""
    net = LocalNetwork()
    services = FakeServices(net, net.bus("services", cell="test", clock=Clock()))
    if serve:
        services.serve()
    await services.bus.ready()
    lines = services.bus.reader(topics.LOG)
    async with running_service(net, viewer.run, config_of(load_cell(cell), **changes), name="viewer"):
        async with asyncio.timeout(PATIENCE):
            while (found := re.search(r"page is at http://127\.0\.0\.1:(\d+)", (await lines.next()).message)) is None:
                pass
        services.port = int(found[1])
        yield services


@pytest.fixture
async def panda() -> AsyncIterator[FakeServices]:
    async with serve_page("panda") as services:
        yield services


@pytest.fixture
async def page(panda: FakeServices) -> AsyncIterator[FakeBrowser]:
    async with opened(panda.port) as browser:
        yield browser
