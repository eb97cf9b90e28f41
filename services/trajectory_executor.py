"""Moves the arm and the fingers: a trajectory controller at 100 Hz on top of a hardware backend.

Its simulated world lives in the same process, because the gripper decides whether a grasp succeeds.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import Field

from common import topics
from common.application import find_application
from common.config import Arms, Grasp, Members, Parameters, Reach, RobotConfig, Run, Tunable, World
from common.control.executor import Executor
from common.control.interlocks import InterlockFile, InterlockStore, effective_speed, exclusive_lock, interlock_file
from common.control.motion_authority import OrphanPolicy, WhenAlone
from common.control.request_handlers import MAX_STOPS, RequestHandlers
from common.control.status import Report
from common.control.trajectory import Tolerances
from common.hardware.backends import has_simulated_world, real_arm
from common.messages import MotionOwner, MotionStatus
from common.process.hosted_arms import create_executors, hosted_arms
from common.process.reservation import Reservation
from common.process.service import main
from common.process.stop_of_all import StopOfAllArms
from common.process.vacuum_link import VacuumLink
from common.sim.interface import GraspTolerances
from common.sim.state_file import BackgroundSaver, Saver, StateFile
from common.transport.bus import Bus
from common.transport.writer import Writer

MAX_CYCLES = 250.0  # per second of wall time
FileLock = Callable[[Path, str], contextlib.AbstractAsyncContextManager[None]]  # of a path, for a named holder


class Config(Parameters):
    """Rates and tolerances of the controller."""

    ALL_ARMS = True

    robot: RobotConfig
    arms: Arms = Arms()
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

    def __init__(self, bus: Bus, config: Config, robot: RobotConfig, simulated: bool) -> None:
        """Declare those of a robot and, if `simulated`, of the world."""
        self._writers: dict[str, Writer[Any]] = {  # by field of a report
            "joints": bus.writer(topics.JOINT_STATES), "motion": bus.writer(topics.MOTION_STATUS),
            "robot": bus.writer(topics.ROBOT_STATUS), "owner": bus.writer(topics.MOTION_OWNER),
            "wrench": bus.writer(topics.WRENCH),
        }
        if robot.gripper:
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


class HostedArm:
    """One arm of this process on the bus: its topics, requests, interlocks and, once created, its executor.

    Attributes:
        name: of the arm; empty in a cell with one robot.
    """

    def __init__(
        self, name: str, bus: Bus, config: Config, robot: RobotConfig, stops: StopOfAllArms, *, reports_world: bool
    ) -> None:
        """Declare topics and requests; one simulated arm of a cell also reports and edits the world."""
        self.name, self.robot, self._bus, self._config = name, robot, bus.of_arm(name), config
        self._publishers = Publishers(self._bus, config, robot, reports_world)
        self._jog_commands = self._bus.reader(topics.MOTION_JOG)
        self.handlers = RequestHandlers(bus.service, config, bus.clock, bus.log, self._publishers.put)
        if len(config.arms.robots) > 1:
            self.handlers.permission = Reservation(bus, name or config.arms.own)
        self._stops = stops
        stops.hosted[name] = self.handlers
        self._serve(reports_world)
        self._orphan_policy, self._present = OrphanPolicy(), False
        self._task = config.arms.tasks.get(name, "") if name else config.members.task
        self._working: list[asyncio.Task[None]] = []

    def _serve(self, edits: bool) -> None:
        bus, handlers = self._bus, self.handlers
        bus.serve(topics.MOTION_EXECUTE, handlers.execute)
        bus.serve(topics.MOTION_FOLLOWED, handlers.followed)
        bus.serve(topics.MOTION_STOP, partial(self._stops.stop, self.name), max_pending=MAX_STOPS,
                  on_overload=self._stops.stop_for_unread)
        bus.serve(topics.MOTION_HOLD, handlers.hold)
        bus.serve(topics.MOTION_OWN, handlers.own)
        bus.serve(topics.ROBOT_COMMAND, handlers.order)
        bus.serve(topics.WRENCH_ZERO, handlers.zero_wrench)
        bus.serve(topics.MOTION_FORCE, handlers.move_by_force)
        if self.robot.gripper:
            bus.serve(topics.GRIPPER_COMMAND, handlers.command_gripper)
        if edits:
            bus.serve(topics.WORLD_EDIT, handlers.edit)
        if edits and self._config.world.conveyors:
            bus.serve(topics.CONVEYOR_SET, handlers.set_conveyor)

    def open_store(self) -> InterlockFile:
        """Return the file of its interlocks; that of a simulated arm is named after cell and arm."""
        return interlock_file(".".join(filter(None, (self._bus.cell, self.name))), real_arm(self.robot))

    def start(self, executor: Executor, store: InterlockStore, began: int, configured: float) -> None:
        """Work with this executor from now on."""
        self.executor = executor
        self.handlers.start(executor, store, began, configured)
        self._working = [asyncio.create_task(self._jog(), name="jog"),
                         asyncio.create_task(store.restore_file(), name="restore interlock file")]

    async def _jog(self) -> None:
        async for command in self._jog_commands:
            self.handlers.jog(command)

    def cycle(self) -> None:
        """Do one control cycle and publish what has changed."""
        self.executor.speed_scaling = self._config.speed_scaling
        report = self.executor.cycle(self._bus.header("world"))
        self.handlers.after_cycle(report)
        self._publishers.put_report(report, self.executor)
        for task in self._working[:1]:
            if task.done():
                task.result()

    def watch_task(self) -> None:
        """Hold, or finish, the motion of a task that has vanished."""
        was_present, self._present = self._present, self._task in self._bus.alive
        if was_present and not self._present:
            self.executor.authority.disown_task()
        self.executor.force_motions.task_present = self._present
        orphaned = self._orphan_policy.update(self._present, self.executor.arm.goal, self._config.when_alone)
        cup = self.executor.vacuum
        lost = cup.unwatched if cup is not None and self.executor.arm.goal else ""
        self.executor.authority.hold_by_controller(orphaned or bool(lost), lost or f"{self._task} is gone")

    async def close(self) -> None:
        """End what runs beside the cycle."""
        for task in self._working:
            task.cancel()
        await self.handlers.close()
        self.executor.close()


async def run(
    bus: Bus, config: Config, *, file_lock: FileLock = exclusive_lock,
    saver_for: Callable[[StateFile], Saver] = BackgroundSaver,
) -> None:
    """Control the arm, or all simulated arms of the cell, until cancelled.

    Args:
        bus: in the cell.
        config: parameters.
        file_lock: keeps other executors, also of another cell of that name, from the interlock store.
        saver_for: creates what saves the state of simulated hardware without blocking the loop.
    """
    robots = hosted_arms(config, bus.service)
    simulated = has_simulated_world(next(iter(robots.values())))
    stops = StopOfAllArms(bus, [name for name in config.arms.robots if name not in robots])
    arms = [HostedArm(name, bus, config, robot, stops, reports_world=simulated and at == len(robots) - 1)
            for at, (name, robot) in enumerate(robots.items())]
    link = VacuumLink(bus, robots.values(), simulated)
    if config.arms.robots and not config.arms.own:  # STOP of the cell, for clients that name no arm
        bus.serve(topics.MOTION_STOP, partial(stops.stop, arms[0].name), max_pending=MAX_STOPS,
                  on_overload=stops.stop_for_unread)

    async def save_speed() -> None:
        for arm in arms:
            await arm.handlers.save_speed()

    bus.save_parameters = save_speed
    await bus.acquire_keys()  # before, another executor may still change the file
    async with contextlib.AsyncExitStack() as stack:
        stores = {}
        for name, arm in zip(robots, arms, strict=True):
            file = arm.open_store()
            await stack.enter_async_context(file_lock(file.path, f"{bus.service} of {bus.cell}"))
            file.require_writable()
            stores[name] = InterlockStore(file, bus.log)
        began = bus.clock.now_ns()  # an executor before this one may have executed what was decided until now
        configured = config.speed_scaling
        config.speed_scaling = min(effective_speed(store.interlocks.speed, configured) for store in stores.values())
        if config.speed_scaling != configured:
            bus.log.warning("speed is at %.0f %%, as it was set while the cell ran: `zencell param set "
                            "services.trajectory_executor.speed_scaling=1` ends that", 100 * config.speed_scaling)
        period = 1 / bus.clock.wall_rate(config.joint_state_rate, MAX_CYCLES)
        executors = await asyncio.to_thread(
            create_executors, bus, config, robots, stores, simulated, period, saver_for)
        for name, arm in zip(robots, arms, strict=True):
            arm.start(executors[name], stores[name], began, configured)
        world = next(iter(executors.values())).world
        if world is not None and world.restored:
            bus.log.info("the arm and its surroundings are as they were before the restart")
        try:
            await control(bus, arms, period, link)
        finally:
            await link.close()
            for arm in arms:
                await arm.close()


async def control(bus: Bus, arms: Sequence[HostedArm], period: float, link: VacuumLink) -> None:
    """Run a control cycle of every arm each `period` of wall time [s] until cancelled; then bring them to rest."""
    loop = asyncio.get_running_loop()
    due = loop.time()

    def cycle() -> None:
        nonlocal due
        for arm in arms:
            arm.cycle()
        link.update([arm.executor.vacuum for arm in arms if arm.executor.vacuum is not None])
        due = max(due + period, loop.time())  # no burst after an overrun

    try:
        await bus.ready()
        while True:
            for arm in arms:
                arm.watch_task()
            cycle()
            await asyncio.sleep(due - loop.time())
    except asyncio.CancelledError:
        for arm in arms:
            arm.executor.authority.hold_by_controller(True, f"{bus.service} ends")
        while not all(arm.executor.arm.at_rest for arm in arms):
            await asyncio.sleep(due - loop.time())
            cycle()
        raise


if __name__ == "__main__":
    main(run, Config)
