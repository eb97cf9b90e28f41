"""A planner with a depth camera avoids obstacles that the planning scene lacks, or reports why it cannot."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from common import messages as m
from common import topics
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
from common.perception.camera_input import FrameError
from common.perception.pinhole import Pinhole
from common.planning.camera_obstacles import JointHistory, PointsOptions, cloud_points, frame_pose
from common.planning.collision import CollisionWorld, interpolate
from common.planning.ik import solve_ik
from common.process.timing import call_until_answered
from common.robot.transforms import transform
from common.sim.objects import world_object
from services import depth_camera, motion_planner
from services.robot_state_publisher import stamped
from tests.common.planning.ur5_scene import HOME, ROBOT, SCENE, tip_at
from tests.services.fake_cell import FakeCell, at, until

W2 = check(World, read_yaml(config_root() / "worlds" / "w2.yaml"))
AROUND = Surroundings.model_validate({f: getattr(W2, f) for f in Surroundings.model_fields})
CAMERA = depth_camera.Config(world=AROUND, robot=load_cell("ur5").robot, run=Run(cell="test"), rate=30, max_rate=30)
PLANNER = service_config(load_cell("ur5"), "motion_planner", motion_planner.Config)
DEPTH = {"depth": topics.DEPTH_CAMERA_DEPTH.key, "info": topics.DEPTH_CAMERA_INFO.key}
UNKNOWN = {"unknown": "occupied", "box": {"low": [0.42, -0.1, 1.02], "high": [0.58, 0.1, 1.3]}}
POST = ObjectConfig(id="post", shape="box", x=0.5, y=0.0, z=1.0, size=(0.08, 0.08), height=0.25)


def joints_at(y: float) -> np.ndarray:
    """Return joint positions with the tool pointing down next to the block's middle, close above it."""
    found = solve_ik(ROBOT, tip_at(0.5, y, 1.15), HOME, rng=np.random.default_rng(1))
    assert found is not None
    return found


START, GOAL = joints_at(-0.3), joints_at(0.3)
ACROSS = m.PlanRequest(id="1", stage="reach", start=START.tolist(), goal=m.JointGoal(positions=GOAL.tolist()))


def with_points(**options: Any) -> motion_planner.Config:
    return PLANNER.model_copy(update={"points": PointsOptions(**{"stride": 4, "max_age": 60.0, **options})})


class Cell(FakeCell):
    """A client of a planner that has a depth camera."""

    def __init__(self) -> None:
        super().__init__()
        self.plan = self.client(topics.MOTION_PLAN)
        self.depths, self.clouds = self.reader(topics.DEPTH_CAMERA_DEPTH), self.reader(topics.DEPTH_CAMERA_POINTS)

    def show(self, *objects: ObjectConfig, stamp: int | None = None) -> None:
        """Publish scene, truth, camera pose, and joint positions of now or of a time [ns]."""
        T = Pinhole.from_config(AROUND.camera).T_world_optical
        self.put(topics.TF_STATIC, m.TFMessage(transforms=[stamped("world", AROUND.camera.frame, T, 0)]))
        self.put(topics.PLANNING_SCENE, SCENE)
        self.put_joints(ROBOT.joint_names, START, stamp)
        self.put(topics.SCENE_OBJECTS, m.WorldObjects(objects=[world_object(item) for item in objects]))

    async def last_image(self, cloud: bool = False, *objects: ObjectConfig) -> None:
        """Run the camera for an image of objects, and publish a joint state at its time: no later image comes."""
        reader, now = self.clouds if cloud else self.depths, self.clock.now_ns()
        async with self.running(depth_camera, CAMERA):
            self.show(*objects)
            await until(reader, lambda image: image.header.stamp >= now)
        self.put_joints(ROBOT.joint_names, START, reader.latest.header.stamp)

    async def refusal(self) -> RemoteError:
        with pytest.raises(RemoteError) as caught:
            await self.plan.call(ACROSS, timeout=60)
        assert caught.value.message.startswith("reach: ")
        return caught.value


@pytest.mark.parametrize("camera", [DEPTH, {"points": topics.DEPTH_CAMERA_POINTS.key}], ids=["depth", "cloud"])
async def test_obstacle_that_only_the_camera_sees_is_avoided(camera: dict[str, str]) -> None:
    cell, collides = Cell(), []
    post = m.CollisionObject(id="post", role="fixture", shape="box", dimensions=[0.08, 0.08, 0.25],
                           pose=at(0.5, 0, 1.125))
    world = CollisionWorld(ROBOT, SCENE.model_copy(update={"objects": [*SCENE.objects, post]}), start=START)
    for config in (PLANNER, with_points(cameras=[camera], **(UNKNOWN if "depth" in camera else {}))):
        async with cell.running(motion_planner, config):
            await cell.plan.wait_available(20)
            await cell.last_image("points" in camera, POST)
            response = await cell.plan.call(ACROSS, timeout=60)
            assert response.ok, response.message
            path = interpolate(np.array([point.positions for point in response.trajectory.points]), 0.005)
            collides.append(world.first_collision(path) is not None)
    assert collides == [True, False], "the post obstructs the path without points"


@pytest.fixture
async def planner() -> AsyncIterator[Cell]:
    cell = Cell()
    async with cell.running(motion_planner, with_points(cameras=[DEPTH])):
        await cell.plan.wait_available(20)
        yield cell


