"""Camera, detector and validator together: from ground truth to targets through images only."""

import asyncio
from contextlib import AsyncExitStack

import numpy as np

from applications.pick_place.topics import REJECTED_TARGETS, VALIDATED_TARGETS
from common import topics
from common.clock import Clock
from common.config import Run, Surroundings, load_cell, service_config
from common.messages import Header, TFMessage, TransformStamped
from common.perception.pinhole import Pinhole
from common.process.in_process import running_service
from common.robot.transforms import matrix_to_pose
from common.transport.local import LocalNetwork
from services import camera_simulator, vision_detector, workspace_validator
from tests.common.sim.spheres import spheres

cell = load_cell("panda")
around = cell.section(Surroundings)
camera = Pinhole.from_config(around.camera)


def truth(places, states=()):
    return spheres([(p[0], p[1], p[2] if len(p) > 2 else 0.03) for p in places], around, states)


def tf():
    T = matrix_to_pose(camera.T_world_optical)
    stamped = TransformStamped(header=Header(frame_id="world"), child_frame_id=around.camera.frame, transform=T)
    return TFMessage(transforms=[stamped])


async def start(stack, net, clock, **camera_parameters):
    config = camera_simulator.Config(world=around, robot=cell.robot, run=Run(cell="test"), **camera_parameters)
    camera = running_service(net, camera_simulator.run, config, name="camera_simulator", clock=clock)
    await stack.enter_async_context(camera)
    for module in (vision_detector, workspace_validator):
        name = module.__name__.rpartition(".")[2]
        service = running_service(net, module.run, service_config(cell, name, module.Config), name=name, clock=clock)
        await stack.enter_async_context(service)


async def targets_like(reader, places):
    """Wait until exactly these places are offered, each within 3 mm."""
    wanted = np.array([p[:2] for p in places]).reshape(-1, 2)
    while True:
        message = await asyncio.wait_for(reader.next(), 20)
        found = np.array([(p.position.x, p.position.y) for p in message.poses]).reshape(-1, 2)
        if len(found) == len(wanted) and all(np.linalg.norm(found - w, axis=1).min() < 0.003 for w in wanted):
            return message


async def test_targets_follow_the_objects_on_the_table():
    net, clock = LocalNetwork(), Clock()
    bus = net.bus(clock=clock)
    world, statics = bus.writer(topics.SCENE_OBJECTS), bus.writer(topics.TF_STATIC)
    offered, rejected = bus.reader(VALIDATED_TARGETS), bus.reader(REJECTED_TARGETS)
    statics.put(tf())
    places = list(cell.world.spots[:7])
    async with AsyncExitStack() as stack:
        await start(stack, net, clock, rate=50.0)
        world.put(truth(places))
        message = await targets_like(offered, places)
        assert 0 < message.header.stamp <= clock.now_ns()
        world.put(truth(places, ["held", *["table"] * 6]))
        await targets_like(offered, places[1:])
        c = around.container
        world.put(truth([(c.x - 0.033, c.y - 0.033, 0.035), *places[1:]], ["contained", *["table"] * 6]))
        await targets_like(offered, places[1:])
        assert rejected.received == 0
        world.put(truth([(0.2, 0.0), (0.46, 0.0), (0.52, 0.0), (0.49, 0.052)]))
        await targets_like(offered, [(0.46, 0.0), (0.52, 0.0), (0.49, 0.052)])
        rejections = await asyncio.wait_for(rejected.next(), 20)
        assert rejections.rejected[0].reason.startswith("pre-grasp at (0.200, 0.000, 0.130)")


async def test_noise_and_dimming_change_nothing():
    net, clock = LocalNetwork(), Clock()
    bus = net.bus(clock=clock)
    world, statics = bus.writer(topics.SCENE_OBJECTS), bus.writer(topics.TF_STATIC)
    offered = bus.reader(VALIDATED_TARGETS)
    statics.put(tf())
    places = [(0.40, -0.30), (0.46, -0.30), (0.64, -0.25), (0.40, -0.17)]
    async with AsyncExitStack() as stack:
        await start(stack, net, clock, noise_std=8.0, brightness=-20.0)
        world.put(truth(places))
        await targets_like(offered, places)
