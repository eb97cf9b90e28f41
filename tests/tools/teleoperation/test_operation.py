"""A device moves the arm of a complete simulated cell, and stops it: by release, by STOP, by being unplugged."""

import asyncio

import numpy as np
import pytest

from applications.policy.topics import POLICY_CONTROL, ControlReply
from common import topics
from common.client.cell import Cell
from common.clock import Clock
from common.messages import StopRequest
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from tests.client.simulated_cell import run, standstill
from tools.teleoperation.devices import REST, DeviceLost, Reading
from tools.teleoperation.operation import Operation

pytestmark = pytest.mark.timeout(600)
FORWARD, UP = (1, 0, 0, 0, 0, 0), (0, 0, 1, 0, 0, 0)
STOPPING = 0.25  # [s]: the dead man of the executor and its braking are 0.2 s together


class Held:
    """A device that a test holds; every reading has the same axes until they are changed."""

    help = ""

    def __init__(self):
        self.axes, self.actions, self.lost = REST, (), False

    def read(self, now):
        if self.lost:
            raise DeviceLost("pad", "No such device")
        actions, self.actions = self.actions, ()
        return Reading(self.axes, actions)


class Operated:
    """An operation in a cell, and its device."""

    def __init__(self, cell, speed=0.4):
        self.cell, self.device, self.lines = cell, Held(), []
        self.operation = Operation(cell, [self.device], frame="base", speed=speed, show=self.lines.append)

    async def __aenter__(self):
        self.running = asyncio.create_task(self.operation.run())
        await self.cell.arm.pose()
        await asyncio.sleep(0.5)
        return self

    async def __aexit__(self, *_):
        if not self.running.done():
            self.device.actions = ("quit",)
        await asyncio.wait({self.running})

    async def place(self):
        return (await self.cell.arm.pose())[:3, 3]

    async def hold(self, axes, seconds):
        """Hold the device for a while; return how far the tool moved, at standstill after its release."""
        before = await self.place()
        self.device.axes = axes
        await asyncio.sleep(seconds)
        self.device.axes = REST
        await asyncio.sleep(STOPPING)
        assert np.abs(await self.cell.arm.velocities()).max() < 1e-6
        return await self.place() - before

    async def press(self, action, seconds=1.0):
        self.device.actions = (action,)
        await asyncio.sleep(seconds)


def test_arm_moves_while_the_device_is_held_and_stops_after_it():
    async def program(cell):
        async with Operated(cell) as operated:
            moved = await operated.hold(FORWARD, 1.0)
            assert 0.07 < moved[0] < 0.13 and np.abs(moved[1:]).max() < 2e-3  # 0.4 of 0.25 m/s
            moved = await operated.hold((0, 0, -0.5, 0, 0, 0), 1.0)
            assert -0.07 < moved[2] < -0.03
            await operated.press("slower")
            assert "speed 32 % in base" in operated.lines[-1]
            await operated.press("gripper", 1.2)
            assert (await cell.gripper.state()).width < 0.01
            operated.device.axes = FORWARD
            await operated.press("home", 2.5)
            home = (await cell.arm.description()).named_poses["home"]
            assert np.allclose(await cell.arm.joints(), home, atol=2e-3), "the held device moves nothing after it"
        assert operated.lines[-1] == "" and operated.running.exception() is None

    run(program)


def test_after_a_stop_the_device_must_be_released_and_that_of_another_operator_blocks_it():
    async def program(cell):
        async with Operated(cell) as operated:
            operated.device.axes = UP
            await asyncio.sleep(0.5)
            operated.device.actions = ("stop",)
            await asyncio.sleep(STOPPING + 0.1)
            stopped = await operated.place()
            assert (await cell.arm.status()).interlocks and "STOPPED" in operated.lines[-1]
            await asyncio.sleep(1.0)
            assert np.allclose(await operated.place(), stopped, atol=1e-6)
            operated.device.axes = REST
            await asyncio.sleep(0.5)
            assert (await operated.hold(UP, 1.0))[2] > 0.02
            operated.device.axes = UP
            await asyncio.sleep(0.3)
            await cell.bus.client(topics.MOTION_STOP).call(StopRequest(owner="anna", reason="lunch"), 5.0)
            await standstill(cell)
            assert np.abs(await operated.hold(UP, 1.0)).max() < 1e-6, "the stop of another operator stays"
            assert "stopped since" in operated.lines[-1] and "anna (lunch)" in operated.lines[-1]

    run(program)


def test_unplugged_device_stops_the_arm_and_ends_the_operation():
    async def program(cell):
        async with Operated(cell) as operated:
            operated.device.axes = FORWARD
            await asyncio.sleep(0.5)
            operated.device.lost = True
            await asyncio.sleep(STOPPING)
            assert np.abs(await cell.arm.velocities()).max() < 1e-6
            with pytest.raises(DeviceLost, match="pad is gone"):
                await operated.running

    run(program)


async def test_operator_takes_over_from_a_task_and_gives_back():
    network = LocalNetwork()
    runner, operator = (Bus(network.session(), service=name, cell="cell", clock=Clock()) for name in ("task", "teleop"))
    asked = []

    async def control(request):
        asked.append(request.take)
        return ControlReply(control="operator" if request.take else "policy", operator=request.owner)

    async with Cell.on(operator, owner="anna") as cell:
        operation = Operation(cell, [], frame="base", speed=0.2, show=lambda _: None)

        async def press():
            operation.act("control")
            await asyncio.gather(*operation._requests)
            operation.step(0.0)
            return operation.in_control

        assert not await press() and "hands its control over" in operation.message
        runner.serve(POLICY_CONTROL, control)
        await runner.ready()
        assert [await press(), await press()] == [True, False] and asked == [True, False]
    for bus in (operator, runner):
        await bus.close()
