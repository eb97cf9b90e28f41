"""Repeatable input for each service: each turn gives a service something to do and yields its result."""

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
from common.perception.image import image_to_array
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose
from common.sim.objects import world_object
from tests.common.sim.spheres import draw_spheres
from tests.services.executor_rig import HOME, to_home_plus
from tests.services.fake_cell import PATIENCE, FakeCell, at, ball, trajectory, until

PANDA, UR5 = load_cell("panda"), load_cell("ur5")
CELLS = {"panda": PANDA, "ur5": UR5}
CAMERA, DEPTH_CAMERA = Pinhole.from_config(PANDA.world.camera), Pinhole.from_config(UR5.world.camera)
FRAME, DEPTH_FRAME = PANDA.world.camera.frame, UR5.world.camera.frame
BALLS = [(0.40, -0.30, 0.03), (0.52, -0.30, 0.03), (0.56, -0.25, 0.03)]
CORNERS = [(0.45, -0.05), (0.55, -0.05), (0.55, 0.05), (0.45, 0.05)]
SQUARE = np.zeros((DEPTH_CAMERA.height, DEPTH_CAMERA.width, 3), np.uint8)  # a yellow one below the depth camera
SQUARE[300:400, 400:500] = (0, 200, 200)
Turns = Callable[[FakeCell], AsyncIterator[Any]]


def config_of(service: str) -> Parameters:
    """Return the configuration in the first cell that has the service; its own copy of everything."""
    module = importlib.import_module(f"services.{service}")
    cell = next((c for c in CELLS.values() if service in c.services), PANDA)
    return service_config(cell, service, module.Config)


async def later(cell: FakeCell, reader: Any) -> Any:
    """Return the first message that was stamped after now."""
    now = cell.clock.now_ns()
    return await until(reader, lambda message: message.header.stamp > now)


async def answer(reader: Any, header: m.Header) -> Any:
    """Return the message with the stamp of a header."""
    return await until(reader, lambda message: message.header.stamp == header.stamp)


def detections(cell: FakeCell, x: float, y: float) -> m.MarkerArray:
    marker = m.Marker(ns="ball", id=0, type="sphere", scale=m.Vector3(x=0.06, y=0.06, z=0.06),
                      pixel=CAMERA.project((x, y, 0.03)), pose=at(x, y, 0.03))
    return m.MarkerArray(header=cell.bus.header("world"), markers=[marker])


async def simulate_camera(cell: FakeCell) -> AsyncIterator[m.Image]:
    images = cell.reader(topics.CAMERA_IMAGE)
    cell.put(topics.SCENE_OBJECTS, m.WorldObjects())
    while True:
        yield await later(cell, images)


