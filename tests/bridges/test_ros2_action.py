"""FollowJointTrajectory as a client of ROS 2 sees it, with the real executor; once with real processes."""

import asyncio
import logging
import threading
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from common import messages as m
from common import topics
from common.clock import Clock
from common.config import Members, Run
from common.transport.bus import Bus
from common.transport.foreign import open_foreign
from services import trajectory_executor
from tests.harness import RunningCell, until
from tests.services.executor_rig import HOME, PANDA, SPEED, ExecutorClient, config
from tests.services.fake_cell import latest

pytest.importorskip("rosbags", reason="the extra `ros2` is not installed")
pytest.importorskip("xxhash", reason="the extra `ros2` is not installed")

from bridges.ros2 import trajectories, types  # noqa: E402
from bridges.ros2.action import ABORTED, CANCELED, SUCCEEDED, UNKNOWN  # noqa: E402
from bridges.ros2.graph import Graph  # noqa: E402
from bridges.ros2.scene_check import SceneCheck  # noqa: E402
from bridges.ros2.server import serve  # noqa: E402
from services import ros2_bridge  # noqa: E402
from tests.bridges.ros_client import TIMEOUT, FollowClient, Ros  # noqa: E402

DOMAIN = 11
NAMES = list(PANDA.robot.joints)
NAME = "/test/follow_joint_trajectory"
TURNED = np.array(HOME) + 0.4 * np.eye(7)[0]
FAR = np.array(HOME) + 2.0 * np.eye(7)[0]
SLOW = FollowClient.goal(NAMES, (60.0, FAR))
WALL = m.CollisionObject(
    id="wall", role="fixture", shape="box", dimensions=[0.4, 0.1, 2.0],
    pose=m.Pose(position=m.Vector3(x=0.0, y=0.35, z=0.5)))
NOW = 1_700_000_000_000_000_000


# --- goals as trajectories --------------------------------------------------------------------------------------------


def tolerance(name: str, **values: float) -> Any:
    return types.make("control_msgs/msg/JointTolerance", name=name, **values)


def at(seconds: int) -> Any:
    return types.make("trajectory_msgs/msg/JointTrajectory", joint_names=["a", "b"], header=types.make(
        "std_msgs/msg/Header", stamp=types.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=0)))


