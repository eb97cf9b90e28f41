"""An executor that ends during a motion brings the arm to standstill on its path first."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import numpy as np
import pytest

from common import messages as m
from common import topics
from common.config import load_cell, service_config
from common.errors import ConfigError
from common.robot.model import RobotModel
from common.time_source import use_time_source
from common.transport import ownership
from common.transport.local import LocalNetwork
from lab.loop import VirtualTimeLoop
from lab.observers import observe_set_points, with_observed_arm
from services import trajectory_executor
from tests.common.control.test_limiter import assert_within
from tests.services.executor_rig import HOME, NAME, move
from tests.services.fake_cell import FakeCell

FAST = 1.0  # [rad/s] at which the executor is ended
CELL = with_observed_arm(load_cell("panda"))
FAR = move(RobotModel.load(CELL.robot), HOME, HOME + 1.0, scaling=0.9)


async def not_called(_: m.ExecuteRequest) -> m.MotionStatus:
    raise AssertionError("its network has no client")


class MovingArm(FakeCell):
    """An executor during a motion, and all its set-points."""

    def __init__(self) -> None:
        super().__init__()
        self.first = LocalNetwork().bus(NAME, clock=self.clock)  # an executor of another network, ready before
        self.reported, self.fast = 0, asyncio.Event()
        self.positions: list[np.ndarray] = []
        self.speed, self.limits = 0.0, None

    def on_set_point(self, limits, _measured, q, dq, _now, _arm) -> None:
        self.limits, self.speed = limits, float(np.abs(dq).max())
        self.positions.append(q.copy())
        if self.speed > FAST:
            self.fast.set()

    def on_joint_state(self, _: object) -> None:
        self.reported += 1

    async def move(self, end: Callable[[MovingArm], Awaitable[None]]) -> None:
        """Call `end` during a fast motion, then end the executor."""
        self.first.writer(topics.JOINT_STATES)
        self.first.serve(topics.MOTION_EXECUTE, not_called)
        await self.first.ready()
        await asyncio.sleep(0.1)  # virtual time between the two
        self.bus.raw_subscriber("test/joint_states", self.on_joint_state)
        config = service_config(CELL, NAME, trajectory_executor.Config)
        with observe_set_points(self.on_set_point):
            async with self.running(trajectory_executor, config):
                request = m.ExecuteRequest(header=self.bus.header(), id="far", trajectory=FAR)
                assert (await self.client(topics.MOTION_EXECUTE).call(request)).state == "active"
                await self.fast.wait()
                await end(self)

    def join_networks(self) -> None:
        """Show the executor that another one was ready before it."""
        session = self.net.session()
        for entry in [*self.first._session.network.tokens]:
            if entry.key.startswith("test/owns/"):
                session.token(entry.key)

    def assert_came_to_standstill(self) -> None:
        began = next(i for i, q in enumerate(self.positions) if not np.array_equal(q, self.positions[0]))
        assert_within([self.positions[0]] * 4 + self.positions[began:], self.limits, acceleration=self.limits.braking)
        assert self.speed == 0.0 and np.abs(np.diff(self.positions[-2:], axis=0)).max() < 1e-4


def on_virtual_time(end: Callable[[MovingArm], Awaitable[None]]) -> MovingArm:
    async def run() -> MovingArm:
        arm = MovingArm()
        await arm.move(end)
        return arm

    loop = VirtualTimeLoop(1)
    with use_time_source(loop):
        try:
            return loop.run_until_complete(run())
        finally:
            loop.close()


def test_executor_that_is_terminated_brakes_within_limits_and_reports_joint_states_meanwhile() -> None:
    cycles = []

    async def end(arm: MovingArm) -> None:
        cycles.append(len(arm.positions))

    arm = on_virtual_time(end)
    arm.assert_came_to_standstill()
    assert 5 < len(arm.positions) - cycles[0] < 50, "it does not continue to its goal"
    assert arm.reported == len(arm.positions)


def test_executor_whose_arm_is_at_standstill_ends_at_once() -> None:
    cycles = []

    async def end(arm: MovingArm) -> None:
        status = arm.reader(topics.MOTION_STATUS)
        while (await status.next()).state != "succeeded":
            pass
        cycles.append(len(arm.positions))

    arm = on_virtual_time(end)
    assert len(arm.positions) <= cycles[0] + 2 and not arm.speed


def test_executor_that_was_not_first_brakes_within_limits_and_leaves_the_keys_to_the_other(monkeypatch):
    monkeypatch.setattr(ownership, "CONFLICT_SECONDS", 0.05)  # while the arm still moves
    found = []

    async def end(arm: MovingArm) -> None:
        arm.join_networks()
        own = next(entry for entry in arm.net.tokens if entry.key == f"test/alive/{NAME}").session
        await arm.bus.alive.known()
        await arm.bus.alive.wait(NAME, there=False)
        served = {entry.key for entry in arm.net.queryables if entry.session is own}
        found.append((arm, arm.speed, arm.reported, served))
        await asyncio.Event().wait()

    with pytest.raises(ConfigError, match=f"another {NAME} .* was there first: this one ends"):
        on_virtual_time(end)
    ((arm, speed, reported, served),) = found
    arm.assert_came_to_standstill()
    assert speed > 0.5 and arm.reported == reported
    assert served <= {f"test/log/{NAME}", f"test/counters/{NAME}"}
