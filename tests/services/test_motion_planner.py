import asyncio
import threading
from contextlib import asynccontextmanager
from functools import partial

import pytest

from applications.pick_place.topics import SCENE_BALLS
from common import topics
from common.clock import Clock
from common.config import load_cell, service_config
from common.errors import Refused, RemoteError
from common.messages import (
    CollisionObject,
    ExecuteRequest,
    FollowedRequest,
    Header,
    JointGoal,
    JointState,
    MotionStatus,
    PlanningScene,
    PlanRequest,
    Pose,
    PoseGoal,
    Vector3,
)
from common.planning.pipeline import PlanningPipeline
from common.process.in_process import running_service
from common.process.planning_worker import WorkerDied
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose, tool_down
from common.supervision.wiring import wiring
from common.transport.local import LocalNetwork
from services import motion_planner

CELL = load_cell("panda")
CONFIG = service_config(CELL, "motion_planner", motion_planner.Config)
ROBOT = RobotModel.load(CELL.robot)
HOME = ROBOT.named("home")
FINGERS = ["panda_finger_joint1", "panda_finger_joint2"]


def box(name: str, size: list[float], x: float, z: float) -> CollisionObject:
    return CollisionObject(id=name, role="fixture", shape="box", dimensions=size, pose=Pose(position=Vector3(x=x, z=z)))


def scene(*objects: CollisionObject) -> PlanningScene:
    table = box("table", [1.0, 1.0, 0.05], 0.5, -0.025)
    return PlanningScene(header=Header(frame_id="world"), objects=[table, *objects])


class User:
    """Clients of a motion planner on a network of its own."""

    def __init__(self, network: LocalNetwork) -> None:
        self.bus = network.bus("tester", cell="test", clock=Clock())
        self.plan = self.bus.client(topics.MOTION_PLAN)
        self.scenes = self.bus.writer(topics.PLANNING_SCENE)
        self.states = self.bus.writer(topics.JOINT_STATES)
        self.display = self.bus.reader(topics.DISPLAY_TRAJECTORY)

    def put_state(self, q, width=0.08, names=(*ROBOT.joint_names, *FINGERS)):
        position = [*q, *[width / 2] * (len(names) - len(q))]
        self.states.put(JointState(header=self.bus.header(), name=list(names), position=position))

    async def refusal(self, request) -> RemoteError:
        with pytest.raises(RemoteError) as caught:
            await self.plan.call(request, timeout=30)
        return caught.value

    async def plan_together(self, count: int, prefix: str = "") -> list[float]:
        """Plan to home from several starts at once; return the first joint of each trajectory."""
        requests = [to_home(f"{prefix}{i}", start=list(HOME + 0.01 * i)) for i in range(count)]
        answers = await asyncio.gather(*(self.plan.call(request, timeout=30) for request in requests))
        return [answer.trajectory.points[0].positions[0] for answer in answers]


@asynccontextmanager
async def serving(workers=(), **config):
    network = LocalNetwork()
    user = User(network)
    config = motion_planner.Config.model_validate(CONFIG.model_dump() | config)
    run = partial(motion_planner.run, helpers=workers)
    async with asyncio.timeout(120), running_service(network, run, config, name="motion_planner"):
        await user.plan.wait_available(20)
        yield user


@pytest.fixture
async def planner():
    async with serving() as user:
        yield user


def to_home(id="1", **more) -> PlanRequest:
    return PlanRequest(id=id, goal=JointGoal(named="home"), **more)


def expected_starts(count: int):
    return pytest.approx([HOME[0] + 0.01 * i for i in range(count)], abs=1e-6)


async def test_request_is_answered_with_a_trajectory_that_is_also_displayed(planner):
    planner.scenes.put(scene())
    planner.put_state(HOME + 0.2)
    response = await planner.plan.call(to_home(), timeout=30)
    assert response.ok, response.message
    assert response.id == "1"
    assert response.header.stamp > 0
    assert response.trajectory.joint_names == ROBOT.joint_names
    assert response.trajectory.points[0].positions == pytest.approx(HOME + 0.2, abs=1e-6)
    assert response.trajectory.points[-1].positions == pytest.approx(HOME, abs=1e-6)
    async with asyncio.timeout(30):
        assert (await planner.display.next()).points == response.trajectory.points


async def test_plan_uses_the_gripper_width_of_the_joint_states(planner):
    planner.scenes.put(scene(box("wall", [0.1, 0.04, 0.04], 0.5, 0.02)))
    around_wall = PlanRequest(id="1", goal=PoseGoal(pose=matrix_to_pose(tool_down(0.5, 0.0, 0.02))))
    planner.put_state(HOME, width=0.08)
    assert (await planner.plan.call(around_wall, timeout=30)).ok
    planner.put_state(HOME, width=0.0)
    response = await planner.plan.call(around_wall, timeout=30)
    assert not response.ok and "finger" in response.message


async def test_request_without_a_scene_is_refused(planner):
    planner.put_state(HOME)
    refusal = await planner.refusal(to_home(stage="homing", start=list(HOME)))
    assert refusal.code == "no_scene"
    assert "homing" in refusal.message


async def test_request_without_a_start_is_refused_until_a_complete_joint_state_arrives(planner):
    planner.scenes.put(scene())
    assert (await planner.refusal(to_home())).code == "no_state"
    planner.put_state(HOME[:3], names=ROBOT.joint_names[:3])
    assert (await planner.refusal(to_home())).code == "no_state"
    assert (await planner.plan.call(to_home(start=list(HOME + 0.1)), timeout=30)).ok
    planner.put_state(HOME + 0.1)
    assert (await planner.plan.call(to_home(), timeout=30)).ok