async def test_request_without_a_usable_image_is_refused_with_the_reason(planner: Cell) -> None:
    planner.show(stamp=1)
    refusal = await planner.refusal()
    assert refusal.code == "no_points" and "depth_camera/depth/image_raw: no image received yet" in refusal.message
    async with planner.running(depth_camera, CAMERA):
        planner.show(stamp=1)
        await until(planner.depths)
        refusal = await planner.refusal()
        assert refusal.code == "no_state" and "no joint state at the time" in refusal.message
    await planner.last_image()
    planner.put(topics.TF_STATIC, m.TFMessage(transforms=[stamped("world", "elsewhere", np.eye(4), 0)]))
    refusal = await planner.refusal()
    assert refusal.code == "bad_points" and "depth_camera_optical_frame" in refusal.message


async def test_old_image_is_refused() -> None:
    cell = Cell()
    config = with_points(cameras=[DEPTH], max_age=1e-6)
    async with cell.running(motion_planner, config):
        await cell.plan.wait_available(20)
        await cell.last_image()
        refusal = await cell.refusal()
        assert refusal.code == "old_points" and "limit points.max_age is 1e-06 s" in refusal.message


async def test_client_retries_a_request_that_came_before_the_first_image() -> None:
    reports: list[str] = []

    class Client:
        async def call(self, request: m.PlanRequest, timeout: float) -> str:
            if not reports:
                raise RemoteError("motion/plan", "no_points", "no image received yet")
            return "a plan"

    answer = await call_until_answered(Client(), ACROSS, 1.0, refused=lambda error: error, report=reports.append)
    assert answer == "a plan" and len(reports) == 1


@pytest.mark.parametrize(("options", "message"), [
    ({"cameras": [{}]}, "either points, or depth and info"),
    ({"cameras": [{"depth": "a"}]}, "either points, or depth and info"),
    ({"cameras": [DEPTH], "unknown": "occupied"}, "needs a box"),
    ({"cameras": [{"points": "a"}], **UNKNOWN}, "needs depth and info"),
    ({"cameras": [DEPTH], "unknown": "occupied", "box": {"low": [0, 0, 0], "high": [1, 0, 1]}}, "less than high"),
    ({"cameras": [DEPTH], "unknown": "occupied", "box": {"low": [0, 0, 0], "high": [9, 9, 9]}}, "million cubes"),
])
def test_invalid_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        PointsOptions(**options)


def test_mounted_camera_has_the_pose_of_its_link() -> None:
    on_tool = transform(np.eye(3), (0.0, 0.05, 0.1))
    link = ROBOT.link_names[-1]
    poses = m.TFMessage(transforms=[stamped("mount", "lens", on_tool, 0), stamped(link, "mount", on_tool, 0)])
    expected = ROBOT.link_poses(START)[link] @ on_tool @ on_tool
    np.testing.assert_allclose(frame_pose("lens", poses, ROBOT, START), expected, atol=1e-12)
    with pytest.raises(FrameError, match="'nowhere'; its frames: lens, mount"):
        frame_pose("nowhere", poses, ROBOT, START)
    cycle = m.TFMessage(transforms=[stamped("a", "b", on_tool, 0), stamped("b", "a", on_tool, 0)])
    with pytest.raises(FrameError, match="frame 'a'; its"):
        frame_pose("a", cycle, ROBOT, START)


def test_joint_history_interpolates_between_close_states() -> None:
    history = JointHistory(ROBOT)
    for stamp, q in ((1.0, START), (1.02, START + 0.02), (1.01, START - 1), (3.0, GOAL)):
        header = m.Header(stamp=int(stamp * 1e9))
        history.add(m.JointState(header=header, name=ROBOT.joint_names, position=list(q)))
    np.testing.assert_allclose(history.at(int(1.005e9)), START + 0.005, atol=1e-9)
    np.testing.assert_allclose(history.at(int(1.1e9)), START + 0.02)
    np.testing.assert_allclose(history.at(int(3.05e9)), GOAL)
    assert history.at(int(2e9)) is None and history.at(int(0.8e9)) is None


def test_cloud_points_are_read_by_field_names() -> None:
    values = np.array([[[1, 2], [3, 4]], [[5, 6], [np.nan, 8]]], "<f4")
    data = np.ascontiguousarray(values.repeat(2, axis=2)[..., :3]).tobytes()  # x, x, y
    cloud = m.PointCloud2(
        header=m.Header(), height=2, width=2, fields=["z", "x", "y"], point_step=12, row_step=24, data=data)
    np.testing.assert_allclose(cloud_points(cloud), [[1, 2, 1], [3, 4, 3], [5, 6, 5]])
    padded = b"".join(data[row:row + 24] + b"pads" for row in (0, 24))
    np.testing.assert_allclose(cloud_points(cloud.model_copy(update={"row_step": 28, "data": padded})),
                               cloud_points(cloud))
    for changes, problem in (
        ({"fields": ["y", "x", "u"]}, "the cloud has no z; its fields are y, x, u"),
        ({"fields": ["z", "x", "u"]}, "no y"),
        ({"data": data[:47]}, "too few for 2x2"),
        ({"row_step": 20}, "do not fit"),
    ):
        with pytest.raises(FrameError, match=problem):
            cloud_points(cloud.model_copy(update=changes))
