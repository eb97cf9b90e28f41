"""Moves the arm and the fingers: a trajectory controller at 100 Hz on top of a hardware backend.

Its simulated world lives in the same process, because the gripper decides whether a grasp succeeds.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from common import topics
from common.application import find_application
from common.config import Grasp, Members, Parameters, Reach, RobotConfig, Run, Tunable, World
from common.control.executor import Executor
from common.control.force_requests import ForceLimits
from common.control.force_sensing import ForceSensing
from common.control.interlocks import InterlockStore, effective_speed, exclusive_lock, interlock_file
from common.control.motion_authority import OrphanPolicy, WhenAlone
from common.control.request_handlers import MAX_STOPS, RequestHandlers
from common.control.status import Report
from common.control.trajectory import Tolerances
from common.control.wrench import Payload
from common.errors import ConfigError
from common.hardware.interface import ControlledArm, Limits, has_simulated_world, load_hardware, real_arm
from common.messages import MotionOwner, MotionStatus
from common.process.service import main
from common.robot.model import RobotModel
from common.robot.tool_mass import described_tool
from common.scene.workspace import configured_bounds
from common.sim.interface import GraspTolerances, PhysicalWorld
from common.sim.simulated_cell import (
    BackgroundSaver,
    Saver,
    SimulatedCell,
    StateFile,
    create_world,
    matching_state,
    state_file,
)
from common.transport.bus import Bus
from common.transport.writer import Writer

MAX_CYCLES = 250.0  # per second of wall time
FileLock = Callable[[Path, str], contextlib.AbstractAsyncContextManager[None]]  # of a path, for a named holder


class Config(Parameters):
    """Rates and tolerances of the controller."""

    robot: RobotConfig
    world: World
    run: Run
    grasp: Grasp
    reach: Reach = Reach()
    joint_state_rate: float = Field(100.0, ge=10, le=1000, description="control cycles in cell time [Hz]")
    speed_scaling: Tunable[float] = Field(1.0, ge=0.05, le=1, description="trajectories are followed at this share "
                                                                           "of their speed")
    members: Members
    request_timeout: Tunable[float] = Field(
        2.0, ge=0.1, le=60, description="a request that was decided longer ago is refused [s, wall time]"
    )
    clock_tolerance: Tunable[float] = Field(
        0.2, ge=0.01, le=10, description="a request from this far in the future is refused, too [s, wall time]"
    )
    when_alone: Tunable[WhenAlone] = Field(
        "finish", description="what the arm does when its task vanishes during a motion: finish it, or hold on the "
                              "path until the task is back"
    )
    tolerances: Tolerances = Tolerances()
    grasp_tolerances: GraspTolerances = Field(GraspTolerances(), description="of simulated hardware only")


class Publishers:
    """Writers of all topics of the executor."""

    def __init__(self, bus: Bus, config: Config, simulated: bool) -> None:
        """Declare them."""
        self._writers: dict[str, Writer[Any]] = {  # by field of a report
            "joints": bus.writer(topics.JOINT_STATES), "motion": bus.writer(topics.MOTION_STATUS),
            "robot": bus.writer(topics.ROBOT_STATUS), "owner": bus.writer(topics.MOTION_OWNER),
            "wrench": bus.writer(topics.WRENCH),
        }
        if config.robot.gripper:
            self._writers["gripper"] = bus.writer(topics.GRIPPER_STATE)
        self._set_points = bus.writer(topics.SET_POINTS)
        self._updates = bus.writer(topics.SCENE_OBJECT_UPDATES) if simulated else None
        if simulated:
            self._writers["objects"] = bus.writer(topics.SCENE_OBJECTS)
        if simulated and config.world.conveyors:
            self._writers["conveyors"] = bus.writer(topics.CONVEYOR_STATE)
        application = config.members.application
        views = find_application(application).truth_views if simulated and application else {}
        self._views = [(bus.writer(topic), view) for topic, view in views.items()]  # the truth in application messages

    def put(self, status: MotionStatus | MotionOwner) -> None:
        """Publish a status at once."""
        self._writers["owner" if isinstance(status, MotionOwner) else "motion"].put(status)

    def put_report(self, report: Report, executor: Executor) -> None:
        """Publish what has changed in a cycle, and its set-points if there is a subscriber."""
        if report.joints is not None and self._set_points.matched:
            self._set_points.put(executor.set_points(report.joints.header))
        for field, writer in self._writers.items():
            if (message := getattr(report, field)) is not None:
                writer.put(message)
        if report.objects is not None:
            for view_writer, view in self._views:
                view_writer.put(view(report.objects))
        if self._updates is not None:
            for update in report.updates:
                self._updates.put(update)


def create_executor(
    bus: Bus, config: Config, store: InterlockStore, simulated: bool, period: float,
    saver_for: Callable[[StateFile], Saver] = BackgroundSaver,
) -> Executor:
    """Create the executor with its hardware at the home pose and, when simulated, all objects laid out.

    Its cycles are `period` of wall time [s] apart. Simulated hardware starts where it was before a restart, if that was
    in the same world.
    """
    clock, robot = bus.clock, RobotModel.load(config.robot)
    deceleration = np.array(config.robot.deceleration_limits) if config.robot.deceleration_limits else None
    limits = Limits(
        tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration, deceleration, robot.jerk
    )
    start, world, persisted, saver = robot.named("home"), None, None, None
    if simulated:
        bounds = configured_bounds(config.reach.parameters)
        world = create_world(config.world, config.run.seed, robot, config.grasp, bounds, config.grasp_tolerances,
                             config.robot.gripper)
        if file := state_file(bus.cell):
            persisted = matching_state(file.load(), config.world.simulator, world, robot.dof)
            saver = saver_for(file)
        if persisted is not None:
            start = np.array(persisted.q)
    world_arm = partial(world.hardware, robot, limits, start) if isinstance(world, PhysicalWorld) else None
    hardware = load_hardware(config.robot, limits, start, world_arm)
    if isinstance(hardware, ControlledArm) and clock.speed != 1.0:
        hardware.close()
        raise ConfigError("speed", clock.speed, "must be 1: the arm has a controller with a clock of its own")
    backend = None if world is None else SimulatedCell(
        world, hardware, robot, simulator=config.world.simulator, persisted=persisted, saver=saver)
    tool = described_tool(robot)
    force = ForceSensing(hardware, robot, config.robot.tcp_link, config.robot.gripper, config.robot.wrench,
                         Payload(tool[0], *tool[1].tolist()) if tool is not None else None)
    executor = Executor(
        hardware, limits, start, tolerances=config.tolerances, gripper=config.robot.gripper,
        controller=config.robot.controller, kinematics=robot, world=backend, interlocks=store.interlocks,
        force=force, period=period * clock.speed,
        force_limits=ForceLimits(config.robot.force_limit, config.robot.torque_limit),
    )
    executor.restore(clock.now())
    return executor


def serve(bus: Bus, config: Config, handlers: RequestHandlers, simulated: bool) -> None:
    """Declare all requests."""
    bus.save_parameters = handlers.save_speed
    bus.serve(topics.MOTION_EXECUTE, handlers.execute)
    bus.serve(topics.MOTION_FORCE, handlers.move_by_force)
    bus.serve(topics.MOTION_FOLLOWED, handlers.followed)
    bus.serve(topics.MOTION_STOP, handlers.stop, max_pending=MAX_STOPS, on_overload=handlers.stop_for_unread)
    bus.serve(topics.MOTION_HOLD, handlers.hold)
    bus.serve(topics.MOTION_OWN, handlers.own)
    bus.serve(topics.ROBOT_COMMAND, handlers.order)
    bus.serve(topics.WRENCH_ZERO, handlers.zero_wrench)
    if config.robot.gripper:
        bus.serve(topics.GRIPPER_COMMAND, handlers.command_gripper)
    if simulated:
        bus.serve(topics.WORLD_EDIT, handlers.edit)
    if simulated and config.world.conveyors:
        bus.serve(topics.CONVEYOR_SET, handlers.set_conveyor)


async def run(
    bus: Bus, config: Config, *, file_lock: FileLock = exclusive_lock,
    saver_for: Callable[[StateFile], Saver] = BackgroundSaver,
) -> None:
    """Control the arm until cancelled.

    Args:
        bus: in the cell.
        config: parameters.
        file_lock: keeps other executors, also of another cell of that name, from the interlock store.
        saver_for: creates what saves the state of simulated hardware without blocking the loop.
    """
    simulated = has_simulated_world(config.robot)
    publishers = Publishers(bus, config, simulated)
    jog_commands = bus.reader(topics.MOTION_JOG)
    handlers = RequestHandlers(bus.service, config, bus.clock, bus.log, publishers.put)
    serve(bus, config, handlers, simulated)
    await bus.acquire_keys()  # before, another executor may still change the file
    async with contextlib.AsyncExitStack() as stack:
        file = interlock_file(bus.cell, real_arm(config.robot))
        await stack.enter_async_context(file_lock(file.path, f"{bus.service} of {bus.cell}"))
        file.require_writable()
        began = bus.clock.now_ns()  # an executor before this one may have executed what was decided until now
        store = InterlockStore(file, bus.log)
        configured = config.speed_scaling
        config.speed_scaling = effective_speed(store.interlocks.speed, configured)
        if config.speed_scaling != configured:
            bus.log.warning("speed is at %.0f %%, as it was set while the cell ran: `zencell param set "
                            "services.trajectory_executor.speed_scaling=1` ends that", 100 * config.speed_scaling)
        period = 1 / bus.clock.wall_rate(config.joint_state_rate, MAX_CYCLES)
        executor = await asyncio.to_thread(create_executor, bus, config, store, simulated, period, saver_for)
        handlers.start(executor, store, began, configured)
        if executor.world is not None and executor.world.restored:
            bus.log.info("the arm and its surroundings are as they were before the restart")

        async def jog() -> None:
            async for command in jog_commands:
                handlers.jog(command)

        jogging = asyncio.create_task(jog(), name="jog")
        restoring = asyncio.create_task(store.restore_file(), name="restore interlock file")
        try:
            await control(bus, config, executor, handlers, publishers, jogging, period)
        finally:
            jogging.cancel()
            restoring.cancel()
            await handlers.close()
            executor.close()


async def control(
    bus: Bus, config: Config, executor: Executor, handlers: RequestHandlers, publishers: Publishers,
    jogging: asyncio.Task[None], period: float,
) -> None:
    """Run a control cycle every `period` of wall time [s] until cancelled; then bring the arm to rest first."""
    loop = asyncio.get_running_loop()
    orphan_policy, task, present = OrphanPolicy(), config.members.task, False
    due = loop.time()

    def cycle() -> None:
        nonlocal due
        executor.speed_scaling = config.speed_scaling
        report = executor.cycle(bus.header("world"))
        handlers.after_cycle(report)
        publishers.put_report(report, executor)
        due = max(due + period, loop.time())  # no burst after an overrun

    try:
        await bus.ready()
        while True:
            was_present, present = present, task in bus.alive
            if was_present and not present:
                executor.authority.disown_task()
            orphaned = orphan_policy.update(present, executor.arm.goal, config.when_alone)
            executor.force_motions.task_present = present
            executor.authority.hold_by_controller(orphaned, f"{task} is gone")
            cycle()
            if jogging.done():
                jogging.result()
            await asyncio.sleep(due - loop.time())
    except asyncio.CancelledError:
        executor.authority.hold_by_controller(True, f"{bus.service} ends")
        while not executor.arm.at_rest:
            await asyncio.sleep(due - loop.time())
            cycle()
        raise


if __name__ == "__main__":
    main(run, Config)
