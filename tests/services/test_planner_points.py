"""A planner with a depth camera avoids obstacles that the planning scene lacks, or reports why it cannot."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack

import numpy as np
import pytest
from pydantic import ValidationError

from common import topics
from common.clock import Clock
from common.config import (
    ObjectConfig,
    Run,
    Surroundings,
    World,
    check,
    config_root,
    load_cell,
    read_yaml,
    service_config,
)
from common.errors import RemoteError
from common.messages import (
    CollisionObject,
    Header,
    JointGoal,
    JointState,
    PlanRequest,
    PointCloud2,
    Pose,
    TFMessage,
    Vector3,
    WorldObjects,
)
from common.perception.camera_input import FrameError
from common.planning.camera_obstacles import JointHistory, PointsOptions, cloud_points, frame_pose
from common.planning.collision import CollisionWorld, interpolate
from common.planning.ik import solve_ik
from common.process.in_process import running_service
from common.process.timing import call_until_answered
from common.robot.transforms import rpy_to_matrix, transform
from common.sim.objects import world_object
from common.supervision.wiring import wiring
from common.transport.local import LocalNetwork
from services import depth_camera, motion_planner
from services.robot_state_publisher import stamped
from tests.common.planning.ur5_scene import HOME, ROBOT, SCENE, tip_at

W2 = check(World, read_yaml(config_root() / "worlds" / "w2.yaml"))
AROUND = Surroundings.model_validate({f: getattr(W2, f) for f in Surroundings.model_fields})
CAMERA = depth_camera.Config(world=AROUND, robot=load_cell("ur5").robot, run=Run(cell="test"), rate=10, max_rate=10)
PLANNER = service_config(load_cell("ur5"), "motion_planner", motion_planner.Config)
DEPTH = {"depth": topics.DEPTH_CAMERA_DEPTH.key, "info": topics.DEPTH_CAMERA_INFO.key}
UNKNOWN = {"unknown": "occupied", "box": {"low": [0.42, -0.1, 1.02], "high": [0.58, 0.1, 1.3]}}
POST = ObjectConfig(id="post", shape="box", x=0.5, y=0.0, z=1.0, size=(0.08, 0.08), height=0.25)


def with_points(**options) -> motion_planner.Config:
    return PLANNER.model_copy(update={"points": PointsOptions(stride=4, max_age=60.0, **options)})


class Cell:
    """A network with clients of a planner and a depth camera."""

    def __init__(self) -> None:
        self.net = LocalNetwork()
        self.bus = self.net.bus("tester", cell="test", clock=Clock())
        self.plan = self.bus.client(topics.MOTION_PLAN)
        self.scenes, self.joints = self.bus.writer(topics.PLANNING_SCENE), self.bus.writer(topics.JOINT_STATES)
        self.truth, self.static = self.bus.writer(topics.SCENE_OBJECTS), self.bus.writer(topics.TF_STATIC)
        self.depths = self.bus.reader(topics.DEPTH_CAMERA_DEPTH)
        self.clouds = self.bus.reader(topics.DEPTH_CAMERA_POINTS)

    def publish(self, q: np.ndarray, *objects: ObjectConfig, stamp: int | None = None) -> None:
        camera = AROUND.camera
        T = transform(rpy_to_matrix(*camera.rpy), camera.position)
        self.static.put(TFMessage(transforms=[stamped("world", camera.frame, T, 0)]))
        self.scenes.put(SCENE)
        self.put_state(q, stamp)
        self.truth.put(WorldObjects(objects=[world_object(item) for item in objects]))

    def put_state(self, q: np.ndarray, stamp: int | None = None) -> None:
        header = self.bus.header() if stamp is None else Header(stamp=stamp)
        self.joints.put(JointState(header=header, name=ROBOT.joint_names, position=list(q)))

    async def new_image(self, reader) -> None:
        """Wait for an image taken from now on, and publish a joint state at its time."""
        now = self.bus.clock.now_ns()
        async with asyncio.timeout(60):
            while (image := await reader.next()).header.stamp < now:
                pass
        self.put_state(START, image.header.stamp)

    async def refusal(self) -> RemoteError:
        with pytest.raises(RemoteError) as caught:
            await self.plan.call(ACROSS.model_copy(update={"stage": "reach"}), timeout=60)
        assert caught.value.message.startswith("reach: ")
        return caught.value


def joints_at(y: float) -> np.ndarray:
    """Joint positions with the tool pointing down next to the block's middle, close above it."""
    found = solve_ik(ROBOT, tip_at(0.5, y, 1.15), HOME, rng=np.random.default_rng(1))
    assert found is not None
    return found