async def test_failed_request_names_the_colliding_pair_and_the_next_is_served(planner):
    where = ROBOT.fk(HOME)[:3, 3]
    in_gripper = CollisionObject(
        id="ball_1", role="target", shape="sphere", dimensions=[0.03],
        pose=Pose(position=Vector3(x=where[0], y=where[1], z=where[2] + 0.06)),
    )
    planner.scenes.put(scene(in_gripper))
    planner.put_state(HOME)
    goal = PoseGoal(pose=matrix_to_pose(tool_down(0.4, 0.1, 0.3)))
    response = await planner.plan.call(PlanRequest(id="2", stage="lift", goal=goal), timeout=30)
    assert (response.ok, response.error, response.colliding[1]) == (False, "start_in_collision", "ball_1")
    planner.scenes.put(scene())
    assert (await planner.plan.call(PlanRequest(id="3", goal=goal), timeout=30)).ok


async def test_concurrent_requests_are_all_answered(planner):
    planner.scenes.put(scene())
    planner.put_state(HOME + 0.1)
    assert await planner.plan_together(5) == expected_starts(5)


class FakeWorker:
    """A worker in this process that plans once all of `together` have a request; a dead one has no answer."""

    def __init__(self, together: threading.Barrier, *, dead: bool = False):
        self.together, self.dead, self.requests, self.closed = together, dead, [], False

    def set_up(self, robot, motion, pipeline, *, seed):
        self.pipeline = PlanningPipeline(RobotModel.load(robot), motion, pipeline, seed=seed)

    async def plan(self, request, scene, current, width):
        self.requests.append(request.id)
        if self.dead:
            raise WorkerDied("the planning worker has ended")
        await asyncio.to_thread(self.together.wait, 20)
        return self.pipeline.plan(request, scene, current, None, (), width)

    def close(self):
        self.closed = True


async def test_workers_plan_concurrent_requests_in_parallel_and_end_with_the_service():
    together = threading.Barrier(2)
    workers = [FakeWorker(together), FakeWorker(together)]  # each plans only while the other does
    async with serving(workers) as user:
        user.scenes.put(scene())
        assert await user.plan_together(3) == expected_starts(3)
        assert not any(worker.closed for worker in workers)
    assert sorted(workers[0].requests + workers[1].requests) == ["1", "2"]  # the planner itself answers the first
    assert all(worker.closed for worker in workers)


async def test_request_of_a_dead_worker_is_planned_by_another_and_the_dead_one_gets_no_more():
    worker = FakeWorker(threading.Barrier(1), dead=True)
    async with serving([worker]) as user:
        user.scenes.put(scene())
        for turn in range(2):
            assert await user.plan_together(3, f"{turn}-") == expected_starts(3)
    assert worker.requests == ["0-1"]


@pytest.mark.parametrize("config", [{"helpers": 0}, {"points": {"cameras": [{"points": "depth_camera/points"}]}}],
                         ids=["none configured", "with points"])
async def test_unused_workers_are_closed(config):
    worker = FakeWorker(threading.Barrier(1))
    async with serving([worker], **config):
        assert worker.closed


async def test_stopping_the_service_ends_a_running_plan():
    options = {"planners": [{"name": "ompl", "options": {"algorithm": "AORRTC", "improving_time": 60}}]}
    down = [0.0, 0.5, 0, 0.1, 0, 0, 0]
    start, goal = ([a + b for a, b in zip([y, *HOME[1:]], down, strict=True)] for y in (0.6, -0.6))
    async with asyncio.timeout(30):
        async with serving(pipeline=options) as user:
            user.scenes.put(scene(box("wall", [0.3, 0.02, 0.4], 0.55, 0.2)))
            request = PlanRequest(id="1", start=start, goal=JointGoal(positions=goal), planning_time=300)
            call = asyncio.create_task(user.plan.call(request, timeout=300))
            await asyncio.sleep(0.2)
            assert not call.done()
        call.cancel()
        await asyncio.wait({call})


async def test_wiring_does_not_include_the_ground_truth():
    found = await wiring(motion_planner.run, CONFIG)
    assert SCENE_BALLS not in found.reads
    assert found.reads == {topics.PLANNING_SCENE, topics.JOINT_STATES, topics.MOTION_STATUS}
    assert found.serves == {topics.MOTION_PLAN}
    assert found.writes == {topics.DISPLAY_TRAJECTORY}


async def test_motion_status_without_an_id_is_ignored_and_the_next_motion_is_checked(planner) -> None:
    requested: asyncio.Queue[str] = asyncio.Queue()

    async def followed(request: FollowedRequest) -> ExecuteRequest:
        await requested.put(request.id)
        raise Refused("unknown_goal", "not followed here")

    planner.bus.serve(topics.MOTION_FOLLOWED, followed)
    motion = planner.bus.writer(topics.MOTION_STATUS)
    await planner.bus.ready()
    planner.scenes.put(scene())
    for name in ("x", "", "y"):  # no executor sends an empty id, but a faulty client could
        motion.put(MotionStatus(id=name, state="active"))
        if name:
            assert await asyncio.wait_for(requested.get(), 10) == name
        answer = await planner.plan.call(to_home(name or "none", start=[0.0]), timeout=30)  # the service is alive
        assert answer.error == "bad_start"
