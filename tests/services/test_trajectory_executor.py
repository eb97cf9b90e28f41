import asyncio
import errno
import json
import os
import threading
from contextlib import asynccontextmanager

import msgpack
import numpy as np
import pytest
import ruckig

from common import topics
from common.applications.pick_place.topics import SCENE_BALLS
from common.clock import Clock
from common.config import load_cell, service_config
from common.control import decisions, sole_use
from common.control.cycle import ControlCycle
from common.control.record_file import RecordFile
from common.errors import ConfigError, RemoteError, UnknownName
from common.messages import (
    ExecuteRequest,
    GripperCommand,
    Header,
    HoldRequest,
    JointTrajectory,
    JointTrajectoryPoint,
    ParameterRequest,
    RobotCommand,
    StopRequest,
    Vector3,
    WorldEdit,
)
from common.planning.ik import solve_ik
from common.process.in_process import running_service
from common.process.wiring import wiring
from common.robot.model import RobotModel
from common.robot.transforms import tool_down
from common.scene.workspace import reach_reason
from common.sim.kinematic import KinematicWorld
from common.sim.standing import STANDING_VARIABLE, STATE_VARIABLE, StateFile
from common.transport.local import LocalNetwork
from services import trajectory_executor
from services.trajectory_executor import Config
from tests.doubles import stopping_arm

CELL = "test"
SPEED = 10.0


PATIENT = "services.trajectory_executor.request_timeout=60"  # a busy machine is no reason to refuse


def config(*overrides: str) -> Config:
    return service_config(load_cell("panda", [PATIENT, *overrides]), "trajectory_executor", Config)


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return RobotModel.load(load_cell("panda").robot)


class Person:
    """Somebody outside who sees and asks."""

    def __init__(self, net: LocalNetwork, clock: Clock) -> None:
        self.bus = net.bus("tester", cell=CELL, clock=clock)
        self.joints = self.bus.reader(topics.JOINT_STATES)
        self.motion = self.bus.reader(topics.MOTION_STATUS)
        self.gripper = self.bus.reader(topics.GRIPPER_STATE)
        self.balls = self.bus.reader(SCENE_BALLS)
        self.updates = self.bus.reader(topics.SCENE_OBJECT_UPDATES)
        self.execute = self.bus.client(topics.MOTION_EXECUTE)
        self.stop = self.bus.client(topics.MOTION_STOP)
        self.hold = self.bus.client(topics.MOTION_HOLD)
        self.command = self.bus.client(topics.GRIPPER_COMMAND)
        self.edit = self.bus.client(topics.WORLD_EDIT)

    async def see(self, reader, test):
        """The first message for which test is true."""
        async with asyncio.timeout(20):
            message = reader.latest
            while message is None or not test(message):
                message = await reader.next()
            return message

    def asks(self, **fields):
        return ExecuteRequest(header=self.bus.header(), **fields)

    async def follow(self, goal, trajectory):
        answer = await self.execute.call(self.asks(id=goal, trajectory=trajectory))
        assert answer.state == "active", answer.message
        return await self.see(self.motion, lambda m: m.id == goal and m.state != "active")

    async def grip(self, goal, width):
        await self.command.call(GripperCommand(id=goal, width=width))
        return await self.see(self.gripper, lambda g: g.id == goal and g.state != "active" and not g.moving)


@asynccontextmanager
async def executor(*overrides: str, speed: float = SPEED):
    net, clock = LocalNetwork(), Clock(speed)
    given = config(*overrides)
    async with running_service(net, trajectory_executor.run, given, name="trajectory_executor", cell=CELL, clock=clock):
        yield Person(net, clock)


def move(robot: RobotModel, start, end, scaling=0.5) -> JointTrajectory:
    """A point-to-point motion within the robot's limits."""
    asked = ruckig.InputParameter(robot.dof)
    asked.current_position, asked.target_position = list(start), list(end)
    asked.max_velocity = list(robot.velocity * scaling)
    asked.max_acceleration = list(robot.acceleration * scaling)
    asked.max_jerk = list(robot.jerk * scaling)
    found = ruckig.Trajectory(robot.dof)
    ruckig.Ruckig(robot.dof).calculate(asked, found)
    points = []
    for t in np.linspace(0.0, found.duration, max(2, round(found.duration / 0.02))):
        q, dq, ddq = found.at_time(float(t))
        points.append(JointTrajectoryPoint(time_from_start=float(t), positions=q, velocities=dq, accelerations=ddq))
    return JointTrajectory(joint_names=robot.joint_names, points=points)


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


