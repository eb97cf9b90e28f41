"""Replacement of the perception in simulations: reports the objects on the table and in containers, without images."""

from __future__ import annotations

from pydantic import Field

from applications.pick_place.perceived_scene import PerceivedScene
from applications.pick_place.topics import VALIDATED_TARGETS
from applications.pick_place.tracks import SceneParameters
from common import topics
from common.config import RobotConfig, Surroundings, Tunable
from common.errors import ConfigError
from common.messages import Header, Marker, MarkerArray, Pose, PoseArray, Vector3, WorldObject
from common.perception.pinhole import MountedCamera
from common.process.planning_scene import SceneWriter
from common.process.timing import LoopRate
from common.robot.model import RobotModel
from common.transport.bus import Bus

WORLD = "world"


class Config(SceneParameters):
    """How often the scene is published."""

    robot: RobotConfig
    world: Surroundings
    rate: Tunable[float] = Field(5.0, gt=0, le=50, description="looks per second of cell time [Hz]")


def marker(index: int, thing: WorldObject) -> Marker:
    """Return an object as the marker of a perfect detector."""
    return Marker(ns="ball", id=index, type="sphere", pose=Pose(position=thing.pose.position), scale=thing.size,
                  color=thing.color)


async def run(bus: Bus, config: Config) -> None:
    """Publish the planning scene as `scene_manager` does, and everything on the table as targets."""
    truth, joints = bus.reader(topics.SCENE_OBJECTS), bus.reader(topics.JOINT_STATES)
    gripper = bus.reader(topics.GRIPPER_STATE)
    validated, out = bus.writer(VALIDATED_TARGETS), SceneWriter(bus)
    robot = RobotModel.load(config.robot)
    camera = MountedCamera(config.world.camera, robot).at()
    if config.robot.gripper is None:
        raise ConfigError("robot.gripper", ..., "is missing: this task picks objects and needs a gripper")
    scene = PerceivedScene(config, config.world, config.robot.gripper, config.robot.tcp_link)
    await out.begin(scene.scene())
    await bus.ready()
    pace = LoopRate(bus, lambda: bus.clock.wall_rate(config.rate, 50.0))
    while True:
        state, measured, objects = gripper.latest, joints.latest, truth.latest
        q = robot.order(measured.name, measured.position) if measured else None
        T_world_tcp = robot.fk(q) if q is not None else None
        if state is not None:
            scene.update_gripper(state, T_world_tcp)
        if objects is not None:
            header = Header(stamp=bus.header().stamp, frame_id=WORLD)
            seen = [thing for thing in objects.objects if thing.state in ("table", "contained")]
            markers = [marker(index, thing) for index, thing in enumerate(seen)]
            scene.update_detections(MarkerArray(header=header, markers=markers), camera, T_world_tcp)
            out.put(scene.scene())
            validated.put(PoseArray(header=header, poses=[
                Pose(position=Vector3(x=at.x, y=at.y, z=at.z))
                for at in [thing.pose.position for thing in seen if thing.state == "table"]
            ]))
        await pace.wait()
