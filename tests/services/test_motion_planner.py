import asyncio
import threading
from contextlib import asynccontextmanager
from functools import partial

import pytest

from common import messages as m
from common import topics
from common.config import load_cell, service_config
from common.errors import Refused, RemoteError
from common.planning.pipeline import PlanningPipeline
from common.process.planning_worker import WorkerDied
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose, tool_down
from services import motion_planner
from tests.services.fake_cell import FakeCell, at, ball, until

CELL = load_cell("panda")
CONFIG = service_config(CELL, "motion_planner", motion_planner.Config)
ROBOT = RobotModel.load(CELL.robot)
HOME = ROBOT.named("home")
FINGERS = ["panda_finger_joint1", "panda_finger_joint2"]


def box(name: str, size: list[float], x: float, z: float) -> m.CollisionObject:
    return m.CollisionObject(id=name, role="fixture", shape="box", dimensions=size, pose=at(x, 0.0, z))


class User(FakeCell):
    """A client of the planner, with the scene and the joint states that the planner reads."""

    def __init__(self) -> None:
        super().__init__()
        self.plan = self.client(topics.MOTION_PLAN)

    def put_scene(self, *objects):
        table = box("table", [1.0, 1.0, 0.05], 0.5, -0.025)
        self.put(topics.PLANNING_SCENE, m.PlanningScene(header=m.Header(frame_id="world"), objects=[table, *objects]))

    def put_state(self, q, width=0.08):
        self.put_joints([*ROBOT.joint_names, *FINGERS], [*q, width / 2, width / 2])

    async def refusal(self, request) -> RemoteError:
        with pytest.raises(RemoteError) as caught:
            await self.plan.call(request, timeout=30)
        return caught.value

    async def plan_concurrently(self, count: int, prefix: str = "") -> None:
        """Plan to home from several starts at once; each answer must have its own start."""
        starts = [HOME + 0.01 * i for i in range(count)]
        requests = [to_home(f"{prefix}{i}", start=list(start)) for i, start in enumerate(starts)]
        answers = await asyncio.gather(*(self.plan.call(request, timeout=30) for request in requests))
        for answer, start in zip(answers, starts, strict=True):
            assert answer.trajectory.points[0].positions == pytest.approx(start, abs=1e-6)


@asynccontextmanager
async def serving(workers=(), **config):
    user, config = User(), motion_planner.Config.model_validate(CONFIG.model_dump() | config)
    async with asyncio.timeout(120), user.running(motion_planner, config, partial(motion_planner.run, helpers=workers)):
        await user.plan.wait_available(20)
        yield user


@pytest.fixture
async def planner():
    async with serving() as user:
        yield user


def to_home(id="1", **more) -> m.PlanRequest:
    return m.PlanRequest(id=id, goal=m.JointGoal(named="home"), **more)


async def test_request_is_answered_with_a_trajectory_that_is_also_displayed(planner):
    display = planner.reader(topics.DISPLAY_TRAJECTORY)
    planner.put_scene()
    planner.put_state(HOME + 0.2)
    response = await planner.plan.call(to_home(), timeout=30)
    assert response.ok and response.id == "1" and response.header.stamp > 0, response.message
    assert response.trajectory.joint_names == ROBOT.joint_names
    assert response.trajectory.points[0].positions == pytest.approx(HOME + 0.2, abs=1e-6)
    assert response.trajectory.points[-1].positions == pytest.approx(HOME, abs=1e-6)
    assert (await until(display)).points == response.trajectory.points


async def test_plan_uses_the_gripper_width_of_the_joint_states(planner):
    planner.put_scene(box("wall", [0.1, 0.04, 0.04], 0.5, 0.02))
    around_wall = m.PlanRequest(id="1", goal=m.PoseGoal(pose=matrix_to_pose(tool_down(0.5, 0.0, 0.02))))
    planner.put_state(HOME, width=0.08)
    assert (await planner.plan.call(around_wall, timeout=30)).ok
    planner.put_state(HOME, width=0.0)
    response = await planner.plan.call(around_wall, timeout=30)
    assert not response.ok and "finger" in response.message


async def test_request_without_a_scene_or_a_complete_joint_state_is_refused(planner):
    refusal = await planner.refusal(to_home(stage="homing", start=list(HOME)))
    assert refusal.code == "no_scene" and "homing" in refusal.message
    planner.put_scene()
    assert (await planner.refusal(to_home())).code == "no_state"
    planner.put_joints(ROBOT.joint_names[:3], HOME[:3])
    assert (await planner.refusal(to_home())).code == "no_state"
    assert (await planner.plan.call(to_home(start=list(HOME + 0.1)), timeout=30)).ok
    planner.put_state(HOME + 0.1)
    assert (await planner.plan.call(to_home(), timeout=30)).ok