@pytest.mark.parametrize("backend", ["mock", "lag"])
async def test_ball_is_picked_up_and_dropped_into_the_box(robot: RobotModel, backend: str) -> None:
    home = robot.named("home")
    above, at, over = (solve_ik(robot, tool_down(*place), home) for place in
                       ((0.5, 0.0, 0.15), (0.5, 0.0, 0.03), (0.55, 0.25, 0.25)))
    async with executor(f"robot.hardware.backend={backend}", "world.balls=[[0.5, 0.0]]") as person:
        assert (await person.follow("1", move(robot, home, above))).state == "succeeded"
        assert (await person.follow("2", move(robot, above, at))).state == "succeeded"
        closed = await person.grip("3", 0.0)
        assert closed.holding and closed.width == pytest.approx(0.06)
        assert (await person.follow("4", move(robot, at, above))).state == "succeeded"
        assert (await person.follow("5", move(robot, above, over))).state == "succeeded"
        assert (await person.see(person.balls, lambda b: b.labels == ["held"])).poses[0].position.z > 0.1
        assert not (await person.grip("6", 0.08)).holding
        dropped = await person.see(person.balls, lambda b: b.labels == ["box"])
        assert dropped.poses[0].position.z == pytest.approx(0.035)
        assert [(await person.updates.next()).data for _ in range(2)] == ["remove:ball_1", "add:ball_1"]


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


async def test_held_arm_stands_still_whoever_asked_for_it_and_goes_on_when_let_go(robot: RobotModel) -> None:
    home = robot.named("home")
    async with executor() as person:
        await person.execute.call(person.asks(id="a", trajectory=move(robot, home, home + 0.5, 0.02)))
        await person.see(person.motion, lambda m: m.progress > 0.2)
        asking = asyncio.create_task(person.hold.call(HoldRequest(hold=True, reason="tested")))
        status = await person.see(person.motion, lambda m: m.message == "held: tested")
        asking.cancel()
        assert (status.id, status.state, status.held) == ("a", "active", True) and status.progress < 0.9
        first = await person.see(person.joints, lambda s: s.header.stamp > status.header.stamp)
        later = await person.see(person.joints, lambda s: s.header.stamp > first.header.stamp + 5_000_000_000)
        assert first.position == later.position and not any(later.velocity)
        assert (await person.grip("g", 0.02)).state == "succeeded", "the fingers are not held"
        assert not (await person.hold.call(HoldRequest(hold=False))).held
        assert (await person.see(person.motion, lambda m: m.state != "active")).state == "succeeded"


async def test_restarted_executor_holds_what_a_person_held_and_not_what_a_watchdog_did() -> None:
    async with executor() as person:
        await person.hold.call(HoldRequest(hold=True, by="watchdog"))
        assert (await person.hold.call(HoldRequest(hold=True, owner="anna"))).held
    async with executor() as person:
        found = await person.see(person.motion, lambda m: True)
        assert found.held_by == ["person"] and [hold.by for hold in found.inhibits] == ["anna"]
        assert (await person.hold.call(HoldRequest(hold=False, owner="bert"))).held
        assert not (await person.hold.call(HoldRequest(hold=False, owner="anna"))).held
    async with executor() as person:
        assert not (await person.see(person.motion, lambda m: True)).inhibits


async def test_log_says_whose_hold_stays_when_another_asks_to_let_go(caplog) -> None:
    def told():
        return [text for text in (record.getMessage() for record in caplog.records) if "let go" in text]

    async with executor() as person:
        await person.hold.call(HoldRequest(hold=True, owner="anna", reason="lunch"))
        await person.hold.call(HoldRequest(hold=False, owner="bert"))
        assert len(told()) == 1 and told()[0].startswith("bert let go of nothing: asked to; still held since ")
        assert told()[0].endswith("by anna (lunch)")
        await person.hold.call(HoldRequest(hold=True, owner="bert"))
        await person.hold.call(HoldRequest(hold=False, owner="bert", reason="done"))
        assert told()[1].startswith("bert let go of a part: done; still held since ")
        await person.hold.call(HoldRequest(hold=False, owner="anna", reason="done"))
        assert told()[2:] == ["let go by anna: done"]


