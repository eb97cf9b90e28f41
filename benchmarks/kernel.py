"""The planning kernel against coal: whether both say the same, and what a question costs in either.

    python -m benchmarks.kernel [--states N] [--seed S] [--robot NAME ...]

Random states of the Panda, the UR5, the UR10 and an arm with sliding joints among random shapes, some of them held.
Prints what does not agree; ends with 1 where something does not. Times are processor time.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable

import numpy as np
import pinocchio as pin

from common.config import load_cell
from common.planning.kernel.oracle import Comparison, compare, random_geometry
from common.planning.kernel.world import KernelWorld
from common.planning.robot_geometry import RobotGeometry, convex_hulls
from common.robot.model import RobotModel
from common.robot.packages import package_folders

Models = tuple[pin.Model, pin.GeometryModel]


def of_cell(name: str) -> Models:
    """The robot of a cell."""
    robot = RobotModel.load(load_cell(name).robot)
    return robot.model, RobotGeometry(robot).geometry


def of_description(urdf: str) -> Models:
    """A robot of example-robot-data, pairs of neighbouring links left out."""
    folder = next(path for path in package_folders([]) if (path / "example-robot-data").is_dir())
    robots = folder / "example-robot-data" / "robots"
    model = pin.buildModelFromUrdf(str(robots / urdf))
    geometry = pin.buildGeomFromUrdf(model, str(robots / urdf), pin.GeometryType.COLLISION, package_dirs=[str(folder)])
    joints = [item.parentJoint for item in convex_hulls(geometry).geometryObjects]
    for one, joint in enumerate(joints):
        for other in range(one + 1, len(joints)):
            if abs(joints[other] - joint) > 1:
                geometry.addCollisionPair(pin.CollisionPair(one, other))
    return model, geometry


def sliding_arm() -> Models:
    """A gantry with an arm and two fingers that turn on joints of their own: a tree, with axes that are askew."""
    import coal  # noqa: PLC0415

    rng = np.random.default_rng(4)
    model, geometry, parent = pin.Model(), pin.GeometryModel(), 0
    for number in range(7):
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        kind = pin.JointModelPrismaticUnaligned(axis) if number < 2 else pin.JointModelRevoluteUnaligned(axis)
        place = pin.SE3(pin.exp3(rng.normal(size=3)), rng.uniform(-0.3, 0.3, 3))
        low, high, most = np.full(1, -1.0), np.full(1, 1.5), np.full(1, 10.0)
        joint = model.addJoint(min(parent, 5), kind, place, f"j{number}", most, most, low, high)
        parent = joint
        shapes = [coal.Capsule(0.05, 0.2), coal.Box(0.1, 0.2, 0.1), coal.Cylinder(0.06, 0.2), coal.Sphere(0.08)]
        shape = shapes[number % 4]
        geometry.addGeometryObject(pin.GeometryObject(f"s{number}", joint, 0, pin.SE3.Random(), shape))
        geometry.geometryObjects[number].placement.translation *= 0.1
    for one in range(7):
        for other in range(one + 2, 7):
            geometry.addCollisionPair(pin.CollisionPair(one, other))
    geometry.addCollisionPair(pin.CollisionPair(5, 6))
    return model, geometry


ROBOTS: dict[str, Callable[[], Models]] = {
    "panda": lambda: of_cell("panda"),
    "ur5": lambda: of_cell("ur5"),
    "ur10": lambda: of_description("ur_description/urdf/ur10_robot.urdf"),
    "sliding": sliding_arm,
}


def costs(models: Models, rng: np.random.Generator) -> str:
    """Processor time of a state in both, and of an edge."""
    model, geometry = models[0], random_geometry(*models, rng)
    kernel, data, shapes = KernelWorld(model, geometry), model.createData(), pin.GeometryData(geometry)
    broadphase = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(model, geometry, shapes)
    low, high = np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit)
    states = rng.uniform(low, high, (1000, model.nq))

    def timed(ask: Callable[[int], object]) -> float:
        began = time.process_time()
        for i in range(len(states) - 1):
            ask(i)
        return 1e6 * (time.process_time() - began) / (len(states) - 1)

    ours = timed(lambda i: kernel.colliding(states[i]))
    theirs = timed(lambda i: pin.computeCollisions(model, data, broadphase, states[i], True))
    edge = timed(lambda i: kernel.edge_free(states[i], states[i + 1]))
    return f"state {ours:.1f} us (coal {theirs:.1f}), edge {edge:.1f} us"


def main() -> None:
    """Compare, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=2000, help="of each robot")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robot", action="append", choices=list(ROBOTS))
    given = parser.parse_args()
    wrong = False
    for name in given.robot or list(ROBOTS):
        rng = np.random.default_rng(given.seed)
        models, total, each = ROBOTS[name](), Comparison(), 50
        for number in range(max(1, given.states // each)):
            geometry = random_geometry(*models, rng, obstacles=int(rng.integers(1, 7)), held=int(rng.integers(0, 3)))
            margin = float(rng.choice([0.0, 0.0, 0.01]))
            found = compare(models[0], geometry, rng, states=each, edges=15, margin=margin)
            total += found
            for fault in found.faults:
                print(f"  {name}, world {number}: {fault}", flush=True)
        wrong = wrong or bool(total.faults)
        print(
            f"{name:8} {total.states} states, {total.pairs} pairs, edges {total.free_edges} free and "
            f"{total.blocked_edges} not; distances within {total.worst_distance:.1e} m, bounds {total.widest:.1e} m "
            f"apart; {len(total.faults)} faults; {costs(models, rng)}",
            flush=True,
        )
    sys.exit(wrong)


if __name__ == "__main__":
    main()
