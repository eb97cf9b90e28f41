"""The executor's service: motions, refusals, restarts, and the simulated world behind it."""

import asyncio
import contextlib
import json

import msgpack
import numpy as np
import pytest

from applications.pick_place.topics import SCENE_BALLS
from common import topics
from common.atomic_file import STATE_VARIABLE
from common.clock import Clock
from common.config import load_cell
from common.control.executor import Executor
from common.errors import ConfigError, RemoteError, UnknownName
from common.messages import (
    ExecuteRequest,
    GripperCommand,
    Header,
    JointTrajectoryPoint,
    StopRequest,
    Vector3,
    WorldEdit,
)
from common.planning.ik import solve_ik
from common.process.in_process import running_service
from common.robot.model import RobotModel
from common.robot.transforms import tool_down
from common.scene.workspace import unreachable_reason
from common.sim.interface import ObjectSnapshot
from common.sim.kinematic import KinematicWorld
from common.sim.state_file import SimulationState, StateFile, state_file
from common.supervision.wiring import wiring
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from services import trajectory_executor
from tests.services.executor_rig import (
    CELL,
    NAME,
    SPEED,
    ExecutorClient,
    blocked,
    config,
    cycles_continue,
    executor,
    move,
)


async def test_topics_and_requests_of_the_executor() -> None:
    found = await wiring(trajectory_executor.run, config())
    assert found.reads == {topics.MOTION_JOG} and found.calls == set()
    assert found.writes == {topics.JOINT_STATES, topics.MOTION_STATUS, topics.MOTION_OWNER, topics.ROBOT_STATUS,
                            topics.GRIPPER_STATE, SCENE_BALLS, topics.SCENE_OBJECTS, topics.SCENE_OBJECT_UPDATES}
    assert found.serves == {topics.MOTION_EXECUTE, topics.MOTION_FOLLOWED, topics.MOTION_STOP, topics.MOTION_HOLD,
                            topics.MOTION_OWN, topics.ROBOT_COMMAND, topics.GRIPPER_COMMAND, topics.WORLD_EDIT}


async def test_arm_starts_at_home_with_open_fingers_and_the_balls_of_the_world(robot: RobotModel) -> None:
    async with executor("world.count=3") as client:
        state = await client.joints.next()
        assert state.name == [*robot.joint_names, "panda_finger_joint1", "panda_finger_joint2"]
        assert np.allclose(state.position, [*robot.named("home"), 0.04, 0.04])
        balls = await client.wait_for(client.balls)
        assert balls.ids == ["ball_1", "ball_2", "ball_3"] and set(balls.labels) == {"table"}
        assert balls.header.frame_id == "world"
        later = await client.wait_for(client.joints, lambda s: s.header.stamp > state.header.stamp)
        assert (await client.wait_for(client.motion)).state == "none"
        assert later.position == state.position


async def test_repeated_goal_returns_its_state_and_moves_nothing(robot: RobotModel) -> None:
    home = robot.named("home")
    there = move(robot, home, home + 0.2)
    async with executor() as client:
        await client.follow("a", there)
        again = await client.start("a", there)
        assert (again.id, again.state) == ("a", "succeeded")
        state = await client.wait_for(client.joints, lambda s: s.header.stamp > again.header.stamp)
        assert np.allclose(state.position[:7], home + 0.2) and not any(state.velocity)


async def test_refused_trajectories_are_answered_with_the_reason_and_the_next_is_followed(robot: RobotModel) -> None:
    home = robot.named("home")
    good = move(robot, home, home + 0.2)
    elsewhere = move(robot, home + 0.1, home + 0.2)
    other = good.model_copy(update={"joint_names": [f"ur5_{i}" for i in range(7)]})
    backwards = good.model_copy(update={"points": [*good.points[:5], good.points[3], *good.points[6:]]})
    async with executor() as client:
        for code, trajectory in (("start_mismatch", elsewhere), ("joint_names", other), ("bad_times", backwards)):
            answer = await client.start(code, trajectory)
            assert (answer.state, answer.error) == ("rejected", code) and answer.message
        assert (await client.follow("good", good)).state == "succeeded"