async def test_stopped_arm_and_fingers_stay_so_through_restarts_until_somebody_starts_them(robot: RobotModel) -> None:
    home = robot.named("home")
    there = move(robot, home, home + 0.2)
    async with executor() as person:
        stop = StopRequest(owner="anna", reason="smoke")
        assert (await person.stop.call(stop)).stopped.endswith("UTC by anna (smoke)")
    async with executor() as person:
        refused = await person.execute.call(person.asks(id="a", trajectory=there))
        assert (refused.state, refused.error) == ("rejected", "stopped") and "by anna (smoke)" in refused.message
        fingers = await person.command.call(GripperCommand(id="g", width=0.02))
        assert (fingers.state, fingers.error) == ("rejected", "stopped")
        await person.hold.call(HoldRequest(hold=False, owner="bert", stops=True))
        assert (await person.execute.call(person.asks(id="a", trajectory=there))).state == "rejected", "as before"
        assert (await person.follow("b", there)).state == "succeeded"
        assert (await person.grip("h", 0.02)).state == "succeeded"


async def test_goal_that_is_stopped_before_it_comes_never_moves_also_after_a_restart(robot: RobotModel) -> None:
    home = robot.named("home")
    there = move(robot, home, home + 0.2)
    async with executor() as person:
        early = await person.stop.call(StopRequest(id="a", by="requester"))
        assert early.error == "unknown_goal" and "refused if it comes" in early.message and not early.inhibits
        await person.execute.call(person.asks(id="b", trajectory=move(robot, home, home + 0.5, 0.02)))
        await person.see(person.motion, lambda m: m.progress > 0.1)
        await person.stop.call(StopRequest(id="b", by="requester"))
    async with executor() as person:
        for goal in ("a", "b"):
            refused = await person.execute.call(person.asks(id=goal, trajectory=there))
            assert (refused.state, refused.error) == ("rejected", "stopped")
        assert (await person.follow("c", there)).state == "succeeded"


async def test_speed_that_was_set_live_is_found_again(robot: RobotModel) -> None:
    path = "services.trajectory_executor.speed_scaling"
    for set_to, found in ((0.05, 1.0), (1.0, 0.05), (None, 1.0)):
        async with executor() as person:
            assert (await person.see(person.motion, lambda m: True)).speed_scaling == found
            if set_to is not None:
                client = person.bus.client(topics.parameters_of("trajectory_executor"))
                await client.call(ParameterRequest(set={path: set_to}, by="anna"))


async def test_executor_that_cannot_keep_what_persons_decide_does_not_start(
    tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path / "file"))
    monkeypatch.setenv(STANDING_VARIABLE, str(tmp_path))
    with pytest.raises(ConfigError, match=r"ZENCELL_STATE: .* cannot be written"):
        async with executor():
            pass


async def test_second_executor_that_would_keep_the_stops_of_another_cell_in_one_file_is_refused(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sole_use, "PATIENCE", 0.1)
    async with executor() as person:
        await person.stop.call(StopRequest(owner="anna"))
        who = rf"ZENCELL_STATE: .* is in use by trajectory_executor of {CELL}, process {os.getpid()} on .+: a stop"
        with pytest.raises(ConfigError, match=who) as caught:
            async with executor():
                pass
        assert "\n" not in str(caught.value)
        await goes_on(person)
        monkeypatch.setenv(STATE_VARIABLE, os.environ["XDG_STATE_HOME"])
        async with executor() as other:
            assert not (await other.see(other.motion, lambda m: True)).inhibits


