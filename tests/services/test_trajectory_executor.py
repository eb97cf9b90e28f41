"""The executor's service: motions, rejected requests, restarts, and the simulated world behind it."""

import asyncio
import contextlib

import msgpack
import numpy as np
import pytest

from common.atomic_file import STATE_VARIABLE
from common.clock import Clock
from common.control.executor import Executor
from common.errors import ConfigError, UnknownName
from common.messages import GripperCommand, JointTrajectoryPoint, StopRequest, Vector3
from common.planning.ik import solve_ik
from common.robot.transforms import tool_down
from common.scene.workspace import unreachable_reason
from common.sim.interface import ObjectSnapshot
from common.sim.kinematic import KinematicWorld
from common.sim.state_file import SimulationState, StateFile, state_file
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from tests.services.executor_rig import (
    HOME,
    PANDA,
    ROBOT,
    SPEED,
    ExecutorClient,
    blocked,
    cycles_continue,
    executor,
    move,
    to_home_plus,
)
from tests.services.fake_cell import latest

NEAR = to_home_plus(0.2)
SCALING = "services.trajectory_executor.speed_scaling"


async def test_arm_starts_at_home_with_open_fingers_and_the_balls_of_the_world() -> None:
    async with executor("world.count=3") as client:
        state = await client.joints.next()
        assert state.name == [*ROBOT.joint_names, "panda_finger_joint1", "panda_finger_joint2"]
        assert np.allclose(state.position, [*HOME, 0.04, 0.04])
        balls = await latest(client.balls)
        assert balls.ids == ["ball_1", "ball_2", "ball_3"] and set(balls.labels) == {"table"}
        assert balls.header.frame_id == "world" and (await latest(client.motion)).state == "none"
        assert (await client.joints_after(state.header.stamp)).position == state.position


async def test_stop_brings_the_arm_to_standstill() -> None:
    async with executor() as client:
        await client.move_slowly()
        await client.stop.call(StopRequest(reason="tested"))
        status = await client.ended("a")
        assert (status.state, status.message) == ("cancelled", "tested") and status.progress < 0.9
        assert not any((await client.joints_after(status.header.stamp)).velocity)


async def test_speed_scaling_set_during_a_motion_slows_the_arm_down() -> None:
    async with executor() as client:
        trajectory, began = to_home_plus(0.15, scaling=0.05), client.clock.now()
        await client.start("a", trajectory)
        await latest(client.motion, lambda m: m.progress > 0.1)
        client.config.speed_scaling = 0.2
        await latest(client.motion, lambda m: m.speed_scaling == 0.2 and m.state == "active")
        status = await client.ended("a")
        assert status.state == "succeeded"
        assert status.header.stamp * 1e-9 - began > 2 * trajectory.points[-1].time_from_start


async def test_goal_continues_when_its_requester_is_gone() -> None:
    async with executor() as client:
        request = asyncio.create_task(client.start("a", to_home_plus(0.3, scaling=0.1)))
        await latest(client.motion, lambda m: m.id == "a" and m.state == "active")
        request.cancel()
        assert (await client.ended("a")).state == "succeeded"


@pytest.mark.parametrize(("override", "error"), [
    (f"{SCALING}=0", r"services\.trajectory_executor\.speed_scaling"), (f"{SCALING}=0.04", "speed_scaling"),
    (f"{SCALING}=1.1", "speed_scaling"), ("robot.hardware.backend=gazebo", "choices: franka, lag, mock, ur"),
    ("world.balls=[[0.55, 0.17]]", r"world\.objects: cannot be placed: ball_1"),
    ("services.workspace_validator.max_radius=-3", r"services\.workspace_validator\.max_radius: -3"),
])
async def test_invalid_configuration_ends_the_start_with_the_reason(override: str, error: str) -> None:
    with pytest.raises((ConfigError, UnknownName), match=error):
        async with executor("world.layout=random" if "max_radius" in override else "seed=1", override):
            pass


