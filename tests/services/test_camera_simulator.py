import asyncio
import threading

import numpy as np
import pytest

from common import topics
from common.clock import Clock
from common.config import Run, Surroundings, load_cell
from common.messages import Header, Vector3, WorldObject, WorldObjects
from common.perception.image import array_to_image, image_to_array
from common.perception.pinhole import Pinhole
from common.sim.rendering import Renderer, draw
from services import camera_simulator
from tests.common.sim.spheres import spheres
from tests.services.fake_cell import FakeCell, at, until

AROUND = Surroundings()
CONFIG = camera_simulator.Config(world=AROUND, robot=load_cell("panda").robot, run=Run(cell="test", seed=4))


def red_at(image, x, y):
    u, v = round(320 - y * 520 / 0.77), round(240 - (x - 0.40) * 520 / 0.77)
    return image_to_array(image)[v, u].tolist() == [26, 38, 255]


class Cell(FakeCell):
    def __init__(self, clock=None):
        super().__init__(clock)
        self.images, self.infos = self.reader(topics.CAMERA_IMAGE), self.reader(topics.CAMERA_INFO)

    def place(self, *places, states=()):
        self.put(topics.SCENE_OBJECTS, spheres(places, states=states))

    def camera(self, **changes):
        return self.running(camera_simulator, CONFIG.model_copy(update=changes))


async def test_images_and_camera_info_follow_the_world_and_omit_held_objects():
    cell = Cell()
    async with cell.camera(rate=100.0, max_rate=100.0):
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(cell.images.next(), 0.1)
        assert cell.images.latest is None and cell.infos.latest is None, "no world state yet"
        cell.place((0.5, -0.2, 0.03))
        image, info = await until(cell.images), await until(cell.infos)
        assert (image.width, image.height, image.encoding) == (640, 480, "bgr8")
        assert image.header.frame_id == info.header.frame_id == "camera_optical_frame"
        assert info.k == [520, 0, 320, 0, 520, 240, 0, 0, 1] and (info.width, info.height) == (640, 480)
        assert red_at(image, 0.5, -0.2)
        cell.place((0.5, -0.2, 0.03), (0.6, 0.0, 0.03))
        await until(cell.images, lambda image: red_at(image, 0.6, 0.0))
        cell.place((0.5, -0.2, 0.03), (0.6, 0.0, 0.03), states=("held", "table"))
        assert red_at(await until(cell.images, lambda image: not red_at(image, 0.5, -0.2)), 0.6, 0.0)


@pytest.mark.parametrize(("state", "shown"), [
    ("table", True), ("held", False), ("falling", True), ("contained", True), ("elsewhere", False)])
def test_held_and_elsewhere_objects_are_not_rendered(state, shown):
    pixels = draw(spheres([(0.5, -0.2, 0.03)], states=[state]).objects, Pinhole.from_config(AROUND.camera), AROUND)
    assert red_at(array_to_image(pixels, "bgr8", Header()), 0.5, -0.2) == shown


async def test_stamps_follow_the_rate_in_cell_time():
    cell = Cell(Clock(speed=5.0))
    async with cell.camera():
        cell.place()
        stamps = [(await until(cell.images)).header.stamp for _ in range(6)]
        assert stamps == sorted(set(stamps)) and stamps[-1] <= cell.clock.now_ns()
        # a grid of 0.1 s, less the delay of the first; multiples when frames were missed
        assert stamps[-1] - stamps[0] > 0.4e9


async def test_noise_depends_on_the_seed_of_the_run():
    async def first(seed):
        cell = Cell()
        async with cell.camera(run=Run(cell="test", seed=seed), noise_std=8, brightness=-20):
            cell.place()  # only now, so that the first image is read
            return image_to_array(await until(cell.images))

    one, again, other = await first(1), await first(1), await first(2)
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()
    assert one[300:, 300:].mean() == pytest.approx(128 - 20 - 1, abs=1)


async def test_noise_brightness_and_rate_take_effect_in_a_static_world():
    cell, config = Cell(), CONFIG.model_copy(update={"rate": 50.0})

    async def pixels():
        now = cell.clock.now_ns()
        image = await until(cell.images, lambda image: image.header.stamp > now)
        return np.frombuffer(image.data, np.uint8).astype(int)

    async with cell.running(camera_simulator, config):
        cell.place()
        before = await pixels()
        config.brightness = 20.0
        assert (await pixels() == np.minimum(before + 20, 255)).all()
        config.brightness, config.noise_std = 0.0, 10.0
        assert 5 < np.std(await pixels() - before) < 15
        config.noise_std = 0.0
        assert (await pixels() == before).all()


async def test_slow_rendering_does_not_block_the_event_loop(monkeypatch):
    cell, loop = Cell(), asyncio.get_running_loop()
    entered, resume, render = asyncio.Event(), threading.Event(), Renderer.render

    def slow(renderer, objects, *rest):
        if any(thing.shape == "box" for thing in objects):
            loop.call_soon_threadsafe(entered.set)
            assert resume.wait(10)
        return render(renderer, objects, *rest)

    monkeypatch.setattr(Renderer, "render", slow)
    async with cell.camera():
        cell.place((0.5, -0.2, 0.03))
        before = await until(cell.images)
        box = WorldObject(id="box", shape="box", size=Vector3(x=0.05, y=0.05, z=0.05), pose=at(0.5, 0.0, 0.0))
        cell.put(topics.SCENE_OBJECTS, WorldObjects(objects=[box]))
        await asyncio.wait_for(entered.wait(), 10)  # this loop runs while the renderer waits
        resume.set()
        await until(cell.images, lambda image: image.data != before.data)
