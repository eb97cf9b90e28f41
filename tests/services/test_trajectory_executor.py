"""Motions that the executor is asked for."""

import asyncio
import contextlib
import json

import msgpack
import numpy as np
import pytest

from applications.pick_place.topics import SCENE_BALLS
from common import topics
from common.clock import Clock
from common.control.executor import Executor
from common.errors import ConfigError, UnknownName
from common.messages import (
    ExecuteRequest,
    GripperCommand,
    Header,
    HoldRequest,
    JointTrajectoryPoint,
    StopRequest,
)
from common.process.in_process import running_service
from common.robot.model import RobotModel
from common.supervision.wiring import wiring
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from services import trajectory_executor
from tests.services.executor_person import CELL, SPEED, Person, blocked, config, executor, goes_on, move


async def test_it_reads_who_jogs_and_serves_motion_gripper_and_world() -> None:
    found = await wiring(trajectory_executor.run, config())
    assert found.reads == {topics.MOTION_JOG} and found.calls == set()
    assert found.writes == {topics.JOINT_STATES, topics.MOTION_STATUS, topics.MOTION_OWNER, topics.ROBOT_STATUS,
                            topics.GRIPPER_STATE,
                            SCENE_BALLS, topics.SCENE_OBJECTS, topics.SCENE_OBJECT_UPDATES}
    assert found.serves == {topics.MOTION_EXECUTE, topics.MOTION_FOLLOWED, topics.MOTION_STOP, topics.MOTION_HOLD,
                            topics.MOTION_OWN, topics.ROBOT_COMMAND,
                            topics.GRIPPER_COMMAND, topics.WORLD_EDIT}


async def test_it_starts_at_home_with_open_fingers_and_the_balls_of_the_world(robot: RobotModel) -> None:
    async with executor("world.count=3") as person:
        state = await person.joints.next()
        assert state.name == [*robot.joint_names, "panda_finger_joint1", "panda_finger_joint2"]
        assert np.allclose(state.position, [*robot.named("home"), 0.04, 0.04])
        balls = await person.see(person.balls, lambda b: True)
        assert balls.ids == ["ball_1", "ball_2", "ball_3"] and set(balls.labels) == {"table"}
        assert balls.header.frame_id == "world"
        later = await person.see(person.joints, lambda s: s.header.stamp > state.header.stamp)
        assert (await person.see(person.motion, lambda m: True)).state == "none"
        assert later.position == state.position


async def test_same_goal_again_is_answered_and_not_done_twice(robot: RobotModel) -> None:
    home = robot.named("home")
    there = move(robot, home, home + 0.2)
    async with executor() as person:
        await person.follow("a", there)
        again = await person.execute.call(person.asks(id="a", trajectory=there))
        assert (again.id, again.state) == ("a", "succeeded")
        state = await person.see(person.joints, lambda s: s.header.stamp > again.header.stamp)
        assert np.allclose(state.position[:7], home + 0.2) and not any(state.velocity)


async def test_refused_trajectories_are_answered_with_the_reason_and_the_next_is_followed(robot: RobotModel) -> None:
    home = robot.named("home")
    good = move(robot, home, home + 0.2)
    elsewhere = move(robot, home + 0.1, home + 0.2)
    other = good.model_copy(update={"joint_names": [f"ur5_{i}" for i in range(7)]})
    backwards = good.model_copy(update={"points": [*good.points[:5], good.points[3], *good.points[6:]]})
    async with executor() as person:
        for code, trajectory in (("start_mismatch", elsewhere), ("joint_names", other), ("bad_times", backwards)):
            answer = await person.execute.call(person.asks(id=code, trajectory=trajectory))
            assert (answer.state, answer.error) == ("rejected", code) and answer.message
        assert (await person.follow("good", good)).state == "succeeded"


async def test_stop_brings_the_arm_to_rest(robot: RobotModel) -> None:
    home = robot.named("home")
    async with executor() as person:
        await person.execute.call(person.asks(id="a", trajectory=move(robot, home, home + 0.5, 0.02)))
        await person.see(person.motion, lambda m: m.progress > 0.2)
        await person.stop.call(StopRequest(reason="tested"))
        status = await person.see(person.motion, lambda m: m.state != "active")
        assert (status.state, status.message) == ("cancelled", "tested") and status.progress < 0.9
        state = await person.see(person.joints, lambda s: s.header.stamp > status.header.stamp)
        assert not any(state.velocity)