START, GOAL = joints_at(-0.3), joints_at(0.3)
ACROSS = PlanRequest(id="1", start=START.tolist(), goal=JointGoal(positions=GOAL.tolist()))


def real_world() -> CollisionWorld:
    post = CollisionObject(
        id="post", role="fixture", shape="box", dimensions=[0.08, 0.08, 0.25],
        pose=Pose(position=Vector3(x=0.5, y=0.0, z=1.125)),
    )
    return CollisionWorld(ROBOT, SCENE.model_copy(update={"objects": [*SCENE.objects, post]}), start=START)


def hits(response) -> bool:
    path = interpolate(np.array([point.positions for point in response.trajectory.points]), 0.005)
    return real_world().first_collision(path) is not None


@pytest.mark.parametrize("camera", [DEPTH, {"points": topics.DEPTH_CAMERA_POINTS.key}], ids=["depth", "cloud"])
async def test_obstacle_that_only_the_camera_sees_is_avoided(camera) -> None:
    cell, kinds = Cell(), [PLANNER, with_points(cameras=[camera], **(UNKNOWN if "depth" in camera else {}))]
    outcomes = []
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(running_service(cell.net, depth_camera.run, CAMERA, name="depth_camera"))
        for config in kinds:
            async with running_service(cell.net, motion_planner.run, config, name="motion_planner"):
                await cell.plan.wait_available(20)
                cell.publish(START, POST)
                await cell.new_image(cell.clouds if "points" in camera else cell.depths)
                response = await cell.plan.call(ACROSS, timeout=60)
                assert response.ok, response.message
                outcomes.append(hits(response))
    assert outcomes[0]  # the post obstructs the path without points
    assert not outcomes[1]


@pytest.fixture
async def planner():
    cell = Cell()
    async with running_service(cell.net, motion_planner.run, with_points(cameras=[DEPTH]), name="motion_planner"):
        await cell.plan.wait_available(20)
        yield cell


async def test_request_before_the_first_image_is_refused(planner) -> None:
    planner.publish(START)
    refusal = await planner.refusal()
    assert refusal.code == "no_points" and "depth_camera/depth/image_raw: no image received yet" in refusal.message


async def test_image_without_a_joint_state_at_its_time_is_refused(planner) -> None:
    async with running_service(planner.net, depth_camera.run, CAMERA, name="depth_camera"):
        planner.publish(START, stamp=1)
        async with asyncio.timeout(60):
            await planner.depths.next()
        refusal = await planner.refusal()
        assert refusal.code == "no_state" and "no joint state at the time" in refusal.message


async def test_old_image_is_refused() -> None:
    cell, config = Cell(), PLANNER.model_copy(update={"points": PointsOptions(cameras=[DEPTH], max_age=1e-6)})
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(running_service(cell.net, motion_planner.run, config, name="motion_planner"))
        await stack.enter_async_context(running_service(cell.net, depth_camera.run, CAMERA, name="depth_camera"))
        await cell.plan.wait_available(20)
        cell.publish(START)
        await cell.new_image(cell.depths)
        refusal = await cell.refusal()
        assert refusal.code == "old_points" and "limit points.max_age is 1e-06 s" in refusal.message


async def test_unknown_camera_frame_is_refused(planner) -> None:
    async with running_service(planner.net, depth_camera.run, CAMERA, name="depth_camera"):
        planner.publish(START)
        planner.static.put(TFMessage(transforms=[stamped("world", "elsewhere", np.eye(4), 0)]))
        await planner.new_image(planner.depths)
        refusal = await planner.refusal()
    assert refusal.code == "bad_points" and "depth_camera_optical_frame" in refusal.message


async def test_client_retries_a_request_that_came_before_the_first_image() -> None:
    reports: list[str] = []

    class Client:
        async def call(self, request, timeout):
            if not reports:
                raise RemoteError("motion/plan", "no_points", "no image received yet")
            return "a plan"

    answer = await call_until_answered(Client(), ACROSS, 1.0, refused=lambda error: error, report=reports.append)
    assert answer == "a plan" and len(reports) == 1