# --- rejected requests ---


async def test_rejected_trajectory_has_a_reason_and_the_next_one_is_followed() -> None:
    other = NEAR.model_copy(update={"joint_names": [f"ur5_{i}" for i in range(7)]})
    backwards = NEAR.model_copy(update={"points": [*NEAR.points[:5], NEAR.points[3], *NEAR.points[6:]]})
    async with executor() as client:
        def ago(seconds: float) -> int:
            return client.clock.now_ns() - int(seconds * SPEED * 1e9)

        for code, words, trajectory, stamp in (
            ("start_mismatch", "", to_home_plus(0.2, start=0.1), ago(0)), ("joint_names", "", other, ago(0)),
            ("bad_times", "", backwards, ago(0)), ("stale_request", "s old", NEAR, ago(70)),
            ("clock_ahead", "in the future", NEAR, ago(-30)), ("stale_request", "header.stamp", NEAR, 0),
        ):
            answer = await client.start(f"{code} {words}", trajectory, stamp)
            assert (answer.state, answer.error) == ("rejected", code) and answer.message and words in answer.message
        await client.follow("good", NEAR)


async def test_replayed_request_returns_the_state_of_its_goal_and_is_stale_under_another_id() -> None:
    async with executor() as client:
        there = client.request("a", NEAR)
        assert (await client.execute.call(there)).state == "active"
        assert (await client.ended("a")).state == "succeeded"
        await client.follow("b", to_home_plus(0.0, start=0.2))
        client.config.request_timeout = 0.1
        await client.joints_after(there.header.stamp + 0.2 * SPEED * 1e9)
        again = await client.execute.call(there)
        assert (again.id, again.state) == ("a", "succeeded")
        assert (await client.execute.call(there.model_copy(update={"id": "c"}))).error == "stale_request"
        state = await client.joints_after(client.clock.now_ns())
        assert np.allclose(state.position[:7], HOME) and not any(state.velocity), "nothing moves"


async def test_request_from_before_the_start_may_have_been_executed_and_is_rejected() -> None:
    async with executor() as client:
        there = client.request("a", NEAR)
        close = GripperCommand(header=client.bus.header(), id="b", width=0.02)
    async with executor(clock=client.clock) as client:
        for answer in (await client.execute.call(there), await client.command.call(close)):
            assert (answer.state, answer.error) == ("rejected", "stale_request")
            assert "before the executor started" in answer.message
        now = close.model_copy(update={"header": client.bus.header(), "id": "c"})
        assert (await client.command.call(now)).state == "active"
        assert (await client.command.call(GripperCommand(id="d", width=0.03))).state == "active", "without a stamp"


async def test_request_executed_by_an_earlier_executor_while_this_one_waited_is_rejected(monkeypatch):
    clock, other = Clock(SPEED), LocalNetwork()
    waits, may_continue, acquire = asyncio.Event(), asyncio.Event(), Bus.acquire_keys

    async def after_the_other(bus: Bus) -> None:
        waits.set()
        await may_continue.wait()
        await acquire(bus)

    async with contextlib.AsyncExitStack() as second:
        async with executor(clock=clock) as client:
            monkeypatch.setattr(Bus, "acquire_keys", after_the_other)
            waiting = asyncio.create_task(second.enter_async_context(executor(clock=clock, net=other)))
            await waits.wait()
            there = client.request("a", NEAR)
            assert (await client.execute.call(there)).state == "active"
            assert (await client.ended("a")).state == "succeeded"
        may_continue.set()
        await waiting
        answer = await ExecutorClient(clock, other).execute.call(there)
        assert (answer.state, answer.error) == ("rejected", "stale_request")
        assert "before the executor started" in answer.message


def packed(**changes: object) -> bytes:
    request = {"id": "bad", "trajectory": NEAR.model_dump()}
    request["trajectory"]["points"][2].update(changes)
    return msgpack.packb(request)


