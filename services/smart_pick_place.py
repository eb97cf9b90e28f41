"""Runs the pick-and-place task: watches targets, scene, gripper and motion, and asks for plans and motion."""

from __future__ import annotations

import asyncio
import contextlib
import uuid
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from common import messages as m
from common import topics
from common.config import Grasp, RobotConfig, Run, Surroundings
from common.errors import RemoteError, RequestFailed
from common.robot.model import RobotModel
from common.tasks.pick_place import PickPlace, PickPlaceParameters
from common.tasks.stages import Command, View
from common.transport.bus import Bus
from common.transport.reader import Reader
from common.transport.requests import Client
from common.transport.service import main

A = TypeVar("A", bound=m.Message)
Q = TypeVar("Q", bound=m.Message)
Work = Coroutine[Any, Any, None]
NOT_YET = ("no_scene", "no_state")  # the planner has not heard enough to answer
AGAIN_AFTER = 0.1  # [s] wall


class Config(PickPlaceParameters):
    """Parameters of the task and the sections that it needs."""

    robot: RobotConfig
    world: Surroundings
    grasp: Grasp
    run: Run


async def run(bus: Bus, config: Config) -> None:
    """Step the task whenever something is heard, and at least 20 times a second."""
    targets, scene = bus.reader(topics.VALIDATED_TARGETS), bus.reader(topics.PLANNING_SCENE)
    gripper, motion = bus.reader(topics.GRIPPER_STATE), bus.reader(topics.MOTION_STATUS)
    joints = bus.reader(topics.JOINT_STATES)
    plan, execute = bus.client(topics.MOTION_PLAN), bus.client(topics.MOTION_EXECUTE)
    stop, grip = bus.client(topics.MOTION_STOP), bus.client(topics.GRIPPER_COMMAND)
    status = bus.writer(topics.PICK_PLACE_STATUS)
    robot = RobotModel.load(config.robot)
    if config.robot.gripper is None:
        raise ValueError("the task needs a robot with a gripper")
    prefix = uuid.uuid4().hex[:8]
    # A picture that is late by the clock on the wall is later still by that of a fast cell.
    parameters = config.model_copy(update={"frame_timeout": config.frame_timeout * bus.clock.speed})
    task = PickPlace(parameters, config.grasp, config.world, config.robot.gripper, prefix, config.run.autostart)
    view = View(now=bus.clock.now())
    woken = asyncio.Event()

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

    def planned(answer: m.PlanResponse) -> None:
        task.on_plan(answer, look())

    def goal(answer: m.MotionStatus | m.GripperState) -> None:
        task.on_goal(answer, look())

    def work(command: Command) -> Work:
        """The request that a command stands for; what is refused is an answer too."""
        if isinstance(command, m.PlanRequest):
            return ask(plan, command, planned, config.planning_time + 5, lambda error: m.PlanResponse(
                id=command.id, ok=False, error=error.code, message=error.message))
        if isinstance(command, m.GripperCommand):
            return ask(grip, command, goal, 1.0, lambda error: m.GripperState(
                id=command.id, state="rejected", message=error.message))
        if isinstance(command, m.ExecuteRequest):
            return ask(execute, command, goal, 1.0, lambda error: m.MotionStatus(
                id=command.id, state="rejected", error=error.code, message=error.message))
        return ask(stop, command, lambda _: None, 1.0, lambda error: m.MotionStatus(message=error.message))

    async def ask(
        client: Client[Q, A], request: Q, then: Callable[[A], None], timeout: float, refused: Callable[[RemoteError], A]
    ) -> None:
        """Ask until there is an answer. The id makes it safe: what was done once is not done again."""
        while True:
            try:
                answer = await client.call(request, timeout=timeout)
                break
            except RemoteError as error:
                if error.code not in NOT_YET:
                    answer = refused(error)
                    break
                task.status.message = str(error)
            except RequestFailed as error:
                task.status.message = str(error)
            await asyncio.sleep(AGAIN_AFTER)
        then(answer)
        woken.set()

    async def wake_on(reader: Reader[A]) -> None:
        async for _ in reader:
            woken.set()

    async def obey(command: m.TaskCommand) -> m.PickPlaceStatus:
        bus.log.info("told to %s", command.command)
        for wanted in task.command(command.command, look()):
            group.create_task(work(wanted))
        woken.set()
        return task.status

    bus.serve(topics.TASK_COMMAND, obey)
    await bus.ready()
    async with asyncio.TaskGroup() as group:
        for wake in (wake_on(targets), wake_on(scene), wake_on(gripper), wake_on(motion)):
            group.create_task(wake)
        before = m.PickPlaceStatus()
        while True:
            with contextlib.suppress(TimeoutError):  # time passes too: a grace period may have ended
                async with asyncio.timeout(0.05):  # wait_for of Python 3.11 can lose a cancellation
                    await woken.wait()
            woken.clear()
            for command in task.step(look()):
                group.create_task(work(command))
            now = task.status
            if now.model_copy(update={"task_seconds": before.task_seconds, "header": before.header}) != before:
                if now.state != before.state or now.message not in ("", before.message):
                    bus.log.info("%s", f"{now.state} {now.message}".rstrip())
                now.header = bus.header()
                status.put(now)
                before = now.model_copy(deep=True)


if __name__ == "__main__":
    main(run, Config)
