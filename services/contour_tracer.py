"""Runs the outline task: watches contour, scene, gripper and motion, and asks for plans and motion."""

from __future__ import annotations

from common import topics
from common.applications.outlining.legs import OutlineView
from common.applications.outlining.task import Outline, OutlineParameters
from common.applications.outlining.topics import CONTOUR_PATH, OUTLINE_STATUS
from common.config import RobotConfig, Run
from common.errors import ConfigError
from common.process.service import main
from common.process.task_runner import TaskRunner
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose
from common.sources import new_id
from common.tasks.reliance import Reliance
from common.transport.bus import Bus


class Config(OutlineParameters):
    """Parameters of the task and the sections that it needs."""

    robot: RobotConfig
    run: Run


async def run(bus: Bus, config: Config) -> None:
    """Step the task whenever something is heard, and at least 20 times a second."""
    path, scene = bus.reader(CONTOUR_PATH), bus.reader(topics.PLANNING_SCENE)
    gripper, motion = bus.reader(topics.GRIPPER_STATE), bus.reader(topics.MOTION_STATUS)
    joints = bus.reader(topics.JOINT_STATES)
    status = bus.writer(OUTLINE_STATUS)
    robot = RobotModel.load(config.robot)
    if config.robot.gripper is None:
        raise ConfigError("robot.gripper", ..., "is missing: contour_tracer needs a robot with one")
    home, prefix = config.robot.named_poses["home"], new_id()
    task = Outline(config, config.robot.gripper, home, prefix, config.run.autostart, bus.clock.speed)
    view = OutlineView(now=bus.clock.now())

    def look() -> OutlineView:
        view.now = bus.clock.now()
        view.path, view.scene = path.latest, scene.latest
        view.gripper, view.motion = gripper.latest, motion.latest
        measured = joints.latest
        q = robot.order(measured.name, measured.position) if measured else None
        if q is not None:
            view.q, view.tcp = q.tolist(), matrix_to_pose(robot.fk(q))
        return view

    reliance = Reliance(lambda: joints.received, lambda: config.joint_states_timeout)
    runner = TaskRunner(bus, task, look, status, lambda: config.planning_time, reliance)
    await bus.ready()
    await runner.run((path, scene, gripper, motion))


if __name__ == "__main__":
    main(run, Config)