async def test_wiring_includes_the_configured_cameras() -> None:
    plain = {topic.key for topic in (await wiring(motion_planner.run, PLANNER)).reads}
    assert plain == {topics.PLANNING_SCENE.key, topics.JOINT_STATES.key, topics.MOTION_STATUS.key}
    other = {"points": "left/points"}
    found = {topic.key for topic in (await wiring(motion_planner.run, with_points(cameras=[DEPTH, other]))).reads}
    assert found - plain == {topics.TF_STATIC.key, "left/points", *DEPTH.values()}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cameras": [{}]}, "either points, or depth and info"),
        ({"cameras": [{"depth": "a"}]}, "either points, or depth and info"),
        ({"cameras": [DEPTH], "unknown": "occupied"}, "needs a box"),
        ({"cameras": [{"points": "a"}], **UNKNOWN}, "needs depth and info"),
        ({"cameras": [DEPTH], "unknown": "occupied", "box": {"low": [0, 0, 0], "high": [1, 0, 1]}}, "less than high"),
        ({"cameras": [DEPTH], "unknown": "occupied", "box": {"low": [0, 0, 0], "high": [9, 9, 9]}}, "million cubes"),
    ],
)
def test_invalid_options_are_refused(options, message) -> None:
    with pytest.raises(ValidationError, match=message):
        PointsOptions(**options)


def test_mounted_camera_has_the_pose_of_its_link() -> None:
    on_tool = transform(np.eye(3), (0.0, 0.05, 0.1))
    link = ROBOT.link_names[-1]
    poses = TFMessage(transforms=[stamped("mount", "lens", on_tool, 0), stamped(link, "mount", on_tool, 0)])
    expected = ROBOT.link_poses(START)[link] @ on_tool @ on_tool
    np.testing.assert_allclose(frame_pose("lens", poses, ROBOT, START), expected, atol=1e-12)
    with pytest.raises(FrameError, match="'nowhere'; its frames: lens, mount"):
        frame_pose("nowhere", poses, ROBOT, START)
    cycle = TFMessage(transforms=[stamped("a", "b", on_tool, 0), stamped("b", "a", on_tool, 0)])
    with pytest.raises(FrameError, match="frame 'a'; its"):
        frame_pose("a", cycle, ROBOT, START)


def test_joint_history_interpolates_between_close_states() -> None:
    history = JointHistory(ROBOT)
    for stamp, q in ((1.0, START), (1.02, START + 0.02), (1.01, START - 1), (3.0, GOAL)):
        header = Header(stamp=int(stamp * 1e9))
        history.add(JointState(header=header, name=ROBOT.joint_names, position=list(q)))
    np.testing.assert_allclose(history.at(int(1.005e9)), START + 0.005, atol=1e-9)
    np.testing.assert_allclose(history.at(int(1.1e9)), START + 0.02)
    np.testing.assert_allclose(history.at(int(3.05e9)), GOAL)
    assert history.at(int(2e9)) is None and history.at(int(0.8e9)) is None


def test_cloud_points_are_read_by_field_names() -> None:
    rows = np.zeros((2, 20), np.uint8)  # a row of two points and four bytes of padding
    values = np.array([[[1, 2], [3, 4]], [[5, 6], [np.nan, 8]]], "<f4")
    rows[:, :16] = values.reshape(2, 4).view(np.uint8)
    cloud = PointCloud2(
        header=Header(), height=2, width=2, fields=["y", "x"], point_step=8, row_step=20, data=rows.tobytes()
    )
    with pytest.raises(FrameError, match="the cloud has no z; its fields are y, x"):
        cloud_points(cloud)
    flat = cloud.model_copy(update={"fields": ["z", "x"]})
    with pytest.raises(FrameError, match="no y"):
        cloud_points(flat)
    three = values.repeat(2, axis=2)[..., :3].copy()  # x, x, y
    three = np.ascontiguousarray(three)
    complete = PointCloud2(
        header=Header(), height=2, width=2, fields=["z", "x", "y"], point_step=12, row_step=24, data=three.tobytes()
    )
    np.testing.assert_allclose(cloud_points(complete), [[1, 2, 1], [3, 4, 3], [5, 6, 5]])
    with pytest.raises(FrameError, match="too few for 2x2"):
        cloud_points(complete.model_copy(update={"data": b"0" * 47}))
    with pytest.raises(FrameError, match="do not fit"):
        cloud_points(complete.model_copy(update={"row_step": 20}))