async def detect(cell: FakeCell) -> AsyncIterator[list[m.Marker]]:
    found = cell.reader(DETECTED_OBJECTS)
    cell.calibrate(CAMERA, FRAME)
    images = [draw_spheres(balls, CAMERA, PANDA.world) for balls in (BALLS, BALLS[:2])]
    for turn in itertools.count():  # each image twice: an unchanged one is processed again only after a change
        cell.put_image(topics.CAMERA_IMAGE, images[turn // 2 % 2], "bgr8", cell.clock.now_ns(), FRAME)
        yield (await until(found)).markers


async def validate(cell: FakeCell) -> AsyncIterator[m.PoseArray]:
    targets = cell.reader(VALIDATED_TARGETS)
    cell.calibrate(CAMERA, FRAME)
    for turn in itertools.count():
        frame = detections(cell, 0.50 + 0.01 * turn, -0.20)  # elsewhere: inverse kinematics is solved
        cell.put(DETECTED_OBJECTS, frame)
        while len((found := await answer(targets, frame.header)).poses) != 1:
            pass
        yield found


async def update_scene(cell: FakeCell) -> AsyncIterator[list[m.CollisionObject]]:
    scenes = cell.reader(topics.PLANNING_SCENE)
    cell.calibrate(CAMERA, FRAME)
    while True:
        frame = detections(cell, 0.40, 0.0)
        cell.put(DETECTED_OBJECTS, frame)
        yield [o for o in (await answer(scenes, frame.header)).objects if o.role == "target"]


async def publish_state(cell: FakeCell) -> AsyncIterator[m.TFMessage]:
    tf, start = cell.reader(topics.TF), cell.clock.now_ns()
    for turn in itertools.count(1):
        stamp = start + turn * 10**9
        cell.put_joints(PANDA.robot.joints, HOME, stamp)
        yield await until(tf, lambda t, stamp=stamp: t.transforms[0].header.stamp == stamp)


async def pick_and_place(cell: FakeCell) -> AsyncIterator[m.PlanRequest]:
    planned = cell.serve_planner()
    for turn in itertools.count(1):
        x = 0.40 + 0.08 * (turn % 3)  # another position, for each is abandoned in the end
        target = ball(f"track_{turn}", x, -0.17)
        header = cell.put_robot(PANDA.robot, target, width=0.08)
        cell.put(VALIDATED_TARGETS, m.PoseArray(header=header, poses=[target.pose]))
        while not isinstance((request := await planned.get()).goal, m.PoseGoal) or (
            abs(request.goal.pose.position.x - x) > 1e-6
        ):
            pass
        yield request


async def plan_motion(cell: FakeCell) -> AsyncIterator[m.PlanResponse]:
    below = RobotModel.load(PANDA.robot).fk(HOME)
    below[2, 3] -= 0.10
    cell.put(topics.PLANNING_SCENE, m.PlanningScene(header=cell.bus.header("world")))
    plan, goal = cell.client(topics.MOTION_PLAN), m.PoseGoal(pose=matrix_to_pose(below))
    while True:
        found = await plan.call(m.PlanRequest(id="1", start=HOME.tolist(), goal=goal, straight=True), PATIENCE)
        assert found.ok, found.message
        yield found


async def execute(cell: FakeCell) -> AsyncIterator[m.MotionStatus]:
    """Move there and back; each motion starts slightly off the end of the one before."""
    call, status = cell.client(topics.MOTION_EXECUTE), cell.reader(topics.MOTION_STATUS)
    for turn in itertools.count():
        way = to_home_plus(0.05, start=1e-3) if turn % 2 == 0 else to_home_plus(1e-3, start=0.051)
        request = m.ExecuteRequest(header=cell.bus.header(), id=f"goal-{turn}", trajectory=way)
        started = await call.call(request, PATIENCE)
        yield started if started.state != "active" else await until(
            status, lambda s, turn=turn: s.id == f"goal-{turn}" and s.state != "active")


async def see_depth(cell: FakeCell) -> AsyncIterator[np.ndarray]:
    depths = cell.reader(topics.DEPTH_CAMERA_DEPTH)
    cell.put_joints(UR5.robot.joints, UR5.robot.named_poses["home"])
    cell.put(topics.SCENE_OBJECTS, m.WorldObjects(objects=[world_object(o) for o in UR5.world.objects]))
    while True:
        yield image_to_array(await later(cell, depths))


async def find_contour(cell: FakeCell) -> AsyncIterator[Contours]:
    contours = cell.reader(CONTOURS)
    while True:
        header = cell.bus.header()
        cell.put_image(topics.DEPTH_CAMERA_IMAGE, SQUARE, "bgr8", header.stamp, DEPTH_FRAME)
        yield await answer(contours, header)


async def to_world(cell: FakeCell) -> AsyncIterator[OutlinePoints]:
    points = cell.reader(CONTOUR_POINTS)
    cell.calibrate(DEPTH_CAMERA, DEPTH_FRAME, topics.DEPTH_CAMERA_INFO)
    depth = np.full((DEPTH_CAMERA.height, DEPTH_CAMERA.width), 1.75, np.float32)
    depth[300:400, 400:500] = 1.65
    found = find_contours(SQUARE, ContourOptions())
    while True:
        header = cell.bus.header(DEPTH_FRAME)
        cell.put_image(topics.DEPTH_CAMERA_DEPTH, depth, "32FC1", header.stamp, DEPTH_FRAME)
        cell.put(CONTOURS, Contours(
            header=header, width=DEPTH_CAMERA.width, height=DEPTH_CAMERA.height, contours=found, selected=0))
        yield await answer(points, header)


async def simplify(cell: FakeCell) -> AsyncIterator[OutlinePoints]:
    paths = cell.reader(CONTOUR_PATH)
    circle = [at(0.5 + 0.05 * np.cos(a), 0.05 * np.sin(a), 1.1)
              for a in np.linspace(0, 2 * np.pi, 90, endpoint=False)]
    while True:
        header = cell.bus.header("world")
        cell.put(CONTOUR_POINTS, OutlinePoints(header=header, poses=circle, object="Object_0"))
        yield await answer(paths, header)


async def trace(cell: FakeCell) -> AsyncIterator[m.PlanRequest]:
    planned = cell.serve_planner(trajectory(UR5.robot.joints, 0.0), unreachable="trace")
    command, status = cell.client(topics.TASK_COMMAND), cell.reader(OUTLINE_STATUS)
    cube = m.CollisionObject(id="Object_3", role="target", shape="prism", dimensions=[0.1],
                             outline=[(x - 0.5, y) for x, y in CORNERS], pose=at(0.5, 0.0, 1.05))
    while True:
        header = cell.put_robot(UR5.robot, cube)
        poses = [at(x, y, 1.1) for x, y in CORNERS]
        cell.put(CONTOUR_PATH, OutlinePoints(header=header, poses=poses, object="Object_3"))
        while (request := await planned.get()).stage != "trace":
            pass
        yield request
        await until(status, lambda s: s.state == "ERROR")
        await command.call(m.TaskCommand(command="start"), PATIENCE)


async def film(cell: FakeCell) -> AsyncIterator[m.Image]:
    images = cell.reader(topics.CAMERA_IMAGE)
    while True:
        yield await later(cell, images)


TURNS: dict[str, Turns] = {
    "camera_simulator": simulate_camera, "camera_opencv": film, "vision_detector": detect,
    "workspace_validator": validate, "scene_manager": update_scene, "smart_pick_place": pick_and_place,
    "motion_planner": plan_motion, "trajectory_executor": execute, "robot_state_publisher": publish_state,
    "depth_camera": see_depth, "contour_detector": find_contour, "pixel_to_world": to_world,
    "duplicate_remover": simplify, "contour_tracer": trace,
}


class Running(FakeCell):
    """A service at work: each `turn` gives it something to do and returns the result."""

    def __init__(self, service: str, folder: Path, *, speed: float = 1.0, **config: Any) -> None:
        super().__init__(Clock(speed))
        if service == "camera_opencv":
            image = np.zeros((PANDA.world.camera.height, PANDA.world.camera.width, 3), np.uint8)
            assert cv2.imwrite(str(folder / "1.png"), image)
            config = {"source": str(folder), "rate": 50.0, **config}
        quick = {"camera_simulator": {"rate": 50.0}, "depth_camera": {"rate": 30.0, "max_rate": 30.0}}
        self.service, self.module = service, importlib.import_module(f"services.{service}")
        self.config = config_of(service).model_copy(update={**quick.get(service, {}), **config})

    async def __aenter__(self) -> Running:
        self._life = self.running(self.module, self.config)
        await self._life.__aenter__()
        self._turns = TURNS[self.service](self)
        await self.bus.ready()
        return self

    async def __aexit__(self, *error: object) -> None:
        await self._turns.aclose()
        await self._life.__aexit__(*error)

    async def turn(self) -> Any:
        async with asyncio.timeout(PATIENCE):
            return await anext(self._turns)

    async def tune(self, **values: Any) -> None:
        """Change parameters as an operator does; paths without `services.<name>.` are of the service."""
        sections = tunable_sections(self.module.Config)
        paths = {path if path.split(".")[0] in sections else f"services.{self.service}.{path}": value
                 for path, value in values.items()}
        client = self.client(topics.parameters_of(self.service))
        await client.call(m.ParameterRequest(set=paths, by="a test"), PATIENCE)