async def test_stop_that_cannot_be_kept_says_so_everywhere_until_it_is(monkeypatch, caplog) -> None:
    monkeypatch.setattr(decisions, "TRY_AGAIN", 0.01)
    save, full = RecordFile.save, True

    def refuse(self, record):
        if full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save(self, record)

    def told():
        return [record.getMessage() for record in caplog.records if "inhibits.json" in record.getMessage()]

    async with executor() as person:
        monkeypatch.setattr(RecordFile, "save", refuse)
        for _ in range(2):
            answer = await person.stop.call(StopRequest(owner="anna", reason="smoke"))
            assert answer.message.count("inhibits.json cannot be written (No space left on device)") == 1
            assert "not kept on disk (No space left on device)" in answer.stopped and "smoke" in answer.stopped
        await person.see(person.motion, lambda m: m.not_kept)
        held = await person.hold.call(HoldRequest(hold=True, owner="bert"))
        assert "cannot be written" in held.message and held.not_kept.count("not kept on disk") == 2
        await goes_on(person)
        assert len(told()) == 1, "said once, however often it is tried"
        full = False
        status = await person.see(person.motion, lambda m: len(m.inhibits) == 2 and not m.not_kept)
        assert status.stopped.endswith("by anna (smoke)")
        assert len(told()) == 2 and told()[1].endswith("is written again: what was decided outlives the executor")
        answer = await person.stop.call(StopRequest(owner="anna", reason="smoke"))
        assert "written" not in answer.message
    async with executor() as person:
        found = await person.see(person.motion, lambda m: True)
        assert {one.by for one in found.inhibits} == {"anna", "bert"}


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


async def test_world_edits_show_in_the_truth_and_bad_ones_are_refused() -> None:
    async with executor("world.count=2") as person:
        reply = await person.edit.call(WorldEdit(op="add", position=Vector3(x=0.4, y=0.2)))
        assert reply.id == "ball_3" and reply.ids == ["ball_1", "ball_2", "ball_3"]
        await person.see(person.balls, lambda b: len(b.ids) == 3)
        with pytest.raises(RemoteError) as refusal:
            await person.edit.call(WorldEdit(op="remove", id="ball_9"))
        assert refusal.value.code == "unknown_id" and "ball_3" in refusal.value.message
        await person.edit.call(WorldEdit(op="remove", id="ball_3"))
        await person.see(person.balls, lambda b: len(b.ids) == 2)


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


async def alone(net: LocalNetwork, clock: Clock, given: object, robot: RobotModel) -> tuple[Person, object]:
    """A person who sees an arm in the middle of a motion, whose task is still there."""
    person, task = Person(net, clock), net.bus("smart_pick_place", cell=CELL, clock=clock)
    await task.ready()
    await person.see(person.joints, lambda s: True)
    home = robot.named("home")
    assert (await person.execute.call(person.asks(id="a", trajectory=move(robot, home, home + 0.5, 0.02)))).error == ""
    await person.see(person.motion, lambda m: m.progress > 0.1)
    return person, task


async def test_arm_that_is_to_hold_when_alone_waits_on_its_path_for_the_task_and_goes_on(robot: RobotModel) -> None:
    net, clock, given = LocalNetwork(), Clock(SPEED), config("services.trajectory_executor.when_alone=hold")
    async with running_service(net, trajectory_executor.run, given, name="trajectory_executor", cell=CELL, clock=clock):
        person, task = await alone(net, clock, given, robot)
        await task.close()
        held = await person.see(person.motion, lambda m: m.message == "held: smart_pick_place is gone")
        assert held.held_by == ["controller"] and held.progress < 0.9 and not held.paused
        back = net.bus("smart_pick_place", cell=CELL, clock=clock)
        await back.ready()
        done = await person.see(person.motion, lambda m: m.state != "active")
        assert (done.id, done.state, done.held) == ("a", "succeeded", False)


async def test_arm_that_is_alone_finishes_its_motion_unless_told_otherwise(robot: RobotModel) -> None:
    net, clock, given = LocalNetwork(), Clock(SPEED), config()
    async with running_service(net, trajectory_executor.run, given, name="trajectory_executor", cell=CELL, clock=clock):
        person, task = await alone(net, clock, given, robot)
        await task.close()
        done = await person.see(person.motion, lambda m: m.state != "active" or m.held)
        assert (done.id, done.state) == ("a", "succeeded")


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


async def test_impossible_layout_stops_it_with_the_place() -> None:
    with pytest.raises(ConfigError, match=r"world\.objects: cannot be laid out: ball_1"):
        async with executor("world.balls=[[0.55, 0.17]]"):
            pass


async def test_random_layout_follows_the_seed_and_is_within_reach() -> None:
    seen = []
    for _ in range(2):  # one after the other: they are one cell
        async with executor("world.layout=random", "seed=4") as person:
            seen.append(await person.see(person.balls, lambda b: True))
    one, two = seen
    assert one.poses == two.poses and len(one.ids) == 7
    assert all(0.18 <= np.hypot(p.position.x, p.position.y) <= 0.82 for p in one.poses)


