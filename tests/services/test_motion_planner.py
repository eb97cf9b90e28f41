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


def scene(*objects: CollisionObject) -> PlanningScene:
    table = CollisionObject(
        id="table", role="fixture", shape="box", dimensions=[1.0, 1.0, 0.05],
        pose=Pose(position=Vector3(x=0.5, z=-0.025)),
    )
    return PlanningScene(header=Header(frame_id="world"), objects=[table, *objects])


class Planner:
    """A motion planner on a network of its own, and what its users hold."""

    def __init__(self, bus):
        self.bus = bus
        self.plan = bus.client(topics.MOTION_PLAN)
        self.scenes = bus.writer(topics.PLANNING_SCENE)
        self.states = bus.writer(topics.JOINT_STATES)
        self.display = bus.reader(topics.DISPLAY_TRAJECTORY)

    def stand_at(self, q, names=None):
        fingers = ["panda_finger_joint1", "panda_finger_joint2"]
        names = [*ROBOT.joint_names, *fingers] if names is None else names
        position = [*q, *[0.04] * (len(names) - len(q))]
        self.states.put(JointState(header=self.bus.header(), name=names, position=position))

    async def refusal(self, request) -> RemoteError:
        with pytest.raises(RemoteError) as caught:
            await self.plan.call(request, timeout=30)
        return caught.value


@pytest.fixture
async def planner():
    network = LocalNetwork()
    bus = network.bus("tester", cell="test", clock=Clock())
    user = Planner(bus)
    async with running_service(network, motion_planner.run, CONFIG, name="motion_planner"):
        await user.plan.wait_available(10)
        yield user


def to_home(id="1", **more) -> PlanRequest:
    return PlanRequest(id=id, goal=JointGoal(named="home"), **more)


async def test_request_is_answered_with_a_trajectory_that_is_also_displayed(planner):
    planner.scenes.put(scene())
    start = HOME + 0.2
    planner.stand_at(start)
    response = await planner.plan.call(to_home(), timeout=30)
    assert response.ok, response.message
    assert response.id == "1"
    assert response.header.stamp > 0
    assert response.trajectory.joint_names == ROBOT.joint_names
    assert response.trajectory.points[0].positions == pytest.approx(start, abs=1e-6)
    assert response.trajectory.points[-1].positions == pytest.approx(HOME, abs=1e-6)
    async with asyncio.timeout(30):
        assert (await planner.display.next()).points == response.trajectory.points


async def test_plan_is_for_the_fingers_as_joint_states_tell_them(planner):
    wall = CollisionObject(id="wall", role="fixture", shape="box", dimensions=[0.1, 0.04, 0.04],
                           pose=Pose(position=Vector3(x=0.5, z=0.02)))
    planner.scenes.put(scene(wall))
    about = PlanRequest(id="1", goal=PoseGoal(pose=matrix_to_pose(tool_down(0.5, 0.0, 0.02))))
    names = [*ROBOT.joint_names, "panda_finger_joint1", "panda_finger_joint2"]
    planner.stand_at([*HOME, 0.04, 0.04], names)
    assert (await planner.plan.call(about, timeout=30)).ok, "they are about the wall"
    planner.stand_at([*HOME, 0.0, 0.0], names)
    refused = await planner.plan.call(about, timeout=30)
    assert not refused.ok and "finger" in refused.message


async def test_request_without_a_scene_is_refused(planner):
    planner.stand_at(HOME)
    refusal = await planner.refusal(to_home(stage="homing", start=list(HOME)))
    assert refusal.code == "no_scene"
    assert "homing" in refusal.message


async def test_request_without_a_start_is_refused_until_joint_states_are_known(planner):
    planner.scenes.put(scene())
    assert (await planner.refusal(to_home())).code == "no_state"
    planner.stand_at(HOME[:3], names=ROBOT.joint_names[:3])
    assert (await planner.refusal(to_home())).code == "no_state"
    assert (await planner.plan.call(to_home(start=list(HOME + 0.1)), timeout=30)).ok
    planner.stand_at(HOME + 0.1)
    assert (await planner.plan.call(to_home(), timeout=30)).ok


async def test_start_in_collision_is_answered_with_the_pair_and_the_next_request_is_served(planner):
    where = ROBOT.fk(HOME)[:3, 3]
    in_hand = CollisionObject(
        id="ball_1", role="target", shape="sphere", dimensions=[0.03],
        pose=Pose(position=Vector3(x=where[0], y=where[1], z=where[2] + 0.06)),
    )
    planner.scenes.put(scene(in_hand))
    planner.stand_at(HOME)
    goal = PoseGoal(pose=matrix_to_pose(tool_down(0.4, 0.1, 0.3)))
    response = await planner.plan.call(PlanRequest(id="2", stage="lift", goal=goal), timeout=30)
    assert not response.ok
    assert response.error == "start_in_collision"
    assert response.colliding[1] == "ball_1"
    planner.scenes.put(scene())
    assert (await planner.plan.call(PlanRequest(id="3", goal=goal), timeout=30)).ok


async def test_requests_at_the_same_time_are_all_answered(planner):
    planner.scenes.put(scene())
    planner.stand_at(HOME + 0.1)
    requests = [to_home(start=list(HOME + 0.01 * i)) for i in range(5)]
    answers = await asyncio.gather(*(planner.plan.call(request, timeout=20) for request in requests))
    assert all(answer.ok for answer in answers)
    starts = [answer.trajectory.points[0].positions[0] for answer in answers]
    assert starts == pytest.approx([HOME[0] + 0.01 * i for i in range(5)], abs=1e-6)


