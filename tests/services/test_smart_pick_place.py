from __future__ import annotations

import asyncio
from typing import Any

import pytest

from applications.pick_place.choice import PickPlaceView, ReleasePositions
from applications.pick_place.grasping import Config
from applications.pick_place.task import PickPlace
from applications.pick_place.topics import PICK_PLACE_STATUS, VALIDATED_TARGETS
from common import messages as m
from common import topics
from common.atomic_file import RUNTIME_VARIABLE
from common.clock import Clock
from common.config import load_cell, service_config
from common.process import task_runner
from common.process.in_process import running_service
from common.process.task_runner import run_task
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from services import smart_pick_place

CELL = load_cell("panda")
CONFIG = service_config(CELL, "smart_pick_place", smart_pick_place.Config)


def ball(name: str, x: float, y: float) -> m.CollisionObject:
    return m.CollisionObject(id=name, role="target", shape="sphere", dimensions=[0.03],
                             pose=m.Pose(position=m.Vector3(x=x, y=y, z=0.03)))


def show(bus: Bus, targets: list[tuple[float, float]], age: float = 0.0) -> None:
    """What the other services would say of an arm at home and balls on the table, `age` [s, cell time] ago."""
    header = m.Header(stamp=bus.clock.now_ns() - int(age * 1e9), frame_id="world")
    bus.writer(topics.GRIPPER_STATE).put(m.GripperState(header=header, width=0.08))
    bus.writer(topics.MOTION_STATUS).put(m.MotionStatus(header=header))
    bus.writer(topics.JOINT_STATES).put(
        m.JointState(header=header, name=CELL.robot.joints, position=CELL.robot.named_poses["home"]))
    bus.writer(topics.PLANNING_SCENE).put(
        m.PlanningScene(header=header, objects=[ball(f"track_{k}", *t) for k, t in enumerate(targets)]))
    bus.writer(VALIDATED_TARGETS).put(m.PoseArray(
        header=header, poses=[m.Pose(position=m.Vector3(x=x, y=y, z=0.03)) for x, y in targets]))


async def test_validated_target_causes_a_plan_request_above_the_ball() -> None:
    net = LocalNetwork()
    bus = net.bus("tester", cell="test", clock=Clock())
    asked: asyncio.Queue[m.PlanRequest] = asyncio.Queue()

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        asked.put_nowait(request)
        return m.PlanResponse(id=request.id, ok=False, error="no_ik", message="not today")

    bus.serve(topics.MOTION_PLAN, plan)
    await bus.ready()
    async with running_service(net, smart_pick_place.run, CONFIG, name="smart_pick_place"):
        show(bus, [(0.40, -0.17)])
        request = await asyncio.wait_for(asked.get(), 5)
        assert request.stage == "pre-grasp"
        assert isinstance(request.goal, m.SequenceGoal)
        for goal, height in zip([item.goal for item in request.goal.items], (0.13, 0.03), strict=True):
            assert isinstance(goal, m.PoseGoal)
            assert (goal.pose.position.x, goal.pose.position.y) == (0.40, -0.17)
            assert abs(goal.pose.position.z - height) < 1e-9


async def test_image_age_is_measured_in_wall_time() -> None:
    net = LocalNetwork()
    clock = Clock(speed=10.0)
    bus = net.bus("tester", cell="test", clock=clock)
    asked: asyncio.Queue[m.PlanRequest] = asyncio.Queue()

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        asked.put_nowait(request)
        return m.PlanResponse(id=request.id, ok=False, error="no_ik", message="not today")

    bus.serve(topics.MOTION_PLAN, plan)
    await bus.ready()
    patient = CONFIG.model_copy(update={"frame_timeout": 10.0})  # [s, wall]
    async with running_service(net, smart_pick_place.run, patient, name="smart_pick_place", clock=clock):
        show(bus, [(0.40, -0.17)], age=30.0)
        assert (await asyncio.wait_for(asked.get(), 5)).stage == "pre-grasp"


async def test_late_reader_gets_the_status() -> None:
    net = LocalNetwork()
    bus = net.bus("tester", cell="test", clock=Clock())
    async with running_service(net, smart_pick_place.run, CONFIG, name="smart_pick_place"):
        first = await asyncio.wait_for(bus.reader(PICK_PLACE_STATUS).next(), 5)
        late = await asyncio.wait_for(bus.reader(PICK_PLACE_STATUS).next(), 5)
        assert first.state == late.state == "IDLE"
        assert "waiting for" in late.message