async def test_random_layout_keeps_to_the_limits_of_reach_of_the_cells_own_services() -> None:
    limits = ("services.workspace_validator.max_radius=0.52", "services.workspace_validator.min_radius=0.3")
    async with executor("world.layout=random", "world.count=4", *limits) as person:
        seen = await person.see(person.balls, lambda b: True)
    assert all(0.3 <= np.hypot(p.position.x, p.position.y) <= 0.52 for p in seen.poses) and len(seen.poses) == 4
    with pytest.raises(ConfigError, match=r"services\.workspace_validator\.max_radius: -3"):
        async with executor("world.layout=random", "services.workspace_validator.max_radius=-3"):
            pass


@pytest.mark.parametrize("off", [-0.005, 0.005])
async def test_random_layout_is_within_reach_also_when_seen_a_few_millimetres_off(off: float) -> None:
    cell = load_cell("panda")
    robot = RobotModel.load(cell.robot)
    async with executor("world.layout=random", "seed=20", "world.count=8") as person:
        seen = await person.see(person.balls, lambda b: True)
    for p in (pose.position for pose in seen.poses):
        radius = float(np.hypot(p.x, p.y))
        assert not reach_reason(robot, (p.x * (1 + off / radius), p.y * (1 + off / radius), p.z), cell.grasp)


# --- what is simulated survives the process that simulates it ---


