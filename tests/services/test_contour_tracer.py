from __future__ import annotations

import asyncio

from applications.outlining.topics import CONTOUR_PATH, OUTLINE_STATUS, OutlinePoints
from common import messages as m
from common import topics
from common.clock import Clock
from common.config import load_cell, service_config
from common.errors import Refused
from common.process.in_process import running_service
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from services import contour_tracer
from tests.harness import PATIENCE, running_with

CELL = load_cell("ur5")
CONFIG = service_config(CELL, "contour_tracer", contour_tracer.Config)
SQUARE = [(0.45, -0.05), (0.55, -0.05), (0.55, 0.05), (0.45, 0.05)]


def show(bus: Bus) -> None:
    """What the other services would say of an arm at home and a cube that was seen and chosen."""
    header = m.Header(stamp=bus.clock.now_ns(), frame_id="world")
    bus.writer(topics.GRIPPER_STATE).put(m.GripperState(header=header, width=0.0))
    bus.writer(topics.MOTION_STATUS).put(m.MotionStatus(header=header))
    bus.writer(topics.JOINT_STATES).put(
        m.JointState(header=header, name=CELL.robot.joints, position=CELL.robot.named_poses["home"]))
    cube = m.CollisionObject(
        id="Object_3", role="target", shape="prism", dimensions=[0.1], outline=[(x - 0.5, y) for x, y in SQUARE],
        pose=m.Pose(position=m.Vector3(x=0.5, z=1.05)))
    bus.writer(topics.PLANNING_SCENE).put(m.PlanningScene(header=header, objects=[cube]))
    poses = [m.Pose(position=m.Vector3(x=x, y=y, z=1.1)) for x, y in SQUARE]
    bus.writer(CONTOUR_PATH).put(OutlinePoints(header=header, poses=poses, object="Object_3"))


async def keep_showing(bus: Bus) -> None:
    """Publish it repeatedly: old messages are ignored."""
    while True:
        show(bus)
        await asyncio.sleep(0.1)


async def test_selected_contour_causes_plan_requests() -> None:
    net = LocalNetwork()
    bus = net.bus("tester", cell="test", clock=Clock())
    asked: asyncio.Queue[m.PlanRequest] = asyncio.Queue()

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        asked.put_nowait(request)
        point = m.JointTrajectoryPoint(time_from_start=0.0, positions=[0.0] * 6, velocities=[0.0] * 6,
                                       accelerations=[0.0] * 6)
        return m.PlanResponse(id=request.id, ok=True, fraction=1.0,
                              trajectory=m.JointTrajectory(joint_names=CELL.robot.joints, points=[point]))

    executed: asyncio.Queue[m.ExecuteRequest] = asyncio.Queue()

    async def execute(request: m.ExecuteRequest) -> m.MotionStatus:
        executed.put_nowait(request)
        return m.MotionStatus(id=request.id, state="rejected", message="not today")

    bus.serve(topics.MOTION_PLAN, plan)
    bus.serve(topics.MOTION_EXECUTE, execute)
    status = bus.reader(OUTLINE_STATUS)
    await bus.ready()
    running = running_service(net, contour_tracer.run, CONFIG, name="contour_tracer")
    async with running, running_with(keep_showing(bus)):
        async with asyncio.timeout(PATIENCE):
            stages = [(await asked.get()).stage for _ in range(5)]
            assert stages == ["approach", "descend", "trace", "retreat", "home"]
            await executed.get()
            while (said := await status.next()).state != "ERROR":
                pass
    assert said.message == "approach was refused: not today"
    assert (said.object, said.points, said.fraction) == ("Object_3", 4, 1.0)


async def test_planner_without_a_scene_is_asked_again() -> None:
    net = LocalNetwork()
    bus = net.bus("tester", cell="test", clock=Clock())
    asked: asyncio.Queue[str] = asyncio.Queue()

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        asked.put_nowait(request.id)
        raise Refused("no_scene", "there is no planning scene yet")

    bus.serve(topics.MOTION_PLAN, plan)
    await bus.ready()
    running = running_service(net, contour_tracer.run, CONFIG, name="contour_tracer")
    async with running, running_with(keep_showing(bus)):
        async with asyncio.timeout(PATIENCE):
            assert await asked.get() == await asked.get() == await asked.get()


async def test_pause_is_answered_with_the_status() -> None:
    net = LocalNetwork()
    command = net.bus("tester", cell="test", clock=Clock()).client(topics.TASK_COMMAND)
    async with running_service(net, contour_tracer.run, CONFIG, name="contour_tracer"):
        answer = await command.call(m.TaskCommand(command="pause"))
        assert (answer.state, answer.paused, answer.started) == ("IDLE", True, True)
        assert not (await command.call(m.TaskCommand(command="resume"))).paused


async def test_late_reader_gets_the_status() -> None:
    net = LocalNetwork()
    bus = net.bus("tester", cell="test", clock=Clock())
    async with running_service(net, contour_tracer.run, CONFIG, name="contour_tracer"):
        async with asyncio.timeout(PATIENCE):
            first = await bus.reader(OUTLINE_STATUS).next()
            late = await bus.reader(OUTLINE_STATUS).next()
        assert first.state == late.state == "IDLE"
        assert late.message == "waiting for gripper/state, planning_scene, joint_states, motion/status"
