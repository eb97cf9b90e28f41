"""Whatever ends the executor in the middle of a motion, the arm comes to rest on its path first."""

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
from common.sources import drawn_from
from common.transport import ownership
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from lab.loop import VirtualTimeLoop
from lab.observers import observe_set_points, with_observed_arm
from services import trajectory_executor
from services.trajectory_executor import Config
from tests.common.control.test_limiter import assert_within
from tests.services.test_trajectory_executor import move

NAME = "trajectory_executor"
FAST = 1.0  # [rad/s] at which it is to end
CELL = with_observed_arm(load_cell("panda"))
ROBOT = RobotModel.load(CELL.robot)


@dataclass
class Arm:
    """An executor in the middle of a motion, of whose set-points none goes unseen."""

    net: LocalNetwork
    person: Bus
    first: Bus  # of the same name on another network, and there before it
    told: list[float]  # joint_states that came so far, by when
    fast: asyncio.Event
    positions: list[np.ndarray] = field(default_factory=list)
    speed: float = 0.0  # [rad/s]
    limits: object = None

    def look(self, limits, _measured, q, dq, _now) -> None:
        self.limits, self.speed = limits, float(np.abs(dq).max())
        self.positions.append(q.copy())
        if self.speed > FAST:
            self.fast.set()

    def meet(self) -> None:
        """Have it see that there is another."""
        session = self.net.session()
        for entry in [*self.first._session.network.tokens]:
            if entry.key.startswith("test/owns/"):
                session.token(entry.key)


async def refuse(_: ExecuteRequest) -> MotionStatus:
    raise AssertionError("asked though nobody of its network asks")


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ownership, "MEET", 0.05)  # while it still moves


async def moving(end: Callable[[Arm], Awaitable[None]]) -> Arm:
    """What was seen of an arm that was `end`ed in motion."""
    clock, net = Clock(), LocalNetwork()
    first = LocalNetwork().bus(NAME, clock=clock)
    first.writer(topics.JOINT_STATES)
    first.serve(topics.MOTION_EXECUTE, refuse)
    await first.ready()
    await asyncio.sleep(0.1)
    person, loop = net.bus("person", clock=clock), asyncio.get_running_loop()
    arm = Arm(net, person, first, [], asyncio.Event())
    person.raw_subscriber("test/joint_states", lambda sample: arm.told.append(loop.time()))
    config = service_config(CELL, NAME, Config)
    with observe_set_points(arm.look):
        async with running_service(net, trajectory_executor.run, config, name=NAME, clock=clock):
            trajectory = move(ROBOT, ROBOT.named("home"), ROBOT.named("home") + 1.0, scaling=0.9)
            request = ExecuteRequest(header=person.header(), id="far", trajectory=trajectory)
            assert (await person.client(topics.MOTION_EXECUTE).call(request)).state == "active"
            await arm.fast.wait()
            await end(arm)
    return arm


def on_virtual_time(end: Callable[[Arm], Awaitable[None]]) -> Arm:
    loop = VirtualTimeLoop(1)
    with drawn_from(loop):
        try:
            return loop.run_until_complete(moving(end))
        finally:
            loop.close()


def assert_came_to_rest(arm: Arm) -> None:
    began = next(i for i, q in enumerate(arm.positions) if not np.array_equal(q, arm.positions[0]))
    assert_within([arm.positions[0]] * 4 + arm.positions[began:], arm.limits, acceleration=arm.limits.braking)
    assert arm.speed == 0.0 and np.abs(np.diff(arm.positions[-2:], axis=0)).max() < 1e-4


def test_executor_that_is_told_to_end_brakes_within_limits_and_says_where_the_arm_is() -> None:
    cycles = []

    async def end(arm: Arm) -> None:
        cycles.append(len(arm.positions))

    arm = on_virtual_time(end)
    assert_came_to_rest(arm)
    assert 5 < len(arm.positions) - cycles[0] < 50  # it did not go on to its goal
    assert len(arm.told) == len(arm.positions)


def test_executor_whose_arm_rests_ends_at_once() -> None:
    cycles = []

    async def end(arm: Arm) -> None:
        status = arm.person.reader(topics.MOTION_STATUS)
        while (await status.next()).state != "succeeded":
            pass
        cycles.append(len(arm.positions))

    arm = on_virtual_time(end)
    assert len(arm.positions) <= cycles[0] + 2 and not arm.speed


def test_executor_that_loses_a_meeting_brakes_within_limits_and_says_nothing_under_the_keys_of_the_other() -> None:
    seen = []

    async def end(arm: Arm) -> None:
        arm.meet()
        own = next(entry for entry in arm.net.tokens if entry.key == f"test/alive/{NAME}").session
        await arm.person.alive.known()
        await arm.person.alive.wait(NAME, there=False)
        served = {entry.key for entry in arm.net.queryables if entry.session is own}
        seen.append((arm.speed, len(arm.told), served))
        await asyncio.Event().wait()

    arms: list[Arm] = []
    with pytest.raises(ConfigError, match=f"another {NAME} .* was there first: this one ends"):
        on_virtual_time(lambda arm: arms.append(arm) or end(arm))
    assert_came_to_rest(arms[0])
    speed, told, served = seen[0]
    assert speed > 0.5 and len(arms[0].told) == told
    assert served <= {f"test/log/{NAME}", f"test/counters/{NAME}"}
