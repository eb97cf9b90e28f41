import asyncio
import threading

import numpy as np
import pytest

from common import topics
from common.clock import Clock
from common.config import Run, Surroundings, load_cell
from common.messages import Header, Pose, Vector3, WorldObject, WorldObjects
from common.perception.image import array_to_image, image_to_array
from common.perception.pinhole import Pinhole
from common.process.in_process import running_service
from common.sim.rendering import Renderer, draw
from common.supervision.wiring import wiring
from common.transport.local import LocalNetwork
from services.camera_simulator import Config, run
from tests.common.sim.spheres import spheres

around = Surroundings()
config = Config(world=around, robot=load_cell("panda").robot, run=Run(cell="test", seed=4))


def balls(*places, states=()):
    return spheres(places, states=states)


async def next_of(reader):
    return await asyncio.wait_for(reader.next(), 10)


def red_at(image, x, y):
    u, v = round(320 - y * 520 / 0.77), round(240 - (x - 0.40) * 520 / 0.77)
    return image_to_array(image)[v, u].tolist() == [26, 38, 255]


async def test_world_state_gives_images_and_camera_info():
    net = LocalNetwork()
    tester = net.bus()
    images, infos = tester.reader(topics.CAMERA_IMAGE), tester.reader(topics.CAMERA_INFO)
    truth = tester.writer(topics.SCENE_OBJECTS)
    async with running_service(net, run, config, name="camera_simulator"):
        truth.put(balls((0.5, -0.2, 0.03)))
        image, info = await next_of(images), await next_of(infos)
        assert (image.width, image.height, image.encoding) == (640, 480, "bgr8")
        assert image.header.frame_id == info.header.frame_id == "camera_optical_frame"
        assert info.k == [520, 0, 320, 0, 520, 240, 0, 0, 1] and (info.width, info.height) == (640, 480)
        assert red_at(image, 0.5, -0.2)


async def test_no_image_before_the_first_world_state():
    net = LocalNetwork()
    tester = net.bus()
    images, infos = tester.reader(topics.CAMERA_IMAGE), tester.reader(topics.CAMERA_INFO)
    truth = tester.writer(topics.SCENE_OBJECTS)
    async with running_service(net, run, config.model_copy(update={"rate": 200.0, "max_rate": 200.0})):
        await asyncio.sleep(0.1)
        assert images.latest is None and infos.latest is None
        truth.put(balls())
        await next_of(images)


async def test_images_follow_the_world_and_omit_invisible_objects():
    net = LocalNetwork()
    tester = net.bus()
    images, truth = tester.reader(topics.CAMERA_IMAGE), tester.writer(topics.SCENE_OBJECTS)
    async with running_service(net, run, config):
        truth.put(balls((0.5, -0.2, 0.03), (0.6, 0.0, 0.03)))
        while not red_at(await next_of(images), 0.6, 0.0):
            pass
        truth.put(balls((0.5, -0.2, 0.03), (0.6, 0.0, 0.03), states=("held", "table")))
        while red_at(image := await next_of(images), 0.5, -0.2):
            pass
        assert red_at(image, 0.6, 0.0)


@pytest.mark.parametrize(("state", "shown"), [
    ("table", True), ("held", False), ("falling", True), ("contained", True), ("elsewhere", False)])
def test_held_and_elsewhere_objects_are_not_rendered(state, shown):
    picture = draw(spheres([(0.5, -0.2, 0.03)], states=[state]).objects, Pinhole.from_config(around.camera), around)
    assert red_at(array_to_image(picture, "bgr8", Header()), 0.5, -0.2) == shown


async def test_stamps_follow_the_rate_in_cell_time():
    net = LocalNetwork()
    clock = Clock(speed=5.0)
    tester = net.bus(clock=clock)
    images, truth = tester.reader(topics.CAMERA_IMAGE), tester.writer(topics.SCENE_OBJECTS)
    async with running_service(net, run, config, clock=clock):
        truth.put(balls())
        stamps = [(await next_of(images)).header.stamp for _ in range(8)]
        assert stamps == sorted(set(stamps)) and stamps[-1] <= clock.now_ns()
        # 0.1 s apart in cell time, or whole multiples when frames were missed: a fixed grid, give or take the jitter.
        assert np.median(np.diff(stamps)) > 0.05e9


async def test_noise_depends_on_the_seed_of_the_run():
    async def first(seed):
        net = LocalNetwork()
        tester = net.bus()
        images, truth = tester.reader(topics.CAMERA_IMAGE), tester.writer(topics.SCENE_OBJECTS)
        truth.put(balls())
        noisy = Config(world=Surroundings(), robot=config.robot, run=Run(cell="test", seed=seed), noise_std=8,
                       brightness=-20)
        async with running_service(net, run, noisy):
            return image_to_array(await next_of(images))

    one, again, other = await first(1), await first(1), await first(2)
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()
    assert one[300:, 300:].mean() == pytest.approx(128 - 20 - 1, abs=1)


async def test_camera_reads_only_the_ground_truth():
    found = await wiring(run, config)
    assert found.reads == {topics.SCENE_OBJECTS}
    assert found.writes == {topics.CAMERA_IMAGE, topics.CAMERA_INFO}
    assert not found.serves and not found.calls


async def test_slow_rendering_does_not_block_the_event_loop(monkeypatch):
    net, loop = LocalNetwork(), asyncio.get_running_loop()
    tester = net.bus()
    images, truth = tester.reader(topics.CAMERA_IMAGE), tester.writer(topics.SCENE_OBJECTS)
    entered, go_on, render = asyncio.Event(), threading.Event(), Renderer.render

    def slow(renderer, objects, *rest):
        if any(thing.shape == "box" for thing in objects):
            loop.call_soon_threadsafe(entered.set)
            assert go_on.wait(10)
        return render(renderer, objects, *rest)

    monkeypatch.setattr(Renderer, "render", slow)
    async with running_service(net, run, config):
        truth.put(balls((0.5, -0.2, 0.03)))
        before = await next_of(images)
        there = Pose(position=Vector3(x=0.5))
        box = WorldObject(id="box", shape="box", size=Vector3(x=0.05, y=0.05, z=0.05), pose=there)
        truth.put(WorldObjects(objects=[box]))
        await asyncio.wait_for(entered.wait(), 10)  # on the loop on which the camera runs
        go_on.set()
        while (await next_of(images)).data == before.data:
            pass
