from __future__ import annotations

import asyncio
from collections.abc import Callable

from applications.pick_place.topics import DETECTED_OBJECTS
from common import messages as m
from common import topics
from common.clock import Clock
from common.config import load_cell, service_config
from common.perception.pinhole import Pinhole
from common.process.in_process import running_service
from common.robot.transforms import matrix_to_pose
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from services import scene_manager

CELL = load_cell("panda")
CAMERA = Pinhole.from_config(CELL.world.camera)


def frame(bus_stamp: int, *balls: tuple[float, float]) -> m.MarkerArray:
    markers = []
    for number, (x, y) in enumerate(balls):
        u, v = CAMERA.project([x, y, 0.03])
        markers.append(m.Marker(ns="ball", id=number, type="sphere", scale=m.Vector3(x=0.06, y=0.06, z=0.06),
                                pixel=(u, v), pose=m.Pose(position=m.Vector3(x=x, y=y, z=0.03))))
    return m.MarkerArray(header=m.Header(stamp=bus_stamp, frame_id="world"), markers=markers)


def network_with_camera() -> tuple[LocalNetwork, Bus]:
    net = LocalNetwork()
    bus = net.bus("tester", cell="test", clock=Clock())
    bus.writer(topics.CAMERA_INFO).put(CAMERA.info(bus.header("camera_optical_frame")))
    bus.writer(topics.TF_STATIC).put(m.TFMessage(transforms=[m.TransformStamped(
        header=bus.header("world"), child_frame_id="camera_optical_frame",
        transform=matrix_to_pose(CAMERA.T_world_optical))]))
    return net, bus


async def film(expose: Callable[[], None]) -> None:
    """Publish frames repeatedly as a camera does: the first may arrive before the camera is known."""
    while True:
        expose()
        await asyncio.sleep(0.02)


async def test_detected_ball_becomes_an_object_and_is_attached_when_grasped() -> None:
    net, bus = network_with_camera()
    detected, scene = bus.writer(DETECTED_OBJECTS), bus.reader(topics.PLANNING_SCENE)
    home = CELL.robot.named_poses["home"]
    joints = bus.writer(topics.JOINT_STATES)
    grip = bus.writer(topics.GRIPPER_STATE)
    grip.put(m.GripperState(header=bus.header(), width=0.08))
    config = service_config(CELL, "scene_manager", scene_manager.Config)
    async with running_service(net, scene_manager.run, config, name="scene_manager"):
        first = await scene.next()
        assert {o.role for o in first.objects} == {"fixture", "container"}
        ball = (0.307, 0.0)  # below the gripper at home, outside the match radius

        def expose() -> None:
            joints.put(m.JointState(header=bus.header(), name=CELL.robot.joints, position=home))
            detected.put(frame(bus.clock.now_ns(), ball))

        async with asyncio.TaskGroup() as group:
            camera = group.create_task(film(expose))
            while not [o for o in (await scene.next()).objects if o.role == "target"]:
                pass
            grip.put(m.GripperState(header=bus.header(), width=0.06, holding=True))
            held = await scene.next()
            while not held.attached:
                held = await scene.next()
            camera.cancel()
        assert held.attached[0].link == "panda_hand_tcp"
        assert ("panda_hand", held.attached[0].object.id) in held.allowed_collisions


async def test_only_at_home_ignores_images_taken_with_the_arm_away() -> None:
    net, bus = network_with_camera()
    detected, scene = bus.writer(DETECTED_OBJECTS), bus.reader(topics.PLANNING_SCENE)
    joints, home = bus.writer(topics.JOINT_STATES), CELL.robot.named_poses["home"]
    config = service_config(CELL, "scene_manager", scene_manager.Config)
    config = config.model_copy(update={"only_at_home": True, "confirm_frames": 1})
    stamp = 0

    def expose(q: list[float], ball: tuple[float, float]) -> None:
        nonlocal stamp
        stamp += 10
        joints.put(m.JointState(header=m.Header(stamp=stamp), name=CELL.robot.joints, position=q))
        detected.put(frame(stamp + 5, ball))

    async def seen(q: list[float], ball: tuple[float, float]) -> tuple[float, float]:
        async with asyncio.TaskGroup() as group:
            camera = group.create_task(film(lambda: expose(q, ball)))
            while not (found := [o for o in (await scene.next()).objects if o.role == "target"]):
                pass
            camera.cancel()
        return found[0].pose.position.x, found[0].pose.position.y

    async with running_service(net, scene_manager.run, config, name="scene_manager"):
        assert await seen(home, (0.45, -0.1)) == (0.45, -0.1)
        for _ in range(5):
            expose([0.3, *home[1:]], (0.60, 0.1))  # the arm is away
            await asyncio.sleep(0.02)
        assert scene.latest is not None and scene.latest.header.stamp < stamp - 30
        places = {(o.pose.position.x, o.pose.position.y) for o in scene.latest.objects if o.role == "target"}
        assert places == {(0.45, -0.1)}