async def test_undecodable_request_is_rejected_and_the_next_one_served() -> None:
    async with executor() as client:
        replies: asyncio.Queue = asyncio.Queue()
        loop, session = asyncio.get_running_loop(), client.net.session()
        for payload in (b"\xc1\xff\x00", packed()[:-20], msgpack.packb({"id": "a", "width": 0.05}),
                        packed(positions=[float("nan")] * 7), packed(positions=[0.0] * 6)):
            session.get("test/motion/execute", lambda reply: loop.call_soon_threadsafe(replies.put_nowait, reply),
                        lambda: None, payload=payload, encoding="application/msgpack;ExecuteRequest")
            assert (await asyncio.wait_for(replies.get(), 20)).sample is None, payload
        await client.follow("good", NEAR)
        session.close()


# --- cycles continue during slow work ---


async def test_cycles_continue_while_a_long_trajectory_is_checked_and_a_stop_meanwhile_counts(monkeypatch) -> None:
    rest = [JointTrajectoryPoint(time_from_start=60.0 + i, positions=NEAR.points[-1].positions, velocities=[0.0] * 7,
                                 accelerations=[0.0] * 7) for i in range(4000)]
    long = NEAR.model_copy(update={"points": [*NEAR.points, *rest]})
    async with executor() as client:
        async with blocked(monkeypatch, Executor, "assess") as assessing:
            request = asyncio.create_task(client.start("long", long))
            await assessing.wait()
            await cycles_continue(client)
            await client.stop.call(StopRequest(owner="anna"))
        answer = await request
        assert (answer.state, answer.error) == ("rejected", "stopped")
        await client.release("anna", stops=True)
        answer = await client.start("again", long)
        assert answer.state == "active", answer.message


async def test_cycles_continue_while_an_edit_of_the_world_is_computed(monkeypatch) -> None:
    async with executor() as client:
        async with blocked(monkeypatch, KinematicWorld, "edit") as editing:
            request = asyncio.create_task(client.edit(60, op="add", shape="box", size=Vector3(x=0.02, y=0.02, z=0.02),
                                                      position=Vector3(x=0.35, y=-0.4)))
            await editing.wait()
            await cycles_continue(client)
        assert (await request).id == "box_1"
        await latest(client.objects, lambda found: "box_1" in [each.id for each in found.objects])


async def test_cycles_continue_while_the_disk_for_the_simulated_world_hangs(monkeypatch, persistent: None) -> None:
    async with executor() as client, blocked(monkeypatch, StateFile, "save") as saving:
        await client.start("1", NEAR)
        await saving.wait()
        assert (await client.ended("1")).state == "succeeded"
        await cycles_continue(client)
    async with executor() as client:
        assert np.allclose((await client.joints.next()).position[:7], HOME + 0.2, atol=2e-3), "the newest was saved"


# --- the simulated world ---