@pytest.mark.slow
async def test_speed_scaling_that_is_set_while_it_moves_slows_the_arm_down(robot: RobotModel) -> None:
    home = robot.named("home")
    net, clock, given = LocalNetwork(), Clock(SPEED), config()
    async with running_service(net, trajectory_executor.run, given, name="trajectory_executor", cell=CELL, clock=clock):
        person = Person(net, clock)
        trajectory = move(robot, home, home + 0.5, 0.02)
        await person.execute.call(person.asks(id="a", trajectory=trajectory))
        began = clock.now()
        await person.see(person.motion, lambda m: m.progress > 0.1)
        given.speed_scaling = 0.2
        await person.see(person.motion, lambda m: m.speed_scaling == 0.2 and m.state == "active")
        status = await person.see(person.motion, lambda m: m.state != "active")
        assert status.state == "succeeded"
        assert status.header.stamp * 1e-9 - began > 2 * trajectory.points[-1].time_from_start


@pytest.mark.parametrize(("age", "code", "said"), [
    (70.0, "stale_request", "s old"), (-30.0, "clock_ahead", "s ahead"), (None, "stale_request", "header.stamp"),
])
async def test_request_that_is_late_or_from_the_future_moves_nothing(
    robot: RobotModel, age: float | None, code: str, said: str
) -> None:
    home = robot.named("home")
    async with executor() as person:
        stamp = 0 if age is None else person.bus.clock.now_ns() - int(age * SPEED * 1e9)
        request = ExecuteRequest(header=Header(stamp=stamp), id="a", trajectory=move(robot, home, home + 0.2))
        answer = await person.execute.call(request)
        assert (answer.state, answer.error) == ("rejected", code) and said in answer.message
        assert (await person.follow("b", move(robot, home, home + 0.2))).state == "succeeded"


async def test_request_that_was_carried_out_is_not_again_when_it_is_replayed_later(robot: RobotModel) -> None:
    home = robot.named("home")
    net, clock, given = LocalNetwork(), Clock(SPEED), config()
    async with running_service(net, trajectory_executor.run, given, name="trajectory_executor", cell=CELL, clock=clock):
        person = Person(net, clock)
        there = person.asks(id="a", trajectory=move(robot, home, home + 0.2))
        assert (await person.execute.call(there)).state == "active"
        await person.see(person.motion, lambda m: m.id == "a" and m.state == "succeeded")
        await person.follow("b", move(robot, home + 0.2, home))
        given.request_timeout = 0.1
        late = there.header.stamp + 0.2 * SPEED * 1e9
        await person.see(person.joints, lambda s: s.header.stamp > late)
        assert (await person.execute.call(there)).state == "succeeded", "what became of it"
        again = there.model_copy(update={"id": "c"})
        assert (await person.execute.call(again)).error == "stale_request"


async def test_what_was_decided_before_it_began_may_have_been_done_and_is_not_done_again(robot: RobotModel) -> None:
    home = robot.named("home")
    net, clock, name = LocalNetwork(), Clock(SPEED), "trajectory_executor"
    async with running_service(net, trajectory_executor.run, config(), name=name, cell=CELL, clock=clock):
        person = Person(net, clock)
        there = person.asks(id="a", trajectory=move(robot, home, home + 0.2))
        close = GripperCommand(header=person.bus.header(), id="b", width=0.02)
    async with running_service(net, trajectory_executor.run, config(), name=name, cell=CELL, clock=clock):
        again = Person(net, clock)
        for answer in (await again.execute.call(there), await again.command.call(close)):
            assert (answer.state, answer.error) == ("rejected", "stale_request") and "began" in answer.message
        now = close.model_copy(update={"header": again.bus.header()})
        assert (await again.command.call(now.model_copy(update={"id": "c"}))).state == "active"
        assert (await again.command.call(GripperCommand(id="d", width=0.03))).state == "active", "nobody can know"


