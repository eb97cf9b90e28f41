from __future__ import annotations

import asyncio
from collections.abc import Callable

from applications.pick_place.topics import DETECTED_OBJECTS
from common import messages as m
from common import topics
from common.config import load_cell, service_config
from common.perception.pinhole import Pinhole
from services import scene_manager
from tests.harness import running_with
from tests.services.fake_cell import FakeCell, at, until

CELL = load_cell("panda")
HOME = CELL.robot.named_poses["home"]
CAMERA = Pinhole.from_config(CELL.world.camera)
CONFIG = service_config(CELL, "scene_manager", scene_manager.Config)


class Cell(FakeCell):
    def __init__(self) -> None:
        super().__init__()
        self.calibrate(CAMERA, "camera_optical_frame")
        self.scenes = self.reader(topics.PLANNING_SCENE)

    def expose(self, stamp: int, q: list[float], x: float, y: float) -> None:
        """Publish joint positions and an image taken 5 ns later that shows one ball."""
        self.put_joints(CELL.robot.joints, q, stamp)
        ball = m.Marker(ns="ball", id=0, type="sphere", scale=m.Vector3(x=0.06, y=0.06, z=0.06),
                        pixel=CAMERA.project([x, y, 0.03]), pose=at(x, y, 0.03))
        self.put(DETECTED_OBJECTS, m.MarkerArray(header=m.Header(stamp=stamp + 5, frame_id="world"), markers=[ball]))


async def film(expose: Callable[[], None]) -> None:
    """Publish images repeatedly: the service may ignore the first."""
    while True:
        expose()
        await asyncio.sleep(0.02)


def targets(scene: m.PlanningScene) -> list[tuple[float, float]]:
    return [(o.pose.position.x, o.pose.position.y) for o in scene.objects if o.role == "target"]


async def test_detected_ball_becomes_an_object_and_is_attached_when_grasped() -> None:
    cell = Cell()
    cell.put(topics.GRIPPER_STATE, m.GripperState(header=cell.bus.header(), width=0.08))
    below_gripper = (0.307, 0.0)  # outside the match radius
    async with cell.running(scene_manager, CONFIG):
        assert {o.role for o in (await until(cell.scenes)).objects} == {"fixture", "container"}
        async with running_with(film(lambda: cell.expose(cell.clock.now_ns(), HOME, *below_gripper))):
            await until(cell.scenes, targets)
            cell.put(topics.GRIPPER_STATE, m.GripperState(header=cell.bus.header(), width=0.06, holding=True))
            held = await until(cell.scenes, lambda scene: scene.attached)
        assert held.attached[0].link == "panda_hand_tcp"
        assert ("panda_hand", held.attached[0].object.id) in held.allowed_collisions


async def test_only_at_home_ignores_images_taken_with_the_arm_away() -> None:
    cell, stamp = Cell(), 0

    def expose(q: list[float], x: float, y: float) -> None:
        nonlocal stamp
        stamp += 10
        cell.expose(stamp, q, x, y)

    config = CONFIG.model_copy(update={"only_at_home": True, "confirm_frames": 1})
    async with cell.running(scene_manager, config):
        async with running_with(film(lambda: expose(HOME, 0.45, -0.1))):
            assert targets(await until(cell.scenes, targets)) == [(0.45, -0.1)]
        away = stamp
        for _ in range(5):
            expose([0.3, *HOME[1:]], 0.60, 0.1)
            await asyncio.sleep(0)
        async with running_with(film(lambda: expose(HOME, 0.45, -0.1))):
            scene = await until(cell.scenes, lambda scene: scene.header.stamp > away + 5)
        assert scene.header.stamp > away + 55 and targets(scene) == [(0.45, -0.1)]
