"""The viewer among fake services."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from typing import Any, ClassVar

import pytest

from applications.outlining.topics import OUTLINE_SELECT, OutlineSelect, OutlineSelection
from applications.pick_place.topics import PICK_PLACE_STATUS, PickPlaceStatus
from common import messages as m
from common import topics
from common.config import load_cell, service_config
from common.errors import Refused
from services import viewer
from tests.page.fake_browser import PATIENCE, FakeBrowser, opened
from tests.services.fake_cell import FakeCell

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


class FakeServices(FakeCell):
    """Services that answer the page and record its requests."""

    def __init__(self) -> None:
        super().__init__()
        self.port, self.holder, self.area = 0, "", 60.0
        self.commands: list[str] = []
        self.stops: list[str] = []
        self.orders: list[tuple[str, str]] = []
        self.sets: list[tuple[dict[str, object], str]] = []
        self.selects: list[OutlineSelect] = []

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

    def put_motion(self, *interlocks: m.Interlock, **status: Any) -> None:
        self.put(topics.MOTION_STATUS, m.MotionStatus(interlocks=list(interlocks), **status))

    def put_task(self, **status: Any) -> None:
        self.put(PICK_PLACE_STATUS, PickPlaceStatus(**status))


@asynccontextmanager
async def serve_page(cell: str, serve: bool = True, **changes: object) -> AsyncIterator[FakeServices]:
    """Run a viewer among fake services."""
    services = FakeServices()
    if serve:
        services.serve()
    await services.bus.ready()
    lines = services.reader(topics.LOG)
    config = service_config(load_cell(cell), "viewer", viewer.Config).model_copy(update={"port": 0, **changes})
    async with services.running(viewer, config):
        async with asyncio.timeout(PATIENCE):
            while (found := re.search(r"page is at http://127\.0\.0\.1:(\d+)", (await lines.next()).message)) is None:
                pass
        services.port = int(found[1])
        yield services


@asynccontextmanager
async def page_of(cell: str, **changes: object) -> AsyncIterator[tuple[FakeServices, FakeBrowser]]:
    """Run a viewer among fake services, with an open page."""
    async with serve_page(cell, **changes) as services, opened(services.port) as browser:  # type: ignore[arg-type]
        yield services, browser


@pytest.fixture
async def panda() -> AsyncIterator[FakeServices]:
    async with serve_page("panda") as services:
        yield services


@pytest.fixture
async def page(panda: FakeServices) -> AsyncIterator[FakeBrowser]:
    async with opened(panda.port) as browser:
        yield browser
