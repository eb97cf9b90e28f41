"""Repeated work for each service."""

from __future__ import annotations

import asyncio
import importlib
import itertools
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from applications.outlining.contours import ContourOptions, find_contours
from applications.outlining.topics import (
    CONTOUR_PATH,
    CONTOUR_POINTS,
    CONTOURS,
    OUTLINE_STATUS,
    Contours,
    OutlinePoints,
)
from applications.pick_place.topics import DETECTED_OBJECTS, VALIDATED_TARGETS
from common import messages as m
from common import topics
from common.clock import Clock
from common.config import Parameters, load_cell, service_config
from common.config.tunables import tunable_sections
from common.perception.image import array_to_image, image_to_array
from common.perception.pinhole import Pinhole
from common.process.in_process import running_service
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose
from common.sim.objects import world_object
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from tests.common.sim.spheres import draw_spheres

PANDA, UR5 = load_cell("panda"), load_cell("ur5")
CELLS = {"panda": PANDA, "ur5": UR5}
CAMERA, DEPTH_CAMERA = Pinhole.from_config(PANDA.world.camera), Pinhole.from_config(UR5.world.camera)
HOME = PANDA.robot.named_poses["home"]
BALLS = [(0.40, -0.30, 0.03), (0.52, -0.30, 0.03), (0.56, -0.25, 0.03)]
PATIENCE = 20.0  # [s]
Scenario = Callable[[Bus], AsyncIterator[Any]]


def config_of(service: str) -> Parameters:
    """The configuration in the first cell that has the service; its own copy of everything."""
    module = importlib.import_module(f"services.{service}")
    cell = next((c for c in CELLS.values() if service in c.services), PANDA)
    return service_config(cell, service, module.Config)


async def tune(bus: Bus, service: str, values: dict[str, Any]) -> list[m.Parameter]:
    """Change parameters as an operator does; paths without `services.<name>.` are its own."""
    sections = tunable_sections(importlib.import_module(f"services.{service}").Config)
    full = {path if path.split(".")[0] in sections else f"services.{service}.{path}": v for path, v in values.items()}
    client = bus.client(topics.parameters_of(service))
    return (await client.call(m.ParameterRequest(set=full, by="a test"), PATIENCE)).parameters


async def later(bus: Bus, reader: Any) -> Any:
    """The first message that was stamped after now."""
    now = bus.clock.now_ns()
    return await receive(reader, lambda message: message.header.stamp > now)


async def receive(reader: Any, wanted: Callable[[Any], bool] = lambda _: True) -> Any:
    async with asyncio.timeout(PATIENCE):
        while not wanted(message := await reader.next()):
            pass
        return message


# --- what each service is given to do, over and over: each turn yields what came of it ----------------------------


def calibrate(bus: Bus, camera: Pinhole, frame: str) -> None:
    bus.writer(topics.TF_STATIC).put(m.TFMessage(transforms=[m.TransformStamped(
        header=bus.header("world"), child_frame_id=frame, transform=matrix_to_pose(camera.T_world_optical))]))
    info = topics.CAMERA_INFO if camera is CAMERA else topics.DEPTH_CAMERA_INFO
    bus.writer(info).put(camera.info(bus.header(frame)))


async def simulate_camera(bus: Bus) -> AsyncIterator[m.Image]:
    images = bus.reader(topics.CAMERA_IMAGE)
    bus.writer(topics.SCENE_OBJECTS).put(m.WorldObjects())
    while True:
        yield await later(bus, images)