def above_and_at(x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
    """Return joint positions above a ball and with the fingers around it."""
    above = solve_ik(ROBOT, tool_down(x, y, 0.2), HOME)
    return above, solve_ik(ROBOT, tool_down(x, y, 0.03), above)


async def test_ball_is_picked_up_and_dropped_into_the_box() -> None:
    above, at_ball = above_and_at(0.5, 0.0)
    over_box = solve_ik(ROBOT, tool_down(0.55, 0.25, 0.25), HOME)
    async with executor("robot.hardware.backend=lag", "world.balls=[[0.5, 0.0]]") as client:
        await client.follow("1", move(ROBOT, HOME, above))
        await client.follow("2", move(ROBOT, above, at_ball))
        closed = await client.grip("3", 0.0)
        assert closed.holding and closed.width == pytest.approx(0.06)
        await client.follow("4", move(ROBOT, at_ball, above))
        await client.follow("5", move(ROBOT, above, over_box))
        assert (await latest(client.balls, lambda b: b.labels == ["held"])).poses[0].position.z > 0.1
        assert not (await client.grip("6", 0.08)).holding
        dropped = await latest(client.balls, lambda b: b.labels == ["box"])
        assert dropped.poses[0].position.z == pytest.approx(0.035)
        assert [(await client.updates.next()).data for _ in range(2)] == ["remove:ball_1", "add:ball_1"]


async def random_balls(*overrides: str):
    async with executor("world.layout=random", *overrides) as client:
        return await latest(client.balls)


async def test_random_layout_follows_the_seed_and_the_reach_of_robot_and_validator() -> None:
    one, two = await random_balls("seed=20"), await random_balls("seed=20")
    assert one.poses == two.poses and len(one.ids) == 7
    for p in (pose.position for pose in one.poses):
        for scale in (1 + off / float(np.hypot(p.x, p.y)) for off in (-0.005, 0.0, 0.005)):  # detected a little off
            assert not unreachable_reason(ROBOT, (p.x * scale, p.y * scale, p.z), PANDA.grasp)
    limits = (f"services.workspace_validator.{name}" for name in ("max_radius=0.52", "min_radius=0.3"))
    near = await random_balls("world.count=4", *limits)
    assert all(0.3 <= np.hypot(p.position.x, p.position.y) <= 0.52 for p in near.poses) and len(near.poses) == 4


# --- restarts: simulated hardware persists, as a real arm and a real table do ---


@pytest.fixture
def persistent(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))


async def test_arm_gripper_and_held_ball_are_found_as_they_were_before_a_restart(persistent):
    above, at_ball = above_and_at(*PANDA.world.spots[3])
    async with executor() as client:
        await client.follow("a", move(ROBOT, HOME, above))
        await client.follow("b", move(ROBOT, above, at_ball))
        assert (await client.grip("close", 0.0)).holding
        await client.follow("c", move(ROBOT, at_ball, above))
        before = await latest(client.balls, lambda b: "held" in b.labels)
        joints, gripper = client.joints.latest, client.gripper.latest
    async with executor() as client:
        assert (await latest(client.joints)).position == pytest.approx(joints.position, abs=1e-3)
        again = await latest(client.gripper)
        assert again.holding and again.width == pytest.approx(gripper.width) and again.state == "none"
        balls = await latest(client.balls)
        assert dict(zip(balls.ids, balls.labels, strict=True)) == dict(zip(before.ids, before.labels, strict=True))
        held = balls.ids[balls.labels.index("held")]
        await client.follow("d", move(ROBOT, above, HOME))
        await client.grip("open", 0.08)
        balls = await latest(client.balls, lambda b: b.labels[b.ids.index(held)] == "table")
        assert len(balls.ids) == len(before.ids)


async def test_saved_state_of_another_layout_or_simulator_is_not_used(persistent, caplog):
    caplog.set_level("INFO")
    async with executor() as client:
        await client.follow("a", NEAR)
    async with executor("world.balls=[[0.5, 0.0]]") as client:
        assert len((await latest(client.balls)).ids) == 1
        assert (await latest(client.joints)).position[:7] == pytest.approx(HOME)
    assert "as they were" not in caplog.text
    async with executor("world.balls=[[0.5, 0.0]]"):
        assert "as they were" in caplog.text
    layout = KinematicWorld(PANDA.world).layout
    falling = {name: ObjectSnapshot(pose=(*position, 0, 0, 0, 1), details={
        "state": "falling", "container": "", "slot": None, "grip": None, "width": 0.0, "dropped": 0.0, "since": 0.0,
        "added": False, "rest": None}) for name, position in layout.items()}
    state = SimulationState(simulator="mujoco", layout=layout, q=(HOME + 0.2).tolist(), objects=falling)
    state_file("test").save(state)
    async with executor() as client:
        assert set((await latest(client.balls)).labels) == {"table"}
        assert (await latest(client.joints)).position[:7] == pytest.approx(HOME)