@pytest.mark.parametrize("damaged", ["{", '{"places": [[0.5, 0.2, NaN]]}', '{"places": 3}', "[]"])
async def test_release_positions_survive_a_restart(damaged, monkeypatch, tmp_path, caplog) -> None:
    monkeypatch.setenv(RUNTIME_VARIABLE, str(tmp_path))
    tasks: list[PickPlace] = []

    class Seen(PickPlace):
        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            tasks.append(self)

    async def run(bus: Bus, config: Config) -> None:
        await run_task(bus, config, Seen, PICK_PLACE_STATUS, PickPlaceView, seen=VALIDATED_TARGETS)

    saved, places = tmp_path / "test.smart_pick_place.json", [(0.5, 0.2, 0.095)]
    async with running_service(LocalNetwork(), run, CONFIG, name="smart_pick_place"):
        tasks[0].remember(ReleasePositions(places=places))
        async with asyncio.timeout(10):
            while not saved.exists():  # noqa: ASYNC110
                await asyncio.sleep(0.01)
    async with running_service(LocalNetwork(), run, CONFIG, name="smart_pick_place"):
        assert tasks[1].memory == ReleasePositions(places=places)
    saved.write_text(damaged)
    async with running_service(LocalNetwork(), run, CONFIG, name="smart_pick_place"):
        assert tasks[2].memory == ReleasePositions()
    assert f"the memory of the task is lost: {saved} cannot be read: it is damaged" in caplog.text


async def test_initial_memory_is_used_and_saved_as_soon_as_possible(
    monkeypatch, tmp_path, caplog,
) -> None:
    blocker = tmp_path / "standing"
    blocker.write_text("no folder")
    monkeypatch.setenv(RUNTIME_VARIABLE, str(blocker / "cell"))
    monkeypatch.setattr(task_runner, "SAVE_RETRY", 0.01)
    initial, later = ReleasePositions(places=[(0.5, 0.2, 0.095)]), ReleasePositions(places=[(0.5, 0.3, 0.035)])
    tasks: list[PickPlace] = []

    class WithMemory(PickPlace):
        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            self.remember(initial)
            tasks.append(self)

    async def run(bus: Bus, config: Config) -> None:
        await run_task(bus, config, WithMemory, PICK_PLACE_STATUS, PickPlaceView, seen=VALIDATED_TARGETS)

    saved = blocker / "cell" / "test.smart_pick_place.json"
    async with running_service(LocalNetwork(), run, CONFIG, name="smart_pick_place"), asyncio.timeout(10):
        assert tasks[0].memory == initial
        tasks[0].remember(later)
        while "cannot be written" not in caplog.text:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        blocker.unlink()
        while not saved.exists():  # noqa: ASYNC110
            await asyncio.sleep(0.01)
    assert ReleasePositions.model_validate_json(saved.read_text()) == later
    assert caplog.text.count("cannot be written") == 1


async def test_pause_is_answered_with_the_status() -> None:
    net = LocalNetwork()
    bus = net.bus("tester", cell="test", clock=Clock())
    command = bus.client(topics.TASK_COMMAND)
    async with running_service(net, smart_pick_place.run, CONFIG, name="smart_pick_place"):
        assert (await command.call(m.TaskCommand(command="pause"))).paused
        assert not (await command.call(m.TaskCommand(command="resume"))).paused


async def test_empty_plan_and_out_of_range_held_object_do_not_end_the_task() -> None:
    net = LocalNetwork()
    bus = net.bus("tester", cell="test", clock=Clock())
    asked: asyncio.Queue[m.PlanRequest] = asyncio.Queue()

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        asked.put_nowait(request)
        return m.PlanResponse(
            id=request.id, ok=True, trajectory=m.JointTrajectory(joint_names=CELL.robot.joints, points=[]))

    bus.serve(topics.MOTION_PLAN, plan)
    await bus.ready()
    async with running_service(net, smart_pick_place.run, CONFIG, name="smart_pick_place"):
        show(bus, [(0.40, -0.17)])
        await asyncio.wait_for(asked.get(), 5)
        await asyncio.wait_for(asked.get(), 5)  # it is planned again
        far = ball("far", 1e7, 1e7)
        held = [m.AttachedObject(link="panda_hand_tcp", object=far)]
        header = m.Header(stamp=bus.clock.now_ns(), frame_id="world")
        bus.writer(topics.PLANNING_SCENE).put(m.PlanningScene(header=header, attached=held))
        bus.writer(topics.GRIPPER_STATE).put(m.GripperState(header=header, holding=True, outcome="too_wide"))
        await asyncio.wait_for(asked.get(), 5)
