"""An executor that ends during a motion brings the arm to standstill on its path first."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from common import topics
from common.clock import Clock
from common.config import load_cell, service_config
from common.errors import ConfigError
from common.messages import ExecuteRequest, MotionStatus
from common.process.in_process import running_service
from common.robot.model import RobotModel
from common.time_source import use_time_source
from common.transport import ownership
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from lab.loop import VirtualTimeLoop
from lab.observers import observe_set_points, with_observed_arm
from services import trajectory_executor
from services.trajectory_executor import Config
from tests.common.control.test_limiter import assert_within
from tests.services.executor_rig import NAME, move

FAST = 1.0  # [rad/s] at which the executor is ended
CELL = with_observed_arm(load_cell("panda"))
ROBOT = RobotModel.load(CELL.robot)


@dataclass
class MovingArm:
    """An executor during a motion, and all its set-points."""

    net: LocalNetwork
    client: Bus
    first: Bus  # of an executor with the same name on another network, which was ready before
    reported: list[float]  # times of joint states
    fast: asyncio.Event
    positions: list[np.ndarray] = field(default_factory=list)
    speed: float = 0.0  # [rad/s]
    limits: object = None

    def on_set_point(self, limits, _measured, q, dq, _now) -> None:
        self.limits, self.speed = limits, float(np.abs(dq).max())
        self.positions.append(q.copy())
        if self.speed > FAST:
            self.fast.set()

    def join_networks(self) -> None:
        """Show the executor that another one was ready before it."""
        session = self.net.session()
        for entry in [*self.first._session.network.tokens]:
            if entry.key.startswith("test/owns/"):
                session.token(entry.key)


async def not_called(_: ExecuteRequest) -> MotionStatus:
    raise AssertionError("its network has no client")


@pytest.fixture(autouse=True)
def _decide_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ownership, "CONFLICT_SECONDS", 0.05)  # while the arm still moves


async def moving(end: Callable[[MovingArm], Awaitable[None]]) -> MovingArm:
    """Call `end` during a fast motion, then end the executor; return what was observed."""
    clock, net = Clock(), LocalNetwork()
    first = LocalNetwork().bus(NAME, clock=clock)
    first.writer(topics.JOINT_STATES)
    first.serve(topics.MOTION_EXECUTE, not_called)
    await first.ready()
    await asyncio.sleep(0.1)
    client, loop = net.bus("client", clock=clock), asyncio.get_running_loop()
    arm = MovingArm(net, client, first, [], asyncio.Event())
    client.raw_subscriber("test/joint_states", lambda sample: arm.reported.append(loop.time()))
    config = service_config(CELL, NAME, Config)
    with observe_set_points(arm.on_set_point):
        async with running_service(net, trajectory_executor.run, config, name=NAME, clock=clock):
            trajectory = move(ROBOT, ROBOT.named("home"), ROBOT.named("home") + 1.0, scaling=0.9)
            request = ExecuteRequest(header=client.header(), id="far", trajectory=trajectory)
            assert (await client.client(topics.MOTION_EXECUTE).call(request)).state == "active"
            await arm.fast.wait()
            await end(arm)
    return arm


def on_virtual_time(end: Callable[[MovingArm], Awaitable[None]]) -> MovingArm:
    loop = VirtualTimeLoop(1)
    with use_time_source(loop):
        try:
            return loop.run_until_complete(moving(end))
        finally:
            loop.close()


def assert_came_to_rest(arm: MovingArm) -> None:
    began = next(i for i, q in enumerate(arm.positions) if not np.array_equal(q, arm.positions[0]))
    assert_within([arm.positions[0]] * 4 + arm.positions[began:], arm.limits, acceleration=arm.limits.braking)
    assert arm.speed == 0.0 and np.abs(np.diff(arm.positions[-2:], axis=0)).max() < 1e-4


def test_executor_that_is_terminated_brakes_within_limits_and_reports_joint_states_meanwhile() -> None:
    cycles = []

    async def end(arm: MovingArm) -> None:
        cycles.append(len(arm.positions))

    arm = on_virtual_time(end)
    assert_came_to_rest(arm)
    assert 5 < len(arm.positions) - cycles[0] < 50, "it does not continue to its goal"
    assert len(arm.reported) == len(arm.positions)


def test_executor_whose_arm_is_at_rest_ends_at_once() -> None:
    cycles = []

    async def end(arm: MovingArm) -> None:
        status = arm.client.reader(topics.MOTION_STATUS)
        while (await status.next()).state != "succeeded":
            pass
        cycles.append(len(arm.positions))

    arm = on_virtual_time(end)
    assert len(arm.positions) <= cycles[0] + 2 and not arm.speed


def test_executor_that_was_not_first_brakes_within_limits_and_leaves_the_keys_to_the_other() -> None:
    seen = []

    async def end(arm: MovingArm) -> None:
        arm.join_networks()
        own = next(entry for entry in arm.net.tokens if entry.key == f"test/alive/{NAME}").session
        await arm.client.alive.known()
        await arm.client.alive.wait(NAME, there=False)
        served = {entry.key for entry in arm.net.queryables if entry.session is own}
        seen.append((arm.speed, len(arm.reported), served))
        await asyncio.Event().wait()

    arms: list[MovingArm] = []
    with pytest.raises(ConfigError, match=f"another {NAME} .* was there first: this one ends"):
        on_virtual_time(lambda arm: arms.append(arm) or end(arm))
    assert_came_to_rest(arms[0])
    speed, reported, served = seen[0]
    assert speed > 0.5 and len(arms[0].reported) == reported
    assert served <= {f"test/log/{NAME}", f"test/counters/{NAME}"}