async def test_failed_request_names_the_colliding_pair_and_the_next_is_served(planner):
    x, y, z = ROBOT.fk(HOME)[:3, 3]
    planner.put_scene(ball("ball_1", x, y, z + 0.06))  # within the gripper
    planner.put_state(HOME)
    goal = m.PoseGoal(pose=matrix_to_pose(tool_down(0.4, 0.1, 0.3)))
    response = await planner.plan.call(m.PlanRequest(id="2", stage="lift", goal=goal), timeout=30)
    assert (response.ok, response.error, response.colliding[1]) == (False, "start_in_collision", "ball_1")
    planner.put_scene()
    assert (await planner.plan.call(m.PlanRequest(id="3", goal=goal), timeout=30)).ok


async def test_velocity_scaling_changed_live_affects_the_next_plan(planner):
    planner.put_scene()
    below = ROBOT.fk(HOME)
    below[2, 3] -= 0.10
    request = m.PlanRequest(id="1", start=list(HOME), goal=m.PoseGoal(pose=matrix_to_pose(below)), straight=True)
    durations = []
    for values in ({}, {"motion.velocity_scaling": 0.05, "motion.acceleration_scaling": 0.05},
                   {"motion.cartesian_speed_scale": 0.5}):
        await planner.client(topics.parameters_of("motion_planner")).call(m.ParameterRequest(set=values, by="a test"))
        answer = await planner.plan.call(request, timeout=30)
        durations.append(answer.trajectory.points[-1].time_from_start)
    fast, slow, slower = durations
    assert slow > 1.9 * fast and slower == pytest.approx(2 * slow, rel=1e-6)


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
        user.put_scene()
        await user.plan_concurrently(3)
        assert not any(worker.closed for worker in workers)
    assert sorted(workers[0].requests + workers[1].requests) == ["1", "2"], "the planner itself answers the first"
    assert all(worker.closed for worker in workers)


async def test_request_of_a_dead_worker_is_planned_by_another_and_the_dead_one_gets_no_more():
    worker = FakeWorker(threading.Barrier(1), dead=True)
    async with serving([worker]) as user:
        user.put_scene()
        for turn in range(2):
            await user.plan_concurrently(3, f"{turn}-")
    assert worker.requests == ["0-1"]


@pytest.mark.parametrize("config", [{"helpers": 0}, {"points": {"cameras": [{"points": "depth_camera/points"}]}}],
                         ids=["none configured", "with points"])
async def test_unused_workers_are_closed(config):
    worker = FakeWorker(threading.Barrier(1))
    async with serving([worker], **config):
        assert worker.closed


async def test_stopping_the_service_ends_a_running_plan(monkeypatch):
    options = {"planners": [{"name": "ompl", "options": {"algorithm": "AORRTC", "improving_time": 60}}]}
    down = [0.0, 0.5, 0, 0.1, 0, 0, 0]
    start, goal = ([a + b for a, b in zip([y, *HOME[1:]], down, strict=True)] for y in (0.6, -0.6))
    loop, planning, plan = asyncio.get_running_loop(), asyncio.Event(), PlanningPipeline.plan

    def started(*given, **more):
        loop.call_soon_threadsafe(planning.set)
        return plan(*given, **more)

    monkeypatch.setattr(PlanningPipeline, "plan", started)
    async with asyncio.timeout(30):
        async with serving(pipeline=options) as user:
            user.put_scene(box("wall", [0.3, 0.02, 0.4], 0.55, 0.2))
            request = m.PlanRequest(id="1", start=start, goal=m.JointGoal(positions=goal), planning_time=300)
            call = asyncio.create_task(user.plan.call(request, timeout=300))
            await planning.wait()
            assert not call.done()
        call.cancel()
        await asyncio.wait({call})


async def test_motion_status_without_an_id_is_ignored_and_the_next_motion_is_checked(planner) -> None:
    requested: asyncio.Queue[str] = asyncio.Queue()

    async def followed(request: m.FollowedRequest) -> m.ExecuteRequest:
        await requested.put(request.id)
        raise Refused("unknown_goal", "not followed here")

    planner.bus.serve(topics.MOTION_FOLLOWED, followed)
    await planner.bus.ready()
    planner.put_scene()
    for name in ("x", "", "y"):  # no executor sends an empty id, but a faulty client could
        planner.put(topics.MOTION_STATUS, m.MotionStatus(id=name, state="active"))
        if name:
            assert await asyncio.wait_for(requested.get(), 10) == name
        answer = await planner.plan.call(to_home(name or "none", start=[0.0]), timeout=30)
        assert answer.error == "bad_start", "the service is alive"
