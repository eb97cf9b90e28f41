"""How long a picture of the world with physics takes, by each way to draw it, and how far objects are off in it.

    python benchmarks/pictures.py [--pictures 10]

Reports processor time: with other work on the machine it is more meaningful than wall time.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import cv2
import numpy as np

from common.config import Light, Scenery, load_cell
from common.messages import Header, JointState, WorldObject
from common.perception.pinhole import Pinhole, silhouette
from common.robot.model import RobotModel
from common.sim.interface import load_world
from common.sim.sensors import REFERENCE, DepthSensorParameters, Sensor, SensorParameters, simulate_depth
from drivers.mujoco.gl import select_gl
from drivers.mujoco.rendering import PhysicsRenderer

EVEN = Scenery(lights={"above": Light(shadow=False)})


def cost(call: Callable[[], object], count: int) -> str:
    """Processor time of one call [ms], after a first one."""
    call()
    begin = time.process_time()
    for _ in range(count):
        call()
    return f"{1e3 * (time.process_time() - begin) / count:6.1f} ms"


def at_home(robot: RobotModel, turned: float = 0.0) -> JointState:
    """The arm at home, its first joint turned by an angle [rad]."""
    position = robot.named("home")
    position[0] += turned
    locked = robot.config.locked_joints
    return JointState(header=Header(), name=[*robot.joint_names, *locked], position=[*position, *locked.values()])


def draw_one(name: str, count: int) -> None:
    """What a picture of a cell costs."""
    cell = load_cell(name)
    robot, camera = RobotModel.load(cell.robot), Pinhole.from_config(cell.world.camera)
    objects = load_world(cell.world, cell.world.objects).objects(Header()).objects
    print(f"{name}, {camera.width} x {camera.height}")
    for what, scenery, depth, gl in (
        ("OpenGL with shadows", Scenery(), False, select_gl()), ("the same, and depth", Scenery(), True, select_gl()),
        ("OpenGL without shadows", EVEN, False, select_gl()), ("rays, with depth", EVEN, True, ""),
    ):
        renderer = PhysicsRenderer(cell.world, scenery, [robot], camera, depth=depth, gl=gl)
        states = [at_home(robot, 0.01 * number) for number in range(2)]

        def draw(renderer: PhysicsRenderer = renderer, states: list[JointState] = states) -> object:
            states.reverse()  # it moved: else it would not be drawn again
            return renderer.render(objects, states[0])

        print(f"  {what:24} {cost(draw, count)}")


def sense(count: int) -> None:
    """What a sensor costs at 640 x 480."""
    rng, camera = np.random.default_rng(0), Pinhole.from_config(load_cell("panda").world.camera)
    picture, depth = np.full((480, 640, 3), 120, np.uint8), np.full((480, 640), 0.8, np.float32)
    sensor = Sensor(SensorParameters(full_well=10_000, auto_exposure=True, white_balance="auto"), rng)
    print(f"  {'sensor, all automatic':24} {cost(lambda: sensor.expose([picture], np.full(3, REFERENCE)), count)}")
    stereo = DepthSensorParameters(baseline=0.075)
    print(f"  {'depth sensor':24} {cost(lambda: simulate_depth(depth, camera, stereo, rng), count)}")


def errors() -> None:
    """How far the middles of spheres are from where the camera sees those of their outlines."""
    cell = load_cell("panda")
    robot, camera = RobotModel.load(cell.robot), Pinhole.from_config(cell.world.camera)
    objects: list[WorldObject] = load_world(cell.world, cell.world.objects).objects(Header()).objects
    seen = PhysicsRenderer(cell.world, EVEN, [robot], camera, depth=False, gl=select_gl()).render(
        objects, at_home(robot, 2.8)).colour.astype(int)
    red = (seen[..., 2] > 60) & (seen[..., 2] > 3 * seen[..., :2].max(axis=2))
    _, _, _, middles = cv2.connectedComponentsWithStats(red.astype(np.uint8))
    apart = []
    for thing in objects:
        p = thing.pose.position
        m = cv2.moments(silhouette(camera, np.array((p.x, p.y, p.z)), thing.size.x / 2, 720).astype(np.float32))
        expected = np.array((m["m10"], m["m01"])) / m["m00"]
        apart.append(float(np.linalg.norm(middles[1:] - expected, axis=1).min()))
    print(f"  middles of {len(apart)} spheres are {np.mean(apart):.3f} px off, {np.max(apart):.3f} at most")


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=int, default=10)
    count = parser.parse_args().pictures
    print(f"drawn by {select_gl() or 'rays'}")
    for name in ("panda", "ur5"):
        draw_one(name, count)
    print("640 x 480")
    sense(count)
    errors()


if __name__ == "__main__":
    main()
