"""Robots, scenes and collision worlds of the planning tests."""

from common.config import load_cell
from common.messages import AttachedObject, CollisionObject, Header, PlanningScene, Pose, Vector3
from common.planning.collision import CollisionWorld
from common.planning.obstacles import ObstacleCache
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel

WORLD = Header(frame_id="world")
CELL = load_cell("panda")
ROBOT = RobotModel.load(CELL.robot)
UR5 = RobotModel.load(load_cell("ur5").robot)
GEOMETRY = RobotGeometry(ROBOT)
HOME = ROBOT.named("home")
FINGERS = ("panda_hand", "panda_leftfinger", "panda_rightfinger")

# Seven balls on the table, and a block of five with 65 to 70 mm between the centres.
SPREAD = [(0.30, -0.28), (0.35, -0.05), (0.42, -0.18), (0.48, 0.02), (0.55, -0.10), (0.60, -0.27), (0.33, 0.20)]
BLOCK = [(0.50, -0.10), (0.565, -0.10), (0.435, -0.10), (0.50, -0.03), (0.50, -0.17)]


def cache() -> ObstacleCache:
    """A new cache: a world of a shared one would invalidate earlier worlds."""
    return ObstacleCache(GEOMETRY)


def world(of: PlanningScene, start=HOME, **more) -> CollisionWorld:
    return CollisionWorld(ROBOT, of, start=start, cache=more.pop("cache", None) or cache(), **more)


def solid(name, role, shape, dimensions, position, **more) -> CollisionObject:
    x, y, z = position
    pose = Pose(position=Vector3(x=x, y=y, z=z))
    return CollisionObject(id=name, role=role, shape=shape, dimensions=dimensions, pose=pose, **more)


def ball(number, x, y, z=0.03, role="target") -> CollisionObject:
    return solid(f"ball_{number}", role, "sphere", [0.03], (x, y, z))


def only(*objects: CollisionObject) -> PlanningScene:
    return PlanningScene(header=WORLD, objects=list(objects))


def scene(balls=(), *more: CollisionObject, box=True) -> PlanningScene:
    """A table with balls, further objects, and a box as the container."""
    objects = [solid("table", "fixture", "box", [1.2, 1.6, 0.05], (0.4, 0, -0.025))]
    if box:
        objects.append(solid("box_floor", "container", "box", [0.16, 0.16, 0.005], (0.55, 0.25, 0.0025)))
        for name, dx, dy, sides in (
            ("box_north", 0.076, 0, [0.008, 0.16, 0.07]), ("box_south", -0.076, 0, [0.008, 0.16, 0.07]),
            ("box_west", 0, 0.076, [0.16, 0.008, 0.07]), ("box_east", 0, -0.076, [0.16, 0.008, 0.07]),
        ):
            objects.append(solid(name, "container", "box", sides, (0.55 + dx, 0.25 + dy, 0.035)))
    return only(*objects, *more, *[ball(i, x, y) for i, (x, y) in enumerate(balls)])


EMPTY, TABLE = scene(box=False), scene(SPREAD)


def wall(height: float = 0.4, depth: float = 0.5, width: float = 0.02) -> PlanningScene:
    """A wall across the table that blocks the straight edge from one side to the other."""
    return scene((), solid("wall", "fixture", "box", [depth, width, height], (0.55, 0.0, height / 2)), box=False)


def held_scene(base: PlanningScene, name: str) -> PlanningScene:
    """The scene with one of its balls attached to the gripper."""
    taken = next(o for o in base.objects if o.id == name)
    held = taken.model_copy(update={"role": "attached", "pose": Pose()})
    rest = [o for o in base.objects if o.id != name]
    return PlanningScene(header=WORLD, objects=rest, attached=[AttachedObject(link="panda_hand_tcp", object=held)])