async def test_started_again_with_a_ball_in_the_hand_it_finds_arm_fingers_and_ball_as_they_were(
    robot: RobotModel, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    home, world = robot.named("home"), load_cell("panda").world
    x, y = world.spots[3]
    above = solve_ik(robot, tool_down(x, y, 0.2), home)
    at_ball = solve_ik(robot, tool_down(x, y, world.ball_radius), above)
    async with executor() as person:
        await person.follow("a", move(robot, home, above))
        await person.follow("b", move(robot, above, at_ball))
        assert (await person.grip("close", 0.0)).holding
        await person.follow("c", move(robot, at_ball, above))
        before = await person.see(person.balls, lambda b: "held" in b.labels)
        joints = await person.see(person.joints, lambda _: True)
        gripper = person.gripper.latest
    async with executor() as person:
        found = await person.see(person.joints, lambda _: True)
        assert found.position == pytest.approx(joints.position, abs=1e-3)
        again = await person.see(person.gripper, lambda _: True)
        assert again.holding and again.width == pytest.approx(gripper.width) and again.state == "none"
        balls = await person.see(person.balls, lambda _: True)
        assert dict(zip(balls.ids, balls.labels, strict=True)) == dict(zip(before.ids, before.labels, strict=True))
        await person.follow("d", move(robot, above, home))
        held = balls.ids[balls.labels.index("held")]
        await person.grip("open", 0.08)
        balls = await person.see(person.balls, lambda b: b.labels[b.ids.index(held)] == "table")
        assert len(balls.ids) == len(before.ids)


async def test_what_was_kept_of_another_layout_is_not_used(
    robot: RobotModel, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    home = robot.named("home")
    async with executor() as person:
        await person.follow("a", move(robot, home, home + 0.2))
    async with executor("world.balls=[[0.5, 0.0]]") as person:
        assert len((await person.see(person.balls, lambda _: True)).ids) == 1
        found = await person.see(person.joints, lambda _: True)
        assert found.position[: robot.dof] == pytest.approx(home)


@asynccontextmanager
async def blocked(monkeypatch, where, name: str):
    """A method that takes as long as the block does; yields an event that is set once it was called."""
    loop, entered, go_on = asyncio.get_running_loop(), asyncio.Event(), threading.Event()
    method = getattr(where, name)

    def wait(*arguments, **named):
        loop.call_soon_threadsafe(entered.set)
        assert go_on.wait(20)
        return method(*arguments, **named)

    monkeypatch.setattr(where, name, wait)
    try:
        yield entered
    finally:
        go_on.set()


async def goes_on(person: Person, cycles: int = 20) -> None:
    """Return when so many more joint states were taken."""
    async with asyncio.timeout(20):
        stamps = {(await person.joints.next()).header.stamp for _ in range(cycles)}
    assert len(stamps) == cycles


async def test_joint_states_go_on_while_a_long_trajectory_is_looked_at_and_a_stop_meanwhile_counts(
    robot: RobotModel, monkeypatch
) -> None:
    home = robot.named("home")
    there = move(robot, home, home + 0.3)
    still = [JointTrajectoryPoint(time_from_start=60.0 + i, positions=there.points[-1].positions, velocities=[0.0] * 7,
                                  accelerations=[0.0] * 7) for i in range(4000)]
    long = there.model_copy(update={"points": [*there.points, *still]})
    async with executor() as person:
        async with blocked(monkeypatch, ControlCycle, "judge") as judging:
            asked = asyncio.create_task(person.execute.call(person.asks(id="long", trajectory=long)))
            await judging.wait()
            await goes_on(person)
            await person.stop.call(StopRequest(id="", by="person", owner="anna"))
        answer = await asked
        assert (answer.state, answer.error) == ("rejected", "stopped")
        await person.hold.call(HoldRequest(hold=False, stops=True, owner="anna"))
        answer = await person.execute.call(person.asks(id="again", trajectory=long))
        assert answer.state == "active", answer.message


async def test_joint_states_go_on_while_a_hold_is_recorded_on_a_disk_that_is_stuck(monkeypatch) -> None:
    async with executor() as person, blocked(monkeypatch, RecordFile, "save") as saving:
        asked = asyncio.create_task(person.hold.call(HoldRequest(hold=True, owner="anna"), timeout=60))
        await saving.wait()
        await goes_on(person)
        assert (await person.see(person.motion, lambda m: m.held)).inhibits[0].by == "anna", "it holds at once"
        assert not asked.done(), "what is answered outlives the executor"


async def test_joint_states_go_on_while_a_place_is_looked_for_in_the_world(monkeypatch) -> None:
    box = WorldEdit(op="add", shape="box", size=Vector3(x=0.02, y=0.02, z=0.02), position=Vector3(x=0.35, y=-0.4))
    async with executor() as person:
        async with blocked(monkeypatch, KinematicWorld, "edit") as editing:
            asked = asyncio.create_task(person.edit.call(box, timeout=60))
            await editing.wait()
            await goes_on(person)
        assert (await asked).id == "box_1"
        objects = person.bus.reader(topics.SCENE_OBJECTS)
        await person.see(objects, lambda seen: "box_1" in [thing.id for thing in seen.objects])


async def test_joint_states_go_on_while_the_disk_is_stuck_on_which_the_simulated_world_is_kept(
    robot: RobotModel, monkeypatch, tmp_path
) -> None:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    home = robot.named("home")
    async with executor() as person, blocked(monkeypatch, StateFile, "save") as saving:
        await person.execute.call(person.asks(id="1", trajectory=move(robot, home, home + 0.1)))
        await saving.wait()
        done = await person.see(person.motion, lambda m: m.id == "1" and m.state != "active")
        assert done.state == "succeeded"
        await goes_on(person)
    async with executor() as person:
        assert np.allclose((await person.joints.next()).position[:7], home + 0.1, atol=2e-3), "the newest was kept"


async def test_a_stop_for_safety_outlives_the_executor_until_somebody_has_the_arm_recover(tmp_path, monkeypatch):
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    own = "robot.hardware.backend=tests.doubles.stopping_arm"
    async with executor(own, speed=1.0) as person:
        await person.joints.next()
        assert not stopping_arm.made[-1].stopped
        stopping_arm.made[-1].stopped = True
        await person.see(person.motion, lambda m: "stopped for safety" in m.fault)
    async with executor(own, speed=1.0) as person:  # the stop was ended at the pendant meanwhile
        arm, told = stopping_arm.made[-1], person.bus.reader(topics.ROBOT_STATUS)
        assert (await person.see(told, lambda status: True)).mode == "protective_stop" and arm.stopped
        answer = await person.bus.client(topics.ROBOT_COMMAND).call(RobotCommand(act="recover", owner="tester"))
        assert answer.mode == "running"
        await person.see(told, lambda status: status.mode == "running")
    async with executor(own, speed=1.0) as person:
        await person.joints.next()
        assert not stopping_arm.made[-1].stopped