async def test_stop_brings_the_arm_to_rest(robot: RobotModel) -> None:
    async with executor() as client:
        await client.move_slowly(robot)
        await client.stop.call(StopRequest(reason="tested"))
        status = await client.ended("a")
        assert (status.state, status.message) == ("cancelled", "tested") and status.progress < 0.9
        state = await client.wait_for(client.joints, lambda s: s.header.stamp > status.header.stamp)
        assert not any(state.velocity)


@pytest.mark.slow
async def test_speed_scaling_set_during_a_motion_slows_the_arm_down(robot: RobotModel) -> None:
    home = robot.named("home")
    async with executor() as client:
        trajectory, began = move(robot, home, home + 0.5, 0.02), client.bus.clock.now()
        await client.start("a", trajectory)
        await client.wait_for(client.motion, lambda m: m.progress > 0.1)
        client.config.speed_scaling = 0.2
        await client.wait_for(client.motion, lambda m: m.speed_scaling == 0.2 and m.state == "active")
        status = await client.ended("a")
        assert status.state == "succeeded"
        assert status.header.stamp * 1e-9 - began > 2 * trajectory.points[-1].time_from_start


@pytest.mark.parametrize("value", ["0", "0.04", "1.1"])
def test_speed_scaling_out_of_bounds_is_refused(value: str) -> None:
    with pytest.raises(ConfigError, match=r"services\.trajectory_executor\.speed_scaling"):
        config(f"services.trajectory_executor.speed_scaling={value}")


async def test_unknown_backend_ends_the_start_with_the_choices() -> None:
    with pytest.raises(UnknownName, match="choices: franka, lag, mock, ur"):
        async with executor("robot.hardware.backend=gazebo"):
            pass


async def test_goal_continues_when_its_requester_is_gone(robot: RobotModel) -> None:
    home = robot.named("home")
    async with executor() as client:
        request = asyncio.create_task(client.start("a", move(robot, home, home + 0.3, 0.1)))
        await client.wait_for(client.motion, lambda m: m.id == "a" and m.state == "active")
        request.cancel()
        assert (await client.ended("a")).state == "succeeded"


# --- age of requests ---


@pytest.mark.parametrize(("age", "code", "message"), [
    (70.0, "stale_request", "s old"), (-30.0, "clock_ahead", "in the future"), (None, "stale_request", "header.stamp"),
])
async def test_late_request_or_one_from_the_future_moves_nothing(
    robot: RobotModel, age: float | None, code: str, message: str
) -> None:
    home = robot.named("home")
    async with executor() as client:
        stamp = 0 if age is None else client.bus.clock.now_ns() - int(age * SPEED * 1e9)
        request = ExecuteRequest(header=Header(stamp=stamp), id="a", trajectory=move(robot, home, home + 0.2))
        answer = await client.execute.call(request)
        assert (answer.state, answer.error) == ("rejected", code) and message in answer.message
        assert (await client.follow("b", move(robot, home, home + 0.2))).state == "succeeded"


async def test_replayed_request_returns_the_state_of_its_goal_and_is_stale_under_another_id(robot: RobotModel) -> None:
    home = robot.named("home")
    async with executor() as client:
        there = client.request("a", move(robot, home, home + 0.2))
        assert (await client.execute.call(there)).state == "active"
        assert (await client.ended("a")).state == "succeeded"
        await client.follow("b", move(robot, home + 0.2, home))
        client.config.request_timeout = 0.1
        late = there.header.stamp + 0.2 * SPEED * 1e9
        await client.wait_for(client.joints, lambda s: s.header.stamp > late)
        assert (await client.execute.call(there)).state == "succeeded"
        assert (await client.execute.call(there.model_copy(update={"id": "c"}))).error == "stale_request"


