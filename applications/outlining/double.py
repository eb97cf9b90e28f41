"""Replacement of the perception in simulations: reports solids and the first outline, without images."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from applications.outlining.solids import PerceivedSolid, planning_scene
from applications.outlining.topics import CONTOUR_PATH, OutlinePoints
from common import topics
from common.config import Parameters, RobotConfig, Surroundings, Tunable
from common.messages import Header, Pose, Vector3, WorldObject
from common.process.planning_scene import SceneWriter
from common.process.timing import LoopRate
from common.robot.home import HomeMonitor
from common.transport.bus import Bus

WORLD = "world"


class Config(Parameters):
    """How often the scene is published, and in how much detail."""

    robot: RobotConfig
    world: Surroundings
    rate: Tunable[float] = Field(2.0, gt=0, le=30, description="looks per second of cell time [Hz]")
    points: Tunable[int] = Field(3, ge=2, le=1000, description="of an outline")


def perceived(index: int, thing: WorldObject) -> PerceivedSolid:
    """Return an upright object as it would be perceived."""
    return PerceivedSolid(index, thing.id, np.array(thing.outline), thing.base, thing.height, thing.color, False)


def path(solid: PerceivedSolid, points: int, header: Header) -> OutlinePoints:
    """Return the outline of its top face with at most this number of points."""
    step = max(1, len(solid.outline) // points)
    top = solid.base + solid.height
    poses = [Pose(position=Vector3(x=x, y=y, z=top)) for x, y in solid.outline[::step].tolist()]
    return OutlinePoints(header=header, poses=poses, object=solid.label)


async def run(bus: Bus, config: Config) -> None:
    """Publish all solids and the outline of the first one while the arm is at home."""
    truth, joints = bus.reader(topics.SCENE_OBJECTS), bus.reader(topics.JOINT_STATES)
    paths, out = bus.writer(CONTOUR_PATH), SceneWriter(bus)
    home = HomeMonitor(config.robot.named_poses["home"])
    await out.begin(planning_scene(config.world, [], 0))
    await bus.ready()
    pace = LoopRate(bus, lambda: bus.clock.wall_rate(config.rate, 30.0))
    while True:
        objects, state, stamp = truth.latest, joints.latest, bus.header().stamp
        if state is not None:
            at = dict(zip(state.name, state.position, strict=True))
            if all(name in at for name in config.robot.joints):
                home.add([at[name] for name in config.robot.joints], state.header.stamp)
        if objects is not None and home.was_home(stamp):
            solids = [perceived(index, thing) for index, thing in enumerate(objects.objects) if thing.outline]
            out.put(planning_scene(config.world, solids, stamp))
            header = Header(stamp=stamp, frame_id=WORLD)
            paths.put(path(solids[0], config.points, header) if solids else OutlinePoints(header=header))
        await pace.wait()