class HelperDouble:
    """A helper in this process, which plans when all of `together` have been asked; one that is lost has no answer."""

    def __init__(self, together: threading.Barrier, *, lost: bool = False):
        self.together, self.lost, self.asked, self.closed = together, lost, [], False

    def set_up(self, robot, motion, pipeline, *, seed):
        self.pipeline = PlanningPipeline(RobotModel.load(robot), motion, pipeline, seed=seed)

    async def plan(self, request, scene, current, width):
        self.asked.append(request.id)
        if self.lost:
            raise WorkerDied("the planning worker has ended")
        await asyncio.to_thread(self.together.wait, 20)
        return self.pipeline.plan(request, scene, current, None, (), width)

    def close(self):
        self.closed = True


@asynccontextmanager
async def planner_with(others, **config):
    network = LocalNetwork()
    user = Planner(network.bus("tester", cell="test", clock=Clock()))
    config = motion_planner.Config.model_validate(CONFIG.model_dump() | config)
    run = partial(motion_planner.run, helpers=others)
    async with asyncio.timeout(60), running_service(network, run, config, name="motion_planner"):
        await user.plan.wait_available(20)
        user.scenes.put(scene())
        user.stand_at(HOME + 0.1)
        yield user


async def test_helpers_plan_at_the_same_time_what_is_asked_for_at_once():
    together = threading.Barrier(2)
    helpers = [HelperDouble(together), HelperDouble(together)]  # each plans only while the other does
    async with planner_with(helpers) as user:
        requests = [to_home(str(i), start=list(HOME + 0.01 * i)) for i in range(3)]
        answers = await asyncio.gather(*(user.plan.call(request, timeout=30) for request in requests))
        assert not any(helper.closed for helper in helpers)
    assert [answer.trajectory.points[0].positions[0] for answer in answers] == pytest.approx(
        [HOME[0] + 0.01 * i for i in range(3)], abs=1e-6)
    assert sorted(helpers[0].asked + helpers[1].asked) == ["1", "2"]  # the first is the planner's own
    assert all(helper.closed for helper in helpers)  # with the service


async def test_request_of_a_helper_that_is_lost_is_planned_by_another_and_the_lost_one_is_asked_no_more():
    helper = HelperDouble(threading.Barrier(1), lost=True)
    async with planner_with([helper]) as user:
        for turn in range(2):
            requests = [to_home(f"{turn}-{i}", start=list(HOME + 0.01 * i)) for i in range(3)]
            answers = await asyncio.gather(*(user.plan.call(request, timeout=30) for request in requests))
            assert all(answer.ok for answer in answers)
    assert helper.asked == ["0-1"]


@pytest.mark.parametrize("config", [{"helpers": 0}, {"points": {"cameras": [{"points": "depth_camera/points"}]}}],
                         ids=["none wanted", "with points"])
async def test_helpers_that_are_not_wanted_are_let_go_of(config):
    helper = HelperDouble(threading.Barrier(1))
    async with planner_with([helper], **config):
        assert helper.closed


async def test_service_that_is_stopped_ends_a_running_plan():
    network = LocalNetwork()
    bus = network.bus("tester", cell="test", clock=Clock())
    user = Planner(bus)
    options = {"planners": [{"name": "ompl", "options": {"algorithm": "AORRTC", "improving_time": 60}}]}
    config = motion_planner.Config.model_validate(CONFIG.model_dump() | {"pipeline": options})
    wall = CollisionObject(
        id="wall", role="fixture", shape="box", dimensions=[0.3, 0.02, 0.4],
        pose=Pose(position=Vector3(x=0.55, z=0.2)),
    )
    left = [0.6, *HOME[1:]]
    right = [-0.6, *HOME[1:]]
    down = [0.0, 0.5, 0, 0.1, 0, 0, 0]
    start, goal = ([a + b for a, b in zip(q, down, strict=True)] for q in (left, right))
    async with asyncio.timeout(30):
        async with running_service(network, motion_planner.run, config, name="motion_planner"):
            await user.plan.wait_available(10)
            user.scenes.put(scene(wall))
            request = PlanRequest(id="1", start=start, goal=JointGoal(positions=goal), planning_time=300)
            asked = asyncio.create_task(user.plan.call(request, timeout=300))
            await asyncio.sleep(0.2)
            assert not asked.done()
        asked.cancel()
        await asyncio.wait({asked})


async def test_wiring_reads_no_truth():
    found = await wiring(motion_planner.run, CONFIG)
    assert SCENE_BALLS not in found.reads
    assert found.reads == {topics.PLANNING_SCENE, topics.JOINT_STATES, topics.MOTION_STATUS}
    assert found.serves == {topics.MOTION_PLAN}
    assert found.writes == {topics.DISPLAY_TRAJECTORY}


async def test_motion_without_an_id_is_not_watched_and_the_next_one_is(planner: Planner) -> None:
    asked: asyncio.Queue[str] = asyncio.Queue()

    async def followed(request: FollowedRequest) -> ExecuteRequest:
        await asked.put(request.id)
        raise Refused("unknown_goal", "not followed here")

    planner.bus.serve(topics.MOTION_FOLLOWED, followed)
    motion = planner.bus.writer(topics.MOTION_STATUS)
    await planner.bus.ready()
    planner.scenes.put(scene())
    for name in ("x", "", "y"):  # no executor leaves it empty, but anybody on the network can
        motion.put(MotionStatus(id=name, state="active"))
        if name:
            assert await asyncio.wait_for(asked.get(), 10) == name
        answer = await planner.plan.call(to_home(name or "none", start=[0.0]), timeout=30)  # it is there
        assert answer.error == "bad_start"