async def test_what_was_done_while_it_waited_for_the_arm_is_not_done_again(
    robot: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = robot.named("home")
    net, clock, name = LocalNetwork(), Clock(SPEED), "trajectory_executor"
    other, waits, has_it = LocalNetwork(), asyncio.Event(), asyncio.Event()
    owned = Bus.owned

    async def once_the_other_is_gone(bus: Bus) -> None:
        waits.set()
        await has_it.wait()
        await owned(bus)

    first, second = contextlib.AsyncExitStack(), contextlib.AsyncExitStack()
    async with second:
        async with first:
            await first.enter_async_context(
                running_service(net, trajectory_executor.run, config(), name=name, cell=CELL, clock=clock))
            monkeypatch.setattr(Bus, "owned", once_the_other_is_gone)
            waiting = asyncio.create_task(second.enter_async_context(
                running_service(other, trajectory_executor.run, config(), name=name, cell=CELL, clock=clock)))
            await waits.wait()
            person = Person(net, clock)
            there = person.asks(id="a", trajectory=move(robot, home, home + 0.2))
            assert (await person.execute.call(there)).state == "active"
            await person.see(person.motion, lambda m: m.id == "a" and m.state == "succeeded")
        has_it.set()
        await waiting
        answer = await Person(other, clock).execute.call(there)
        assert (answer.state, answer.error) == ("rejected", "stale_request") and "began" in answer.message


async def test_goal_outlives_its_requester(robot: RobotModel) -> None:
    home = robot.named("home")
    async with executor() as person:
        asking = asyncio.create_task(
            person.execute.call(person.asks(id="a", trajectory=move(robot, home, home + 0.3, 0.1))))
        await person.see(person.motion, lambda m: m.id == "a" and m.state == "active")
        asking.cancel()
        assert (await person.see(person.motion, lambda m: m.state != "active")).state == "succeeded"


def bad_execute(robot: RobotModel, **changes: object) -> bytes:
    home = robot.named("home")
    request = json.loads(ExecuteRequest(id="bad", trajectory=move(robot, home, home + 0.1)).model_dump_json())
    request["trajectory"]["points"][2].update(changes)
    return msgpack.packb(request)


@pytest.mark.parametrize("kind", ["garbage", "truncated", "another message", "nan", "short point"])
async def test_wrong_message_is_refused_and_the_next_one_served(robot: RobotModel, kind: str) -> None:
    home = robot.named("home")
    payload = {
        "garbage": b"\xc1\xff\x00",
        "truncated": bad_execute(robot)[:-20],
        "another message": msgpack.packb({"id": "a", "width": 0.05}),
        "nan": bad_execute(robot, positions=[float("nan")] * 7),
        "short point": bad_execute(robot, positions=[0.0] * 6),
    }[kind]
    net, clock = LocalNetwork(), Clock(SPEED)
    run = trajectory_executor.run
    async with running_service(net, run, config(), name="trajectory_executor", cell=CELL, clock=clock):
        replies: asyncio.Queue = asyncio.Queue()
        loop, session = asyncio.get_running_loop(), net.session()
        session.get(f"{CELL}/motion/execute", lambda reply: loop.call_soon_threadsafe(replies.put_nowait, reply),
                    lambda: None, payload=payload, encoding="application/msgpack;ExecuteRequest")
        async with asyncio.timeout(30):
            reply = await replies.get()
        assert reply.sample is None, "refused"
        person = Person(net, clock)
        assert (await person.follow("good", move(robot, home, home + 0.1))).state == "succeeded"
        session.close()


async def test_unknown_backend_stops_it_with_the_choices() -> None:
    with pytest.raises(UnknownName, match="choices: franka, lag, mock, ur"):
        async with executor("robot.hardware.backend=gazebo"):
            pass


@pytest.mark.parametrize("value", ["0", "0.04", "1.1"])
def test_speed_scaling_out_of_bounds_is_refused(value: str) -> None:
    with pytest.raises(ConfigError, match=r"services\.trajectory_executor\.speed_scaling"):
        config(f"services.trajectory_executor.speed_scaling={value}")


async def test_joint_states_go_on_while_a_long_trajectory_is_looked_at_and_a_stop_meanwhile_counts(
    robot: RobotModel, monkeypatch
) -> None:
    home = robot.named("home")
    there = move(robot, home, home + 0.3)
    still = [JointTrajectoryPoint(time_from_start=60.0 + i, positions=there.points[-1].positions, velocities=[0.0] * 7,
                                  accelerations=[0.0] * 7) for i in range(4000)]
    long = there.model_copy(update={"points": [*there.points, *still]})
    async with executor() as person:
        async with blocked(monkeypatch, Executor, "assess") as judging:
            asked = asyncio.create_task(person.execute.call(person.asks(id="long", trajectory=long)))
            await judging.wait()
            await goes_on(person)
            await person.stop.call(StopRequest(id="", by="operator", owner="anna"))
        answer = await asked
        assert (answer.state, answer.error) == ("rejected", "stopped")
        await person.hold.call(HoldRequest(hold=False, stops=True, owner="anna"))
        answer = await person.execute.call(person.asks(id="again", trajectory=long))
        assert answer.state == "active", answer.message
