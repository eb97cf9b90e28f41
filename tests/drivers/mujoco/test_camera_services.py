import asyncio

import numpy as np
import pytest

from common import topics
from common.config import Run, Scenery, Surroundings, load_cell
from common.messages import Header, JointState, WorldObjects
from common.perception.image import image_to_array
from common.perception.pinhole import Pinhole
from common.process.in_process import running_service
from common.robot.model import RobotModel
from common.sim.interface import load_world
from common.supervision.wiring import wiring
from common.transport.local import LocalNetwork
from services import camera_simulator, depth_camera

PHYSICS = Scenery(simulator="mujoco")


def small(cell):
    """The surroundings of a cell, with a camera that sees the same in a quarter of the size."""
    camera = cell.world.camera
    update = {field: getattr(camera, field) / 4 for field in ("fx", "fy")}
    update |= {field: getattr(camera, field) // 4 for field in ("width", "height")}
    update |= {field: (getattr(camera, field) + 0.5) / 4 - 0.5 for field in ("cx", "cy")}
    around = {field: getattr(cell.world, field) for field in Surroundings.model_fields}
    view = camera.model_copy(update=update)
    return Surroundings.model_validate(around | {"camera": view, "cameras": {"camera": view}})


def at_home(robot, stamp):
    locked = robot.config.locked_joints
    return JointState(header=Header(stamp=stamp), name=[*robot.joint_names, *locked],
                      position=[*robot.named("home"), *locked.values()])


async def first_images(service, config, cell, images, objects):
    net = LocalNetwork()
    tester = net.bus()
    robot = RobotModel.load(cell.robot)
    reader, depths = tester.reader(images), tester.reader(topics.DEPTH_CAMERA_DEPTH)
    tester.writer(topics.SCENE_OBJECTS).put(objects)
    joints = tester.writer(topics.JOINT_STATES)
    async with running_service(net, service.run, config):
        joints.put(at_home(robot, tester.clock.now_ns()))
        image = image_to_array(await asyncio.wait_for(reader.next(), 30))
        return image, depths.latest


async def test_plain_camera_shows_arm_and_objects_of_the_physics_world() -> None:
    cell = load_cell("panda")
    config = camera_simulator.Config(world=small(cell), scenery=PHYSICS, robot=cell.robot, run=Run(cell="test"))
    assert (await wiring(camera_simulator.run, config)).reads == {topics.SCENE_OBJECTS, topics.JOINT_STATES}
    objects = load_world(cell.world.model_copy(update={"simulator": "kinematic"}), cell.world.objects).objects(Header())
    image, _ = await first_images(camera_simulator, config, cell, topics.CAMERA_IMAGE, objects)
    camera = Pinhole.from_config(small(cell).camera)
    for thing in objects.objects:
        p = thing.pose.position
        u, v = np.rint(camera.project((p.x, p.y, p.z))).astype(int)
        b, g, r = image[v, u].astype(int)
        assert r > 3 * max(b, g), f"{thing.id} is rendered at its position"
    assert image.shape == (120, 160, 3)
    b, g, r = image[112:, 60:100].reshape(-1, 3).mean(axis=0)
    assert max(b, g, r) - min(b, g, r) < 20, "the grey arm occludes the brown table"


async def test_depth_camera_measures_an_object_at_its_position() -> None:
    cell = load_cell("ur5")
    config = depth_camera.Config(world=small(cell), scenery=PHYSICS, robot=cell.robot, run=Run(cell="test"),
                                 farthest=5.0)
    objects = load_world(cell.world.model_copy(update={"simulator": "kinematic"}), cell.world.objects).objects(Header())
    image, depth_message = await first_images(depth_camera, config, cell, topics.DEPTH_CAMERA_IMAGE, objects)
    depth = image_to_array(depth_message)
    yellow = (image[..., 2] > 120) & (image[..., 1] > 120) & (image[..., 0] < 60)
    camera = Pinhole.from_config(small(cell).camera)
    top = camera.project((0.5, 0.0, 1.1))
    np.testing.assert_allclose(np.argwhere(yellow)[:, ::-1].mean(axis=0), top, atol=0.5)
    middle = np.rint(top).astype(int)
    assert depth[middle[1], middle[0]] == pytest.approx(2.75 - 1.1, abs=1e-3)
    side = np.sqrt(yellow.sum()) / camera.fx * (2.75 - 1.1)
    assert side == pytest.approx(0.1, abs=0.002), "the cube"


async def test_no_image_before_the_first_joint_state() -> None:
    cell = load_cell("panda")
    config = camera_simulator.Config(world=small(cell), scenery=PHYSICS, robot=cell.robot, run=Run(cell="test"))
    net = LocalNetwork()
    tester = net.bus()
    images = tester.reader(topics.CAMERA_IMAGE)
    tester.writer(topics.SCENE_OBJECTS).put(WorldObjects())
    async with running_service(net, camera_simulator.run, config):
        await asyncio.sleep(0.1)
        assert images.latest is None
