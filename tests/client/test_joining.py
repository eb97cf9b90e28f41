"""Which cell, task and keys a program joins, on a network without ports."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Mapping
from typing import Any

import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS, PickPlaceStatus
from common.client import joining
from common.client.cell import Cell
from common.client.joining import SeveralCellsRunning
from common.client.subscriptions import NothingReceived
from common.clock import Clock
from common.config import load_cell, service_config
from common.errors import UnknownName, ZencellError
from common.messages import CameraInfo, Header, TaskStatus
from common.process.in_process import running_service
from common.topics import CAMERA_INFO, Topic
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from services import smart_pick_place, trajectory_executor

LEFT = {"*": "left/*"}


@pytest.mark.parametrize("host", ["a..b", "a" * 80])
def test_invalid_host_name_is_not_listening(host: str) -> None:
    assert not joining.is_listening(f"tcp/{host}:7489")


@pytest.fixture
def net(monkeypatch: pytest.MonkeyPatch) -> LocalNetwork:
    """Replace the router by a local network."""
    network = LocalNetwork()

    async def listens(endpoint: str, seconds: float) -> None:
        """Return at once."""

    @contextlib.asynccontextmanager
    async def connected(
        *, cell: str, service: str, clock: Clock | None = None, remapped: Mapping[str, str] | None = None, **_: Any
    ) -> AsyncIterator[Bus]:
        session = network.session()
        bus = Bus(session, service=service, cell=cell, clock=clock or Clock(), topics=remapped)
        try:
            yield bus
        finally:
            await bus.close()
            session.close()

    monkeypatch.setattr(joining, "wait_for_listener", listens)
    monkeypatch.setattr(joining, "is_listening", lambda endpoint: True)
    monkeypatch.setattr(joining, "connect_to", connected)
    return network


def publishing(net: LocalNetwork, topic: Topic[Any] | None, message: Any = None, **where: Any) -> Any:
    """Run a service that publishes one message, or none."""
    async def run(bus: Bus, config: None) -> None:
        if topic is not None:
            bus.writer(topic).put(message)
        await bus.ready()
        await asyncio.Event().wait()

    return running_service(net, run, None, **where)


async def test_only_running_cell_is_joined_and_one_of_several_must_be_named(net: LocalNetwork) -> None:
    async with publishing(net, None, cell="anna"):
        async with Cell() as cell:
            assert cell.name == "anna"
        async with publishing(net, None, cell="bert"):
            with pytest.raises(SeveralCellsRunning) as caught:
                async with Cell():
                    pass
            assert str(caught.value) == ("several cells are up: name one, by Cell(NAME) or --cell NAME; "
                                       "choices: anna, bert")
            async with Cell("bert") as cell:
                assert cell.name == "bert"


async def test_cell_that_becomes_ready_meanwhile_is_joined(net: LocalNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    first, ask = asyncio.Event(), joining.ready_services

    async def asked(bus: Bus) -> list[tuple[str, str]]:
        found = await ask(bus)
        first.set()
        return found

    monkeypatch.setattr(joining, "ready_services", asked)
    joined = asyncio.create_task(Cell().__aenter__())
    await first.wait()
    async with publishing(net, None, cell="anna"):
        cell = await joined
        assert cell.name == "anna"
        await cell.__aexit__(None, None, None)


async def test_cell_is_found_in_another_domain_only_if_it_is_the_only_one(
    net: LocalNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    ports: list[int] = [7447 + 61]
    monkeypatch.setattr(joining, "is_listening", lambda endpoint: int(endpoint.rpartition(":")[2]) in ports)
    monkeypatch.delenv("ZENCELL_DOMAIN", raising=False)
    async with publishing(net, None, cell="anna"):
        assert await joining.domain_of_only(None, None) == await joining.domain_of_only("anna", None) == 61
        assert await joining.domain_of_only("bert", None) is None
        ports.append(7447 + 62)
        with pytest.raises(SeveralCellsRunning, match="by domain=; choices: anna in domain 61, anna in domain 62"):
            await joining.domain_of_only(None, None)
        ports.append(7447 + 42)
        assert await joining.domain_of_only(None, None) is None, "the default domain comes first"
        monkeypatch.setenv("ZENCELL_DOMAIN", "63")
        ports.pop()
        assert await joining.domain_of_only(None, None) is None, "the operator chose a domain"


async def test_arm_is_stopped_and_task_started_under_remapped_keys(net: LocalNetwork) -> None:
    loaded = load_cell("panda", ["autostart=false"])
    configs = {service: service_config(loaded, service.__name__.rpartition(".")[2], service.Config)
               for service in (trajectory_executor, smart_pick_place)}
    async with (
        running_service(net, trajectory_executor.run, configs[trajectory_executor], name="trajectory_executor",
                        cell="two_arms", topics=LEFT),
        running_service(net, smart_pick_place.run, configs[smart_pick_place], name="smart_pick_place",
                        cell="two_arms", topics=LEFT),
        Cell("two_arms", remapped=LEFT, owner="anna") as left, Cell("two_arms", owner="anna") as right,
    ):
        stopped = await left.arm.stop("smoke")
        assert [stop.by for stop in (await left.arm.status()).interlocks] == ["anna"]
        assert await joining.newest_interlock(left.bus) == stopped.newest > 0
        assert await joining.newest_interlock(right.bus) == stopped.newest, "of all arms"
        assert left.bus.full_key(await left.task.topic()) == "two_arms/left/pick_place_status"
        await left.task.start()
        async with asyncio.timeout(60.0):
            while (await left.arm.status()).stopped:  # noqa: ASYNC110 - the task passes the start on to the executor
                await asyncio.sleep(0.01)
        for request in (right.arm.status(), right.services(), left.services()):
            with pytest.raises(NothingReceived, match="two_arms/"):
                await request


RIGHT = {"*": "right/*"}


def camera_info(frame: str) -> CameraInfo:
    return CameraInfo(header=Header(frame_id=frame), width=2, height=1, k=[1.0, 0.0, 1.0, 0.0, 1.0, 0.5, 0.0, 0.0, 1.0])


async def test_camera_has_the_name_that_the_program_uses(net: LocalNetwork) -> None:
    async with (publishing(net, CAMERA_INFO, camera_info("one"), name="one", topics=LEFT),
                publishing(net, CAMERA_INFO, camera_info("two"), name="two", topics={"camera/*": "right/camera/*"})):
        for remapped, name, others, frame in ((LEFT, "camera", ["right/camera"], "one"),
                                              (None, "right/camera", ["left/camera"], "two")):
            async with Cell("test", remapped=remapped) as cell:
                assert sorted(await cell.cameras()) == sorted([name, *others])
                assert (await (await cell.camera(name)).info()).header.frame_id == frame


async def test_of_several_tasks_the_one_under_remapped_keys_is_used(net: LocalNetwork) -> None:
    one, two = (PickPlaceStatus(header=Header(stamp=1), message=name) for name in ("one", "two"))
    async with (publishing(net, PICK_PLACE_STATUS, one, name="one", topics=LEFT),
                publishing(net, PICK_PLACE_STATUS, two, name="two", topics=RIGHT)):
        for remapped, message in ((LEFT, "one"), (RIGHT, "two")):
            async with Cell("test", remapped=remapped) as cell:
                assert (await cell.task.status()).message == message
        async with Cell("test") as cell:
            with pytest.raises(UnknownName, match="choices: left/pick_place_status, right/pick_place_status"):
                await cell.task.status()


class OwnStatus(TaskStatus):
    """Status of a custom application."""


OWN = Topic("own_status", OwnStatus, "state", "progress")


async def test_task_of_a_custom_application_needs_its_module(net, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "application.py").write_text(
        f"from common.application import Application, ApplicationTopics\nfrom {__name__} import OWN\n"
        "APPLICATION = Application(topics=ApplicationTopics(status=OWN))\n")

    async with publishing(net, OWN, OwnStatus(header=Header(stamp=1), message="it runs"), name="own"):
        async with Cell("test", application="own.application") as cell:
            assert (await cell.task.status()).message == "it runs"
        async with Cell("test") as cell:
            with pytest.raises(UnknownName, match="application=MODULE names a custom one"):
                await cell.task.status()
        for name in ("nosuch", "own.nosuch"):
            async with Cell("test", application=name) as cell:
                with pytest.raises(ZencellError, match=f"{name}.*") as caught:
                    await cell.task.status()
                assert "\n" not in str(caught.value)
