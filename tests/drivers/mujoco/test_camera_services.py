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
    """Return the surroundings of a cell, with a camera that sees the same in a quarter of the size."""
    camera = cell.world.camera
    update = {field: getattr(camera, field) / 4 for field in ("fx", "fy")}
    update |= {field: getattr(camera, field) // 4 for field in ("width", "height")}
    update |= {field: (getattr(camera, field) + 0.5) / 4 - 0.5 for field in ("cx", "cy")}
    view = camera.model_copy(update=update)
    around = {field: getattr(cell.world, field) for field in Surroundings.model_fields}
    return Surroundings.model_validate(around | {"camera": view, "cameras": {"camera": view}})


def objects_of(cell) -> WorldObjects:
    return load_world(cell.world.model_copy(update={"simulator": "kinematic"}), cell.world.objects).objects(Header())


async def first_images(service, config, cell, images):
    """Return the first image and depth image; check that there is none before the first joint state."""
    net = LocalNetwork()
    bus, robot, locked = net.bus(), RobotModel.load(cell.robot), cell.robot.locked_joints
    reader, depths = bus.reader(images), bus.reader(topics.DEPTH_CAMERA_DEPTH)
    bus.writer(topics.SCENE_OBJECTS).put(objects_of(cell))
    joints = bus.writer(topics.JOINT_STATES)
    async with running_service(net, service.run, config):
        await asyncio.sleep(0.1)
        assert reader.latest is None
        joints.put(JointState(header=bus.header(), name=[*robot.joint_names, *locked],
                              position=[*robot.named("home"), *locked.values()]))
        return image_to_array(await asyncio.wait_for(reader.next(), 30)), depths.latest


async def test_plain_camera_shows_arm_and_objects_of_the_physics_world() -> None:
    cell = load_cell("panda")
    config = camera_simulator.Config(world=small(cell), scenery=PHYSICS, robot=cell.robot, run=Run(cell="test"))
    assert (await wiring(camera_simulator.run, config)).reads == {topics.SCENE_OBJECTS, topics.JOINT_STATES}
    image, _ = await first_images(camera_simulator, config, cell, topics.CAMERA_IMAGE)
    camera = Pinhole.from_config(small(cell).camera)
    for thing in objects_of(cell).objects:
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
    image, depth_message = await first_images(depth_camera, config, cell, topics.DEPTH_CAMERA_IMAGE)
    yellow = (image[..., 2] > 120) & (image[..., 1] > 120) & (image[..., 0] < 60)
    camera = Pinhole.from_config(small(cell).camera)
    top = camera.project((0.5, 0.0, 1.1))
    np.testing.assert_allclose(np.argwhere(yellow)[:, ::-1].mean(axis=0), top, atol=0.5)
    u, v = np.rint(top).astype(int)
    assert image_to_array(depth_message)[v, u] == pytest.approx(2.75 - 1.1, abs=1e-3)
    assert np.sqrt(yellow.sum()) / camera.fx * (2.75 - 1.1) == pytest.approx(0.1, abs=0.002), "side of the cube"
