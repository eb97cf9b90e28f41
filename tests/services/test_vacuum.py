"""A suction cup that I/O drives: executor and I/O service of a cell in which the cup is 1 mm above a box at home."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import numpy as np
import pytest

from common import messages as m
from common import topics
from common.client.cell import Cell
from common.clock import Clock
from common.config import load_cell, service_config
from common.errors import RemoteError, UnknownName
from common.process.in_process import running_service
from common.robot.model import RobotModel
from services import io, trajectory_executor
from tests.services.executor_rig import NOT_TOO_LATE, ExecutorClient, move
from tests.services.fake_cell import latest

BOX = "{id: box, shape: box, size: [0.06, 0.06], height: 0.7314, x: 0.178, y: 0.109, color: [0.9, 0.1, 0.1]}"
CUP = ["robot=ur5_cup", "robot.gripper.vacuum={output: vacuum, input: vacuum_ok, timeout: 60.0}", "services.io={}",
       "io.signals={vacuum: {output: 0}, vacuum_ok: {input: 0}}", "world.layout=fixed", "world.count=0",
       f"world.objects=[{BOX}]", NOT_TOO_LATE]


class Vacuum(ExecutorClient):
    """A client of both services."""

    def __init__(self, *settings: str) -> None:
        self.cell = load_cell("panda", [*CUP, *settings])
        super().__init__(Clock(5.0))
        self.signals = self.reader(topics.IO_STATE)
        self.robot = RobotModel.load(self.cell.robot)
        self.io = Cell.on(self.bus, owner="me").io

    def service(self, module: Any) -> Any:
        name = module.__name__.rpartition(".")[2]
        config = service_config(self.cell, name, module.Config)
        return running_service(self.net, module.run, config, name=name, clock=self.clock)

    async def read(self, **values: bool) -> m.IoState:
        def matches(state: m.IoState) -> bool:
            return not any(state.problem(name) or state.find(name).value is not value for name, value in values.items())
        state: m.IoState = await latest(self.signals, matches)
        return state

    async def held_object(self) -> str:
        world = await latest(self.objects)
        return next((each.id for each in world.objects if each.state == "held"), "")

    async def close_cup(self) -> m.GripperState:
        width = self.cell.robot.gripper.held_width if self.cell.robot.gripper else 0.0
        goal = ""
        while not goal or self.answer.error == "io_lost":  # the executor may not have read the signals yet
            goal += "close"
            self.answer = await self.command.call(m.GripperCommand(id=goal, width=0.0, expected_width=width))
        state: m.GripperState = await latest(self.gripper, lambda g: g.id == goal and g.state != "active")
        return state


@asynccontextmanager
async def cup(*settings: str) -> AsyncIterator[tuple[Vacuum, AsyncExitStack]]:
    """Yield the client, and the stack in which the I/O service runs."""
    client = Vacuum(*settings)
    async with client.service(trajectory_executor), AsyncExitStack() as signals:
        await signals.enter_async_context(client.service(io))
        await client.read(vacuum=False, vacuum_ok=False)
        yield client, signals


async def test_commands_switch_the_output_and_the_output_alone_also_grips() -> None:
    async with cup() as (client, _):
        state = await client.close_cup()
        assert (state.state, state.outcome, state.holding) == ("succeeded", "grasped", True)
        await client.read(vacuum=True, vacuum_ok=True)
        assert await client.held_object() == "box"
        await client.grip("open", 0.08)
        await client.read(vacuum=False, vacuum_ok=False)
        await client.io.set("vacuum", True)
        await client.read(vacuum_ok=True)
        await latest(client.gripper, lambda g: g.holding)
        await client.io.set("vacuum", False)
        await latest(client.gripper, lambda g: not g.holding and g.width > 0)


@pytest.mark.parametrize(("settings", "reason"), [
    (["world.objects=[]"], "vacuum_ok did not come within 2 s: nothing is at the cup"),
    (["io.signals.other={output: 1}", "io.options.behaviors.vacuum_ok={follows: other}"],
     "vacuum_ok did not come within 2 s"),
])
async def test_vacuum_that_never_comes_is_one_reason(settings: list[str], reason: str) -> None:
    async with cup("robot.gripper.vacuum.timeout=2.0", *settings) as (client, _):
        state = await client.close_cup()
        assert (state.state, state.outcome, state.message) == ("aborted", "empty", reason)


async def test_object_is_held_and_the_arm_waits_on_its_path_while_the_service_is_gone() -> None:
    async with cup() as (client, signals):
        assert (await client.close_cup()).outcome == "grasped"
        home = client.robot.named("home")
        await client.start("a", move(client.robot, home, home + 0.3 * np.eye(6)[0], 0.05))
        await latest(client.motion, lambda status: status.progress > 0.1)
        await signals.aclose()
        held = await latest(client.motion, lambda status: status.held)
        assert held.interlocks[0].reason == "vacuum_ok is lost: the I/O service does not answer"
        assert (await latest(client.gripper, lambda g: g.message)).holding
        refused = await client.command.call(m.GripperCommand(id="open", width=0.08))
        assert (refused.state, refused.error) == ("rejected", "io_lost")
        async with client.service(io):
            assert (await client.ended("a")).state == "succeeded"
            await client.read(vacuum=True, vacuum_ok=True)
            assert await client.held_object() == "box"


@pytest.mark.parametrize(("on_stop", "held"), [("hold", "box"), ("off", "")])
async def test_stop_does_to_the_object_what_the_output_says(on_stop: str, held: str) -> None:
    async with cup(f"io.signals.vacuum.on_stop={on_stop}") as (client, _):
        assert (await client.close_cup()).outcome == "grasped"
        await client.stop.call(m.StopRequest(by="operator", owner="you"))
        with pytest.raises(RemoteError, match="stopped"):
            await client.io.set("vacuum", False)
        await client.read(vacuum=bool(held))
        await latest(client.objects, lambda world: (world.objects[0].state == "held") is bool(held))


def test_signals_must_be_digital_ones_of_the_cell() -> None:
    with pytest.raises(UnknownName, match=r"robot\.gripper\.vacuum\.input 'vacuum_okay'.*choices: vacuum_ok"):
        load_cell("panda", [*CUP, "robot.gripper.vacuum.input=vacuum_okay"])
