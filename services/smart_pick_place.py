"""Runs the pick-and-place task: watches targets, scene, gripper and motion, and asks for plans and motion."""

from __future__ import annotations

from common import topics
from common.applications.pick_place.parameters import PickPlaceParameters
from common.applications.pick_place.stages import View
from common.applications.pick_place.task import PickPlace
from common.applications.pick_place.topics import PICK_PLACE_STATUS, VALIDATED_TARGETS
from common.config import Grasp, RobotConfig, Run, Surroundings
from common.errors import ConfigError
from common.process.service import main
from common.process.task_runner import TaskRunner
from common.robot.model import RobotModel
from common.sources import new_id
from common.tasks.reliance import Reliance
from common.transport.bus import Bus


class Config(PickPlaceParameters):
    """Parameters of the task and the sections that it needs."""

    robot: RobotConfig
    world: Surroundings
    grasp: Grasp
    run: Run


async def run(bus: Bus, config: Config) -> None:
    """Step the task whenever something is heard, and at least 20 times a second."""
    targets, scene = bus.reader(VALIDATED_TARGETS), bus.reader(topics.PLANNING_SCENE)
    gripper, motion = bus.reader(topics.GRIPPER_STATE), bus.reader(topics.MOTION_STATUS)
    joints = bus.reader(topics.JOINT_STATES)
    status = bus.writer(PICK_PLACE_STATUS)
    robot = RobotModel.load(config.robot)
    if config.robot.gripper is None:
        raise ConfigError("robot.gripper", ..., "is missing: smart_pick_place needs a robot with one")
    prefix = new_id()
    task = PickPlace(
        config, config.grasp, config.world, config.robot.gripper, prefix, config.run.autostart, bus.clock.speed
    )
    view = View(now=bus.clock.now())

    def look() -> View:
        view.now = bus.clock.now()
        view.scene, view.gripper, view.motion = scene.latest, gripper.latest, motion.latest
        seen, measured = targets.latest, joints.latest
        if seen is not None:
            view.targets = [(p.position.x, p.position.y, p.position.z) for p in seen.poses]
            view.targets_stamp = seen.header.stamp * 1e-9
        q = robot.order(measured.name, measured.position) if measured else None
        if q is not None:
            x, y, z = robot.fk(q)[:3, 3]
            view.tcp = (float(x), float(y), float(z))
        return view

    reliance = Reliance(lambda: joints.received, lambda: config.joint_states_timeout)
    runner = TaskRunner(bus, task, look, status, lambda: config.planning_time, reliance)
    await bus.ready()
    await runner.run((targets, scene, gripper, motion))


if __name__ == "__main__":
    main(run, Config)
