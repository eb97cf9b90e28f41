"""The policy cell on the virtual clock: a pick by pictures, operators who take over, and a failing policy."""

from __future__ import annotations

from typing import Any

import pytest

from applications.policy.interface import Observation, PolicyFailed
from applications.policy.topics import POLICY_CONTROL, POLICY_STATUS, ControlRequest
from common import topics
from common.config import load_cell
from common.errors import RemoteError
from common.messages import JogCommand, TaskCommand
from common.transport.bus import Bus
from lab.simulation import Outcome, Simulation


def run(*settings: str, seed: int = 1, visit: Any = None) -> Outcome:
    return Simulation(load_cell("policy_panda", list(settings)), seed, limit=40.0, visit=visit).run()


def test_ball_is_picked_up_by_pictures() -> None:
    outcome = run()
    assert (outcome.state, outcome.done, outcome.broken, outcome.crashes) == ("DONE", 1, [], []), outcome


def test_operator_takes_over_jogs_and_gives_back() -> None:
    seen: dict[str, Any] = {}

    async def visit(bus: Bus) -> None:
        status, joints = bus.reader(POLICY_STATUS), bus.reader(topics.JOINT_STATES)
        motion, control = bus.reader(topics.MOTION_STATUS), bus.client(POLICY_CONTROL)
        jog = bus.writer(topics.MOTION_JOG)
        await bus.ready()
        while status.latest is None or status.latest.moving_seconds < 1.0:
            await bus.clock.sleep(0.02)
        seen["taken"] = await control.call(ControlRequest(take=True, owner="anna"), 1.0)
        while motion.latest is None or motion.latest.state == "active":
            await bus.clock.sleep(0.02)
        await bus.clock.sleep(0.3)
        before, name = joints.latest, "panda_joint1"
        assert before is not None
        for _ in range(25):
            jog.put(JogCommand(header=bus.header(), owner="anna", joints={name: 0.3}))
            await bus.clock.sleep(0.04)
        await bus.clock.sleep(0.5)
        after = joints.latest
        assert after is not None and status.latest is not None
        seen["moved"] = after.position[after.name.index(name)] - before.position[before.name.index(name)]
        seen["status"], seen["chunks"] = status.latest.model_copy(), status.latest.chunks
        await bus.clock.sleep(0.5)
        seen["later"] = status.latest.chunks
        with pytest.raises(RemoteError, match="anna has control: only anna gives it back"):
            await control.call(ControlRequest(take=False, owner="bob"), 1.0)
        seen["given"] = await control.call(ControlRequest(take=False, owner="anna"), 1.0)

    outcome = run(visit=visit)
    assert (outcome.state, outcome.broken, outcome.crashes) == ("DONE", [], []), outcome
    assert (seen["taken"].control, seen["taken"].operator, seen["given"].control) == ("operator", "anna", "policy")
    assert seen["status"].control == "operator" and seen["chunks"] == seen["later"]
    assert seen["moved"] == pytest.approx(0.3, abs=0.1)


@pytest.mark.slow
def test_stop_ends_the_motion_and_start_continues() -> None:
    async def visit(bus: Bus) -> None:
        status, command = bus.reader(POLICY_STATUS), bus.client(topics.TASK_COMMAND)
        motion = bus.reader(topics.MOTION_STATUS)
        await bus.ready()
        while status.latest is None or status.latest.moving_seconds < 1.0:
            await bus.clock.sleep(0.02)
        await command.call(TaskCommand(command="stop"), 2.0)
        while motion.latest is None or motion.latest.state == "active":
            await bus.clock.sleep(0.02)
        await bus.clock.sleep(1.0)
        assert motion.latest.state == "cancelled" and status.latest.state not in ("DONE", "ERROR")
        await command.call(TaskCommand(command="start"), 2.0)

    outcome = run(visit=visit)
    assert (outcome.state, outcome.broken, outcome.crashes) == ("DONE", [], []), outcome


async def failing(observation: Observation) -> None:
    """Fail always."""
    raise PolicyFailed("out of memory")


@pytest.mark.slow
def test_policy_that_always_fails_ends_the_episode_with_its_reason() -> None:
    outcome = run(f"services.policy_runner.source={{callable: '{__name__}:failing'}}")
    assert outcome.state == "ERROR" and "out of memory (10 failures in a row)" in outcome.message, outcome
