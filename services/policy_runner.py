"""Let a learned policy move the arm: prove each chunk of its actions, and execute what is proved."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from functools import partial

import numpy as np

from applications.policy.chunks import ChunkLoop
from applications.policy.runner import PolicyTask
from applications.policy.settings import Config
from applications.policy.sources import source
from applications.policy.topics import POLICY_CONTROL, POLICY_STATUS, ControlReply, ControlRequest, PolicyStatus
from common import messages as m
from common import topics
from common.errors import Refused
from common.hardware.interface import Limits
from common.planning.robot_geometry import RobotGeometry
from common.process.obstacles import ObstacleReader
from common.process.service import main
from common.process.task_runner import TaskMemory, TaskRunner
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose
from common.tasks.monitoring import LivenessWatchdog
from common.tasks.stages import View, within_range
from common.time_source import new_id
from common.transport.bus import Bus
from common.transport.reader import Reader


class PolicyRunner(TaskRunner[View]):
    """Steps the task; gives up the ownership of motion while an operator has control."""

    def __init__(self, bus: Bus, task: PolicyTask, *given: object, **more: object) -> None:
        """Declare the request for control in addition to those of a task."""
        super().__init__(bus, task, *given, **more)  # type: ignore[arg-type]
        self._policy = task
        bus.serve(POLICY_CONTROL, self._control)

    def wake(self) -> None:
        """Step the task soon."""
        self._woken.set()

    def _needs_motion(self, motion: m.MotionStatus | None) -> bool:
        return super()._needs_motion(motion) and self._policy.wants_motion

    async def _control(self, request: ControlRequest) -> ControlReply:
        task, owner = self._policy, self._owner.latest
        holder = task.status.operator
        if request.take and (task.status.control == "policy" or request.owner != holder):
            task.take(request.owner)
        elif not request.take and task.status.control == "operator":
            if holder and request.owner != holder:  # who may be next to the arm
                raise Refused("not_owner", f"{holder} has control: only {holder} gives it back; take it over first")
            if owner is not None and owner.asked and owner.kind != "task" and owner.owner != request.owner:
                raise Refused("not_owner", f"the motion is {owner.description}: only its owner gives it back")
            task.give()
        self.wake()
        return ControlReply(header=self._bus.header(), control=task.status.control, operator=task.status.operator)


async def run(bus: Bus, config: Config) -> None:
    """Run the task, and request chunks while it wants them."""
    scenes, gripper = bus.reader(topics.PLANNING_SCENE), bus.reader(topics.GRIPPER_STATE)
    motion, joints = bus.reader(topics.MOTION_STATUS), bus.reader(topics.JOINT_STATES)
    images = {name: bus.reader(replace(topics.CAMERA_IMAGE, key=key)) for name, key in config.cameras.items()}
    out = bus.writer(POLICY_STATUS)
    robot = RobotModel.load(config.robot)
    braking = config.robot.deceleration_limits
    limits = Limits(tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration,
                    np.array(braking) if braking else None, robot.jerk)
    task = PolicyTask(config, PolicyStatus(), new_id(), limits)
    known = View(now=bus.clock.now())
    perceived: m.PlanningScene | None = None

    def observe() -> View:
        nonlocal perceived
        known.now = bus.clock.now()
        if scenes.latest is not None and scenes.latest is not perceived:
            perceived = scenes.latest
            known.scene = within_range(perceived)
        known.motion = motion.latest
        known.gripper = gripper.latest if config.robot.gripper is not None else m.GripperState()
        newest = joints.latest
        if newest is not None and (q := robot.order(newest.name, newest.position)) is not None:
            known.q, known.tcp = q.tolist(), matrix_to_pose(robot.fk(q))
        return known

    watchdog = LivenessWatchdog(lambda: joints.received, lambda: config.joint_states_timeout)
    memory = TaskMemory(bus, task)
    runner = PolicyRunner(bus, task, observe, out, lambda: config.planning_time, watchdog, memory)
    cameras = None if config.points is None else ObstacleReader(bus, config.points)
    actions = await asyncio.to_thread(source, config.source, config.cell())
    points = None
    if cameras is not None:
        seen_by = RobotModel.load(config.robot)
        cameras.load(seen_by, RobotGeometry(seen_by))
        points = partial(cameras.snapshot, stage="chunk")
    chunks = ChunkLoop(config, limits, task, actions, bus.clock, observe, runner.wake, points)
    await memory.load()
    await bus.ready()

    async def watch(camera: str, reader: Reader[m.Image]) -> None:
        async for image in reader:
            chunks.buffer.add_image(camera, image)

    async def watch_joints() -> None:
        async for state in joints:
            chunks.buffer.add_joints(state)

    async def watch_gripper() -> None:
        async for state in gripper:
            chunks.buffer.add_gripper(state)
            runner.wake()

    async with asyncio.TaskGroup() as group:
        for name, reader in images.items():
            group.create_task(watch(name, reader))
        group.create_task(watch_joints())
        group.create_task(watch_gripper())
        group.create_task(chunks.run())
        if cameras is not None:
            group.create_task(cameras.follow())
        group.create_task(runner.run((scenes, motion)))


if __name__ == "__main__":
    main(run, Config)