GOAL = FollowClient.goal
REFUSED = [
    (GOAL(["a", "c"], (1, [1, 1])), "joint_names", "the goal is for a, c; choices: a, b, all of them"),
    (GOAL(["a"], (1, [1])), "joint_names", "the goal is for a; choices: a, b"),
    (GOAL([]), "joint_names", "for no joints"),
    (GOAL(["a", "b"]), "too_few_points", "no points"),
    (GOAL(["a", "b"], (0, [1, 1])), "bad_times", "must increase"),
    (GOAL(["a", "b"], (1, [1, 1]), (1, [1, 1])), "bad_times", "must increase"),
    (GOAL(["a", "b"], (1, [1])), "joint_names", "points have 1 positions for 2 joints"),
    (GOAL(["a", "b"], (1, [[1, 1], [0, 0]]), (2, [1, 1])), "joint_names", "points have 0 or 2 velocities for 2 joints"),
    (GOAL(["a", "b"], (1, [1, np.nan])), "malformed", "finite"),
    (GOAL([], trajectory=at(NOW // 10**9 - 9)), "old_stamp", "is 9.0 s ago"),
    (GOAL([], trajectory=at(NOW // 10**9 + 9)), "future_stamp", "is 9.0 s ahead"),
]


@pytest.mark.parametrize(("goal", "code", "text"), REFUSED)
def test_malformed_goal_is_refused_with_the_reason(goal: Any, code: str, text: str) -> None:
    with pytest.raises(trajectories.Refused, match=text) as refusal:
        trajectories.trajectory_of(goal, {"a": 0.0, "b": 0.0}, NOW)
    assert refusal.value.code == code


@pytest.mark.parametrize(("field", "given", "text"), [
    ("path_tolerance", tolerance("c", position=1.0), "path_tolerance names joint 'c'; choices: a"),
    ("goal_tolerance", tolerance("a", velocity=1.0), "goal_tolerance of a: only tolerances of positions"),
    ("component_path_tolerance", types.make("control_msgs/msg/JointComponentTolerance"), "component tolerances"),
])
def test_tolerance_that_cannot_be_watched_is_refused(field: str, given: Any, text: str) -> None:
    with pytest.raises(trajectories.Refused, match=text):
        trajectories.Tolerances.of(GOAL(["a"], (1, [1]), **{field: [given]}))


@pytest.mark.parametrize(("error", "code"), [
    ("joint_names", -2), ("old_stamp", -3), ("path_tolerance", -4), ("goal_tolerance", -5), ("limit", -1),
])
def test_errors_have_the_codes_of_control_msgs(error: str, code: int) -> None:
    assert trajectories.code_of(error) == code


def test_goal_starts_where_the_arm_is_and_positions_are_joined_smoothly() -> None:
    goal = GOAL(["b", "a"], (1.0, [1, 0]), (2.0, [3, 0]), (3.0, [4, 0]))
    made = trajectories.trajectory_of(goal, {"a": 0.0, "b": 0.5}, NOW)
    assert [point.time_from_start for point in made.points] == [0.0, 1.0, 2.0, 3.0]
    assert made.points[0].positions == [0.5, 0.0]
    q, dq = (np.array([getattr(point, field) for point in made.points]) for field in ("positions", "velocities"))
    assert not dq[[0, -1]].any() and not dq[:, 1].any()
    slope = np.diff(q, axis=0)
    before, after = -6 * slope[:-1] + 2 * dq[:-2] + 4 * dq[1:-1], 6 * slope[1:] - 4 * dq[1:-1] - 2 * dq[2:]
    assert np.allclose(before, after)  # accelerations on both sides of the inner points
    assert np.allclose([point.accelerations for point in made.points[1:-1]], after)


@pytest.mark.parametrize(("name", "published"), [  # in headers that rosidl generated; the last two in `ros2` itself
    (f"{types.FOLLOW}_SendGoal", "b13789dddc325a7a962825c45e28c77d37237ec129dd0c34dc5994562938c57f"),
    (f"{types.FOLLOW}_GetResult", "e3ceb38e3e1867c8dc0f46014df26e90eb93422f27e9e97f936e07f94be4bc8b"),
    (f"{types.FOLLOW}_FeedbackMessage", "80398fcb9674a79081a9906e2ccf0c804dd7cb15e22e362e606ee87186beab71"),
    (types.CANCEL, "573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a"),
    ("action_msgs/msg/GoalStatusArray", "6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e"),
])
def test_hashes_of_the_action_are_the_published_ones(name: str, published: str) -> None:
    assert types.type_hash(name) == f"RIHS01_{published}"


# --- goals of a client, with the executor -----------------------------------------------------------------------------


class Cell(ExecutorClient):
    """The executor, the bridge, and a client of ROS."""

    def __init__(self, clock: Clock, endpoint: str) -> None:
        super().__init__(clock)
        self.endpoint, self.bridging = endpoint, AsyncExitStack()
        self.ros = Ros(endpoint, DOMAIN)
        self.client_of_ros = FollowClient(self.ros, NAME)
        self.send, self.result, self.cancel = (
            self.client_of_ros.send, self.client_of_ros.result, self.client_of_ros.cancel)

    async def bridge(self, bus: Bus, bridge: ros2_bridge.Config) -> None:
        from common.application import find_application

        await serve(bus, bridge, find_application(""), self.endpoint)

    async def turned(self) -> float:
        """Return how far the first joint is from its home [rad]."""
        return (await self.joints.next()).position[0] - HOME[0]

    async def scene(self, *objects: m.CollisionObject) -> None:
        self.put(topics.PLANNING_SCENE, m.PlanningScene(header=self.bus.header(), objects=list(objects)))
        await asyncio.sleep(0.05)

    async def held(self, reason: str) -> None:
        """Return when the executor has reported a hold."""
        await latest(self.motion, lambda status: any(each.reason == reason for each in status.interlocks))

    async def moving(self) -> None:
        async with asyncio.timeout(TIMEOUT):
            while await self.turned() < 0.02:
                pass


@pytest.fixture
async def cell(stack: AsyncExitStack, endpoint: str) -> Cell:
    cell = Cell(Clock(SPEED), endpoint)
    stack.callback(cell.ros.session.close)
    bridge = ros2_bridge.Config(robot=PANDA.robot, run=Run(cell="test"), domain=DOMAIN, members=Members(
        services=["trajectory_executor", "ros2_bridge"]))
    await stack.enter_async_context(cell.running(trajectory_executor, config()))
    await cell.scene()
    await stack.enter_async_context(cell.bridging)
    await cell.bridging.enter_async_context(cell.running(ros2_bridge, bridge, cell.bridge))
    return cell


async def test_goal_moves_the_arm_with_status_feedback_and_result(cell: Cell) -> None:
    feedback = f"{NAME}/_action/feedback", f"{types.FOLLOW}_FeedbackMessage"
    subscribed = {variant: cell.ros.subscribe(*feedback, variant) for variant in (types.JAZZY, types.INDEXED)}
    _, statuses = cell.ros.subscribe(f"{NAME}/_action/status", "action_msgs/msg/GoalStatusArray")
    goal, accepted = await cell.send(GOAL(NAMES, (16.0, TURNED)))
    assert accepted
    assert await cell.result(goal) == (SUCCEEDED, 0, "")
    assert abs(await cell.turned() - 0.4) < 0.01
    for variant, (_, queue) in subscribed.items():
        messages = [queue.get_nowait()[0] for _ in range(queue.qsize())]
        assert {bytes(each.goal_id.uuid) for each in messages} == {goal}
        reached = [each.feedback.actual.positions[0] for each in messages]
        assert reached == sorted(reached) and len(reached) > 2 and reached[-1] > reached[0]
        last = messages[-1].feedback
        assert last.joint_names == NAMES
        # Of most: on a busy machine a reading of the joints may be missing. Cubics instead of quintics are 0.014 off.
        assert np.median([abs(each.feedback.error.positions).max() for each in messages]) < 0.008
        assert hasattr(last, "index") is (variant == types.INDEXED)
    seen = [[(bytes(each.goal_info.goal_id.uuid), each.status) for each in statuses.get_nowait()[0].status_list]
            for _ in range(statuses.qsize())]
    assert seen[-2:] == [[(goal, 2)], [(goal, SUCCEEDED)]]
    token = await cell.ros.tokens("/MP/%/%test/zencell/%test%follow_joint_trajectory%_action%status/")
    assert token.endswith("/:1:,1:,:,:,,")
    assert await cell.send(GOAL(NAMES, (8.0, HOME)), goal) == (goal, False)  # the same id never acts twice


async def test_what_the_arm_cannot_follow_is_rejected_with_the_reason(cell: Cell) -> None:
    _, lines = cell.ros.subscribe("/rosout", "rcl_interfaces/msg/Log")
    await cell.scene(WALL)
    for goal, code, reason in [
        (SLOW, -1, "collides with wall at"),
        (GOAL(NAMES, (0.0, TURNED), (8.0, HOME)), -1, "trajectory starts with panda_joint1 at"),
        (GOAL(NAMES, (8.0, np.array(HOME) + 9 * np.eye(7)[6])), -1, "exceeds the limit of panda_joint7"),
        (GOAL(NAMES[:3], (8.0, HOME[:3])), -2, "choices: panda_joint1"),
    ]:
        name, accepted = await cell.send(goal)
        status, error, text = await cell.result(name)
        assert (accepted, status, error) == (False, UNKNOWN, code)
        assert reason in text
        async with asyncio.timeout(TIMEOUT):
            assert reason in (await lines.get())[0].msg
    assert abs(await cell.turned()) < 1e-3
    assert await cell.result(bytes(range(16))) == (UNKNOWN, -1, "no such goal is known")


async def test_cancelled_goal_stops_the_arm(cell: Cell) -> None:
    goal, accepted = await cell.send(SLOW)
    assert accepted
    second, accepted = await cell.send(SLOW)
    assert not accepted and "stop it first" in (await cell.result(second))[2]
    await cell.moving()
    assert await cell.cancel() == (0, [goal])
    assert (await cell.result(goal))[0] == CANCELED
    stopped = await cell.turned()
    assert 0.0 < stopped < 1.9
    assert await cell.cancel(goal) == (3, [])  # it is over
    assert await cell.cancel(bytes(range(16))) == (2, [])  # unknown
    assert abs(await cell.turned() - stopped) < 1e-3


async def test_nothing_moves_after_a_stop_of_an_operator(cell: Cell) -> None:
    goal, _ = await cell.send(SLOW)
    await cell.moving()
    await cell.stop.call(m.StopRequest(owner="anna", reason="lunch"))
    status, code, text = await cell.result(goal)
    assert (status, code) == (ABORTED, -1) and "lunch" in text
    stopped = await cell.turned()
    refused, accepted = await cell.send(GOAL(NAMES, (8.0, HOME)))
    assert not accepted
    assert "stopped since" in (text := (await cell.result(refused))[2]) and "by anna (lunch)" in text
    assert abs(await cell.turned() - stopped) < 1e-3
    await cell.hold.call(m.HoldRequest(hold=False, stops=True, owner="anna", acknowledged=cell.motion.latest.newest))
    assert (await cell.send(GOAL(NAMES, (20.0, HOME))))[1]


async def test_stop_by_ros_voids_the_goals_before_it(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    running, _ = await cell.send(SLOW)
    await cell.moving()
    await cell.stop.call(m.StopRequest(owner="ros2"))
    assert (await cell.result(running))[0] == ABORTED
    arrived, stopped = threading.Event(), threading.Event()

    def slow_check(*_: object) -> None:
        arrived.set()
        stopped.wait(TIMEOUT)

    with monkeypatch.context() as patch:
        patch.setattr(SceneCheck, "require_free", slow_check)
        pending = asyncio.create_task(cell.send(SLOW))
        await asyncio.to_thread(arrived.wait, TIMEOUT)
        await cell.stop.call(m.StopRequest(owner="ros2", reason="too close"))
        stopped.set()
        goal, accepted = await pending
        arrived.clear()
        stopped.clear()
        pending = asyncio.create_task(cell.send(SLOW))
        await asyncio.to_thread(arrived.wait, TIMEOUT)
        assert (await cell.cancel())[0] == 0
        stopped.set()
        assert not (await pending)[1]  # cancelled before it started
    assert not accepted and "too close" in (await cell.result(goal))[2]
    await cell.hold.call(m.HoldRequest(hold=True, owner="ros2", reason="paused"))
    await cell.held("paused")
    later, accepted = await cell.send(GOAL(NAMES, (8.0, HOME)))
    assert accepted and (await cell.result(later))[0] == SUCCEEDED  # of the same operator
    await cell.hold.call(m.HoldRequest(hold=True, owner="anna", reason="look"))
    await cell.held("look")
    held, accepted = await cell.send(GOAL(NAMES, (8.0, HOME)))
    assert not accepted and "by anna (look)" in (await cell.result(held))[2]


async def test_tolerance_of_the_goal_aborts_it(cell: Cell) -> None:
    goal, accepted = await cell.send(GOAL(NAMES, (60.0, FAR), path_tolerance=[tolerance(NAMES[0], position=1e-9)]))
    assert accepted
    status, code, text = await cell.result(goal)
    assert (status, code) == (ABORTED, -4) and text.startswith("panda_joint1 is 0.")
    assert await cell.turned() < 1.9


async def test_end_of_the_bridge_stops_its_motion(cell: Cell) -> None:
    goal, _ = await cell.send(SLOW)
    await cell.moving()
    await cell.bridging.aclose()
    status = await cell.ended(f"ros2-{goal.hex()}")
    assert (status.state, status.message) == ("cancelled", "the bridge to ROS 2 ends")


async def test_bug_in_a_handler_is_answered_and_ends_the_bridge(endpoint: str) -> None:
    session = await open_foreign(endpoint)
    ros = Ros(endpoint, DOMAIN)
    graph = Graph(session, DOMAIN, "/bug", "node", logging.getLogger("bug"))

    async def handler(_: Any) -> Any:
        raise KeyError("forgotten")

    graph.service("/bug/it", types.TRIGGER, handler)
    running = asyncio.create_task(graph.run())
    try:
        await ros.tokens("%bug%it")
        with pytest.raises(AssertionError, match="ReplyError"):
            await ros.call("/bug/it", types.TRIGGER, types.make(f"{types.TRIGGER}_Request"))
        with pytest.raises(ExceptionGroup) as raised:
            await running
        assert [repr(error) for error in raised.value.exceptions] == ["KeyError('forgotten')"]
    finally:
        ros.session.close()
        await asyncio.to_thread(session.close)


# --- processes --------------------------------------------------------------------------------------------------------


@pytest.mark.cell
async def test_cell_of_processes_obeys_a_client_of_ros(tmp_path: Path) -> None:
    (tmp_path / "arm.yaml").write_text(
        "cell: arm\nrobot: panda\nworld: balls\npipeline: lerp\n"
        "services: {trajectory_executor: {}, scene_manager: {}}\n")
    with RunningCell(tmp_path, "up", "arm.yaml", "--ros2", "5") as running:
        assert running.domain != 42
        async with running.listen() as bus:
            for topic in (topics.PLANNING_SCENE, topics.JOINT_STATES):  # without which a goal is rejected
                await until(bus.reader(topic), lambda _: True)
        ros = Ros(running.endpoint, 5)
        client = FollowClient(ros, "/arm/follow_joint_trajectory")
        await ros.tokens("SS/%/%arm/zencell/%arm%follow_joint_trajectory%_action%get_result/")
        goal, accepted = await client.send(GOAL(NAMES, (1.0, TURNED)))
        assert accepted, running.tail()
        assert await client.result(goal) == (SUCCEEDED, 0, "")
        state, _ = await ros.next("/arm/joint_states", "sensor_msgs/msg/JointState")
        assert abs(dict(zip(state.name, state.position, strict=True))[NAMES[0]] - TURNED[0]) < 0.01
        ros.session.close()
        running.interrupt()
        assert await running.ended(TIMEOUT) == 0
        assert "Traceback" not in running.text