async def test_request_from_before_the_start_may_have_been_executed_and_is_refused(robot: RobotModel) -> None:
    home = robot.named("home")
    async with executor() as client:
        there = client.request("a", move(robot, home, home + 0.2))
        close = GripperCommand(header=client.bus.header(), id="b", width=0.02)
    async with executor(clock=client.bus.clock) as client:
        for answer in (await client.execute.call(there), await client.command.call(close)):
            assert (answer.state, answer.error) == ("rejected", "stale_request")
            assert "before the executor started" in answer.message
        now = close.model_copy(update={"header": client.bus.header(), "id": "c"})
        assert (await client.command.call(now)).state == "active"
        assert (await client.command.call(GripperCommand(id="d", width=0.03))).state == "active", "without a stamp"


async def test_request_executed_by_an_earlier_executor_while_this_one_waited_is_refused(
    robot: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = robot.named("home")
    net, other, clock = LocalNetwork(), LocalNetwork(), Clock(SPEED)
    waits, may_continue, owned = asyncio.Event(), asyncio.Event(), Bus.acquire_keys

    async def after_the_other(bus: Bus) -> None:
        waits.set()
        await may_continue.wait()
        await owned(bus)

    def run_on(network: LocalNetwork):
        return running_service(network, trajectory_executor.run, config(), name=NAME, cell=CELL, clock=clock)

    async with contextlib.AsyncExitStack() as second:
        async with run_on(net):
            monkeypatch.setattr(Bus, "acquire_keys", after_the_other)
            waiting = asyncio.create_task(second.enter_async_context(run_on(other)))
            await waits.wait()
            client = ExecutorClient(net, clock)
            there = client.request("a", move(robot, home, home + 0.2))
            assert (await client.execute.call(there)).state == "active"
            assert (await client.ended("a")).state == "succeeded"
        may_continue.set()
        await waiting
        answer = await ExecutorClient(other, clock).execute.call(there)
        assert (answer.state, answer.error) == ("rejected", "stale_request")
        assert "before the executor started" in answer.message


# --- invalid messages ---


def bad_execute(robot: RobotModel, **changes: object) -> bytes:
    home = robot.named("home")
    request = json.loads(ExecuteRequest(id="bad", trajectory=move(robot, home, home + 0.1)).model_dump_json())
    request["trajectory"]["points"][2].update(changes)
    return msgpack.packb(request)


@pytest.mark.parametrize("kind", ["garbage", "truncated", "another message", "nan", "short point"])
async def test_invalid_message_is_refused_and_the_next_one_served(robot: RobotModel, kind: str) -> None:
    home = robot.named("home")
    payload = {
        "garbage": b"\xc1\xff\x00",
        "truncated": bad_execute(robot)[:-20],
        "another message": msgpack.packb({"id": "a", "width": 0.05}),
        "nan": bad_execute(robot, positions=[float("nan")] * 7),
        "short point": bad_execute(robot, positions=[0.0] * 6),
    }[kind]
    async with executor() as client:
        replies: asyncio.Queue = asyncio.Queue()
        loop, session = asyncio.get_running_loop(), client.net.session()
        session.get(f"{CELL}/motion/execute", lambda reply: loop.call_soon_threadsafe(replies.put_nowait, reply),
                    lambda: None, payload=payload, encoding="application/msgpack;ExecuteRequest")
        async with asyncio.timeout(30):
            reply = await replies.get()
        assert reply.sample is None, "refused"
        assert (await client.follow("good", move(robot, home, home + 0.1))).state == "succeeded"
        session.close()


async def test_cycles_continue_while_a_long_trajectory_is_checked_and_a_stop_meanwhile_counts(
    robot: RobotModel, monkeypatch
) -> None:
    home = robot.named("home")
    there = move(robot, home, home + 0.3)
    rest = [JointTrajectoryPoint(time_from_start=60.0 + i, positions=there.points[-1].positions, velocities=[0.0] * 7,
                                 accelerations=[0.0] * 7) for i in range(4000)]
    long = there.model_copy(update={"points": [*there.points, *rest]})
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


# --- the simulated world ---


@pytest.mark.parametrize("backend", ["mock", "lag"])
async def test_ball_is_picked_up_and_dropped_into_the_box(robot: RobotModel, backend: str) -> None:
    home = robot.named("home")
    above, at, over = (solve_ik(robot, tool_down(*position), home) for position in
                       ((0.5, 0.0, 0.15), (0.5, 0.0, 0.03), (0.55, 0.25, 0.25)))
    async with executor(f"robot.hardware.backend={backend}", "world.balls=[[0.5, 0.0]]") as client:
        for goal, start, end in (("1", home, above), ("2", above, at)):
            assert (await client.follow(goal, move(robot, start, end))).state == "succeeded"
        closed = await client.grip("3", 0.0)
        assert closed.holding and closed.width == pytest.approx(0.06)
        for goal, start, end in (("4", at, above), ("5", above, over)):
            assert (await client.follow(goal, move(robot, start, end))).state == "succeeded"
        assert (await client.wait_for(client.balls, lambda b: b.labels == ["held"])).poses[0].position.z > 0.1
        assert not (await client.grip("6", 0.08)).holding
        dropped = await client.wait_for(client.balls, lambda b: b.labels == ["box"])
        assert dropped.poses[0].position.z == pytest.approx(0.035)
        assert [(await client.updates.next()).data for _ in range(2)] == ["remove:ball_1", "add:ball_1"]


async def test_world_edits_change_the_truth_and_invalid_ones_are_refused() -> None:
    async with executor("world.count=2") as client:
        reply = await client.edit.call(WorldEdit(op="add", position=Vector3(x=0.4, y=0.2)))
        assert reply.id == "ball_3" and reply.ids == ["ball_1", "ball_2", "ball_3"]
        await client.wait_for(client.balls, lambda b: len(b.ids) == 3)
        with pytest.raises(RemoteError) as refusal:
            await client.edit.call(WorldEdit(op="remove", id="ball_9"))
        assert refusal.value.code == "unknown_id" and "ball_3" in refusal.value.message
        await client.edit.call(WorldEdit(op="remove", id="ball_3"))
        await client.wait_for(client.balls, lambda b: len(b.ids) == 2)


@pytest.mark.parametrize(("overrides", "error"), [
    (["world.balls=[[0.55, 0.17]]"], r"world\.objects: cannot be placed: ball_1"),
    (["world.layout=random", "services.workspace_validator.max_radius=-3"],
     r"services\.workspace_validator\.max_radius: -3"),
])
async def test_impossible_layout_ends_the_start_with_the_reason(overrides: list[str], error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        async with executor(*overrides):
            pass


async def random_balls(*overrides: str):
    async with executor("world.layout=random", *overrides) as client:
        return await client.wait_for(client.balls)


async def test_random_layout_follows_the_seed_and_is_within_reach() -> None:
    one, two = await random_balls("seed=4"), await random_balls("seed=4")
    assert one.poses == two.poses and len(one.ids) == 7
    assert all(0.18 <= np.hypot(p.position.x, p.position.y) <= 0.82 for p in one.poses)


async def test_random_layout_keeps_the_reach_configured_for_the_services_of_the_cell() -> None:
    limits = ("services.workspace_validator.max_radius=0.52", "services.workspace_validator.min_radius=0.3")
    found = await random_balls("world.count=4", *limits)
    assert all(0.3 <= np.hypot(p.position.x, p.position.y) <= 0.52 for p in found.poses) and len(found.poses) == 4


async def test_random_layout_is_within_reach_also_at_positions_detected_a_few_millimetres_off() -> None:
    cell = load_cell("panda")
    robot = RobotModel.load(cell.robot)
    found = await random_balls("seed=20", "world.count=8")
    for p in (pose.position for pose in found.poses):
        for scale in (1 + off / float(np.hypot(p.x, p.y)) for off in (-0.005, 0.005)):
            assert not unreachable_reason(robot, (p.x * scale, p.y * scale, p.z), cell.grasp)


async def test_cycles_continue_while_an_edit_of_the_world_is_computed(monkeypatch) -> None:
    box = WorldEdit(op="add", shape="box", size=Vector3(x=0.02, y=0.02, z=0.02), position=Vector3(x=0.35, y=-0.4))
    async with executor() as client:
        async with blocked(monkeypatch, KinematicWorld, "edit") as editing:
            request = asyncio.create_task(client.edit.call(box, timeout=60))
            await editing.wait()
            await cycles_continue(client)
        assert (await request).id == "box_1"
        objects = client.bus.reader(topics.SCENE_OBJECTS)
        await client.wait_for(objects, lambda found: "box_1" in [each.id for each in found.objects])


# --- restarts: simulated hardware persists, as a real arm and a real table do ---


@pytest.fixture
def persistent(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))


async def test_arm_gripper_and_held_ball_are_found_as_they_were_before_a_restart(
    robot: RobotModel, persistent: None
) -> None:
    home, world = robot.named("home"), load_cell("panda").world
    x, y = world.spots[3]
    above = solve_ik(robot, tool_down(x, y, 0.2), home)
    at_ball = solve_ik(robot, tool_down(x, y, world.ball_radius), above)
    async with executor() as client:
        await client.follow("a", move(robot, home, above))
        await client.follow("b", move(robot, above, at_ball))
        assert (await client.grip("close", 0.0)).holding
        await client.follow("c", move(robot, at_ball, above))
        before = await client.wait_for(client.balls, lambda b: "held" in b.labels)
        joints, gripper = await client.wait_for(client.joints), client.gripper.latest
    async with executor() as client:
        assert (await client.wait_for(client.joints)).position == pytest.approx(joints.position, abs=1e-3)
        again = await client.wait_for(client.gripper)
        assert again.holding and again.width == pytest.approx(gripper.width) and again.state == "none"
        balls = await client.wait_for(client.balls)
        assert dict(zip(balls.ids, balls.labels, strict=True)) == dict(zip(before.ids, before.labels, strict=True))
        await client.follow("d", move(robot, above, home))
        held = balls.ids[balls.labels.index("held")]
        await client.grip("open", 0.08)
        balls = await client.wait_for(client.balls, lambda b: b.labels[b.ids.index(held)] == "table")
        assert len(balls.ids) == len(before.ids)


async def test_saved_state_of_another_layout_is_not_used(
    robot: RobotModel, persistent: None, caplog: pytest.LogCaptureFixture
) -> None:
    home = robot.named("home")
    caplog.set_level("INFO")
    async with executor() as client:
        await client.follow("a", move(robot, home, home + 0.2))
    async with executor("world.balls=[[0.5, 0.0]]") as client:
        assert len((await client.wait_for(client.balls)).ids) == 1
        assert (await client.wait_for(client.joints)).position[: robot.dof] == pytest.approx(home)
    assert "as they were" not in caplog.text
    async with executor("world.balls=[[0.5, 0.0]]"):
        assert "as they were" in caplog.text


async def test_saved_state_of_another_simulator_is_not_used(robot: RobotModel, persistent: None) -> None:
    home, world = robot.named("home"), load_cell("panda").world
    layout = KinematicWorld(world).layout
    falling = {name: ObjectSnapshot(pose=(*position, 0, 0, 0, 1), details={
        "state": "falling", "container": "", "slot": None, "grip": None, "width": 0.0, "dropped": 0.0, "since": 0.0,
        "added": False, "rest": None}) for name, position in layout.items()}
    file = state_file(CELL)
    assert file is not None
    file.save(SimulationState(simulator="mujoco", layout=layout, q=(home + 0.2).tolist(), objects=falling))
    async with executor() as client:
        assert set((await client.wait_for(client.balls)).labels) == {"table"}
        assert (await client.wait_for(client.joints)).position[: robot.dof] == pytest.approx(home)


async def test_cycles_continue_while_the_disk_for_the_simulated_world_hangs(
    robot: RobotModel, monkeypatch, persistent: None
) -> None:
    home = robot.named("home")
    async with executor() as client, blocked(monkeypatch, StateFile, "save") as saving:
        await client.start("1", move(robot, home, home + 0.1))
        await saving.wait()
        assert (await client.ended("1")).state == "succeeded"
        await cycles_continue(client)
    async with executor() as client:
        assert np.allclose((await client.joints.next()).position[:7], home + 0.1, atol=2e-3), "the newest was saved"