async def detect(bus: Bus) -> AsyncIterator[list[m.Marker]]:
    frame = PANDA.world.camera.frame
    images, found = bus.writer(topics.CAMERA_IMAGE), bus.reader(DETECTED_OBJECTS)
    calibrate(bus, CAMERA, frame)
    pictures = [draw_spheres(balls, CAMERA, PANDA.world) for balls in (BALLS, BALLS[:2])]
    for turn in itertools.count():
        picture = pictures[turn // 2 % 2]  # the same twice: it would not be looked at again without a change
        images.put(array_to_image(picture, "bgr8", bus.header(frame)))
        yield (await receive(found)).markers


async def validate(bus: Bus) -> AsyncIterator[m.PoseArray]:
    detected, targets = bus.writer(DETECTED_OBJECTS), bus.reader(VALIDATED_TARGETS)
    calibrate(bus, CAMERA, PANDA.world.camera.frame)
    turn = 0
    while True:
        place = (0.50 + 0.01 * turn, -0.20, 0.03)  # elsewhere: inverse kinematics is asked
        turn += 1
        frame = markers(bus, place)
        detected.put(frame)
        yield await receive(targets, lambda t, stamp=frame.header.stamp: t.header.stamp == stamp and len(t.poses) == 1)


def markers(bus: Bus, *places: tuple[float, float, float]) -> m.MarkerArray:
    made = []
    for number, place in enumerate(places):
        u, v = CAMERA.project(place)
        made.append(m.Marker(ns="ball", id=number, type="sphere", scale=m.Vector3(x=0.06, y=0.06, z=0.06), pixel=(u, v),
                             pose=m.Pose(position=m.Vector3(x=place[0], y=place[1], z=place[2]))))
    return m.MarkerArray(header=bus.header("world"), markers=made)


async def keep_scene(bus: Bus) -> AsyncIterator[list[m.CollisionObject]]:
    detected, scenes = bus.writer(DETECTED_OBJECTS), bus.reader(topics.PLANNING_SCENE)
    calibrate(bus, CAMERA, PANDA.world.camera.frame)
    while True:
        frame = markers(bus, (0.40, 0.0, 0.03))
        detected.put(frame)
        scene = await receive(scenes, lambda s, stamp=frame.header.stamp: s.header.stamp == stamp)
        yield [o for o in scene.objects if o.role == "target"]


async def publish_state(bus: Bus) -> AsyncIterator[m.TFMessage]:
    joints, tf = bus.writer(topics.JOINT_STATES), bus.reader(topics.TF)
    stamp = bus.clock.now_ns()
    while True:
        stamp += 10**9
        joints.put(m.JointState(header=m.Header(stamp=stamp), name=PANDA.robot.joints, position=HOME))
        yield await receive(tf, lambda t, stamp=stamp: t.transforms[0].header.stamp == stamp)


async def pick_and_place(bus: Bus) -> AsyncIterator[m.PlanRequest]:
    asked: asyncio.Queue[m.PlanRequest] = asyncio.Queue()

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        asked.put_nowait(request)
        return m.PlanResponse(id=request.id, ok=False, error="no_ik", message="not today")

    bus.serve(topics.MOTION_PLAN, plan)
    gripper, motion = bus.writer(topics.GRIPPER_STATE), bus.writer(topics.MOTION_STATUS)
    joints, scene = bus.writer(topics.JOINT_STATES), bus.writer(topics.PLANNING_SCENE)
    targets = bus.writer(VALIDATED_TARGETS)
    turn = 0
    while True:
        x, y = 0.40 + 0.08 * (turn % 3), -0.17  # another place, for this one is given up in the end
        turn += 1
        header = bus.header("world")
        ball = m.CollisionObject(id=f"track_{turn}", role="target", shape="sphere", dimensions=[0.03],
                                 pose=m.Pose(position=m.Vector3(x=x, y=y, z=0.03)))
        gripper.put(m.GripperState(header=header, width=0.08))
        motion.put(m.MotionStatus(header=header))
        joints.put(m.JointState(header=header, name=PANDA.robot.joints, position=HOME))
        scene.put(m.PlanningScene(header=header, objects=[ball]))
        targets.put(m.PoseArray(header=header, poses=[ball.pose]))
        async with asyncio.timeout(PATIENCE):
            while not isinstance((request := await asked.get()).goal, m.PoseGoal) or (
                abs(request.goal.pose.position.x - x) > 1e-6
            ):
                pass
        yield request


async def plan_motion(bus: Bus) -> AsyncIterator[m.PlanResponse]:
    robot = RobotModel.load(PANDA.robot)
    below = robot.fk(robot.named("home"))
    below[2, 3] -= 0.10
    bus.writer(topics.PLANNING_SCENE).put(m.PlanningScene(header=bus.header("world")))
    plan = bus.client(topics.MOTION_PLAN)
    goal = m.PoseGoal(pose=matrix_to_pose(below))
    while True:
        answer = await plan.call(m.PlanRequest(id="1", start=HOME, goal=goal, straight=True), PATIENCE)
        assert answer.ok, answer.message
        yield answer


async def execute(bus: Bus) -> AsyncIterator[m.MotionStatus]:
    """A quintic in time for one joint, there and back."""
    call, status = bus.client(topics.MOTION_EXECUTE), bus.reader(topics.MOTION_STATUS)
    turn, seconds, distance = 0, 0.5, 0.05
    while True:
        points = []
        off = 1e-3 * (turn % 2 == 0)  # each starts slightly off the end of the one before
        for u in np.linspace(0.0, 1.0, 26):
            s = u**3 * (10 - 15 * u + 6 * u * u)
            ds, dds = 30 * u**2 * (1 - u) ** 2 / seconds, 60 * u * (1 - u) * (1 - 2 * u) / seconds**2
            sign, begin = (1, 0.0) if turn % 2 == 0 else (-1, distance)
            points.append(m.JointTrajectoryPoint(
                time_from_start=u * seconds, positions=[HOME[0] + off + begin + sign * distance * s, *HOME[1:]],
                velocities=[sign * distance * ds, *[0.0] * 6], accelerations=[sign * distance * dds, *[0.0] * 6]))
        trajectory = m.JointTrajectory(joint_names=PANDA.robot.joints, points=points)
        turn += 1
        request = m.ExecuteRequest(header=bus.header(), id=f"goal-{turn}", trajectory=trajectory)
        answer = await call.call(request, PATIENCE)
        if answer.state == "active":
            answer = await receive(status, lambda s, turn=turn: s.id == f"goal-{turn}" and s.state != "active")
        yield answer


async def see_depth(bus: Bus) -> AsyncIterator[np.ndarray]:
    depths = bus.reader(topics.DEPTH_CAMERA_DEPTH)
    bus.writer(topics.JOINT_STATES).put(m.JointState(
        header=bus.header(), name=UR5.robot.joints, position=UR5.robot.named_poses["home"]))
    bus.writer(topics.SCENE_OBJECTS).put(m.WorldObjects(objects=[world_object(o) for o in UR5.world.objects]))
    while True:
        yield image_to_array(await later(bus, depths))


def square() -> np.ndarray:
    """A yellow square, to be seen by the depth camera."""
    picture = np.zeros((DEPTH_CAMERA.height, DEPTH_CAMERA.width, 3), np.uint8)
    picture[300:400, 400:500] = (0, 200, 200)
    return picture


async def contour(bus: Bus) -> AsyncIterator[Contours]:
    images, contours = bus.writer(topics.DEPTH_CAMERA_IMAGE), bus.reader(CONTOURS)
    while True:
        header = bus.header(UR5.world.camera.frame)
        images.put(array_to_image(square(), "bgr8", header))
        yield await receive(contours, lambda c, stamp=header.stamp: c.header.stamp == stamp)


async def to_world(bus: Bus) -> AsyncIterator[OutlinePoints]:
    frame = UR5.world.camera.frame
    calibrate(bus, DEPTH_CAMERA, frame)
    depths, contours = bus.writer(topics.DEPTH_CAMERA_DEPTH), bus.writer(CONTOURS)
    points = bus.reader(CONTOUR_POINTS)
    depth = np.full((DEPTH_CAMERA.height, DEPTH_CAMERA.width), 1.75, np.float32)
    depth[300:400, 400:500] = 1.65
    found = find_contours(square(), ContourOptions())
    while True:
        header = bus.header(frame)
        depths.put(array_to_image(depth, "32FC1", header))
        contours.put(Contours(header=header, width=DEPTH_CAMERA.width, height=DEPTH_CAMERA.height, contours=found,
                                selected=0))
        yield await receive(points, lambda p, stamp=header.stamp: p.header.stamp == stamp)


async def clear(bus: Bus) -> AsyncIterator[OutlinePoints]:
    outlines, paths = bus.writer(CONTOUR_POINTS), bus.reader(CONTOUR_PATH)
    round_ = [m.Pose(position=m.Vector3(x=0.5 + 0.05 * np.cos(a), y=0.05 * np.sin(a), z=1.1))
              for a in np.linspace(0, 2 * np.pi, 90, endpoint=False)]
    while True:
        header = bus.header("world")
        outlines.put(OutlinePoints(header=header, poses=round_, object="Object_0"))
        yield await receive(paths, lambda p, stamp=header.stamp: p.header.stamp == stamp)


async def trace(bus: Bus) -> AsyncIterator[m.PlanRequest]:
    asked: asyncio.Queue[m.PlanRequest] = asyncio.Queue()

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        asked.put_nowait(request)
        done = request.stage != "trace"
        point = m.JointTrajectoryPoint(time_from_start=0.0, positions=[0.0] * 6, velocities=[0.0] * 6,
                                       accelerations=[0.0] * 6)
        trajectory = m.JointTrajectory(joint_names=UR5.robot.joints, points=[point])
        return m.PlanResponse(id=request.id, ok=done, trajectory=trajectory if done else None, fraction=1.0,
                              error="" if done else "no_ik", message="" if done else "not today")

    bus.serve(topics.MOTION_PLAN, plan)
    command, status = bus.client(topics.TASK_COMMAND), bus.reader(OUTLINE_STATUS)
    writers = {topic.key: bus.writer(topic) for topic in (
        topics.GRIPPER_STATE, topics.MOTION_STATUS, topics.JOINT_STATES, topics.PLANNING_SCENE, CONTOUR_PATH)}
    corners = [(0.45, -0.05), (0.55, -0.05), (0.55, 0.05), (0.45, 0.05)]
    cube = m.CollisionObject(
        id="Object_3", role="target", shape="prism", dimensions=[0.1], outline=[(x - 0.5, y) for x, y in corners],
        pose=m.Pose(position=m.Vector3(x=0.5, z=1.05)))
    poses = [m.Pose(position=m.Vector3(x=x, y=y, z=1.1)) for x, y in corners]
    home = UR5.robot.named_poses["home"]
    while True:
        header = bus.header("world")
        writers["gripper/state"].put(m.GripperState(header=header, width=0.0))
        writers["motion/status"].put(m.MotionStatus(header=header))
        writers["joint_states"].put(m.JointState(header=header, name=UR5.robot.joints, position=home))
        writers["planning_scene"].put(m.PlanningScene(header=header, objects=[cube]))
        writers["contour_path"].put(OutlinePoints(header=header, poses=poses, object="Object_3"))
        async with asyncio.timeout(PATIENCE):
            while (request := await asked.get()).stage != "trace":
                pass
        yield request
        await receive(status, lambda s: s.state == "ERROR")
        await command.call(m.TaskCommand(command="start"), PATIENCE)


async def film(bus: Bus) -> AsyncIterator[m.Image]:
    images = bus.reader(topics.CAMERA_IMAGE)
    while True:
        yield await later(bus, images)


SCENARIOS: dict[str, Scenario] = {
    "camera_simulator": simulate_camera, "camera_opencv": film, "vision_detector": detect,
    "workspace_validator": validate, "scene_manager": keep_scene, "smart_pick_place": pick_and_place,
    "motion_planner": plan_motion, "trajectory_executor": execute, "robot_state_publisher": publish_state,
    "depth_camera": see_depth, "contour_detector": contour, "pixel_to_world": to_world, "duplicate_remover": clear,
    "contour_tracer": trace,
}


def prepared(service: str, folder: Path) -> Parameters:
    """The configuration of a service that is made to do something."""
    config = config_of(service)
    quick = {"camera_simulator": {"rate": 50.0}, "depth_camera": {"rate": 30.0, "max_rate": 30.0}}
    if service == "camera_opencv":
        width, height = PANDA.world.camera.width, PANDA.world.camera.height
        assert cv2.imwrite(str(folder / "1.png"), np.zeros((height, width, 3), np.uint8))
        return config.model_copy(update={"source": str(folder), "rate": 50.0})
    return config.model_copy(update=quick.get(service, {}))


class Running:
    """A service at work: each `turn` gives it the same to do and returns what came of it."""

    def __init__(self, service: str, folder: Path, *, speed: float = 1.0) -> None:
        self.service, self.config = service, prepared(service, folder)
        self.module = importlib.import_module(f"services.{service}")
        self.net, self.clock = LocalNetwork(), Clock(speed)

    async def __aenter__(self) -> Running:
        self.bus = self.net.bus("tester", cell="test", clock=self.clock)
        self._life = running_service(self.net, self.module.run, self.config, name=self.service, clock=self.clock)
        await self._life.__aenter__()
        self._turns = SCENARIOS[self.service](self.bus)
        await self.bus.ready()
        return self

    async def __aexit__(self, *error: object) -> None:
        await self._turns.aclose()
        await self._life.__aexit__(*error)

    async def turn(self) -> Any:
        async with asyncio.timeout(PATIENCE):
            return await anext(self._turns)

    async def tune(self, **values: Any) -> None:
        await tune(self.bus, self.service, values)
