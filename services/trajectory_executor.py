"""Moves the arm and the fingers: a trajectory controller at 100 Hz on top of a hardware backend.

With simulated hardware the true world lives here too, because whether a grasp succeeds is decided by the fingers.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
from pydantic import Field

from common import topics
from common.application import find_application
from common.config import Grasp, Members, Parameters, Reach, RobotConfig, Run, Tunable, World
from common.control.checks import Tolerances
from common.control.controller import PERIOD
from common.control.cycle import ControlCycle
from common.control.decisions import Decisions
from common.control.interlocks import Interlocks, Speed, speed_of
from common.control.jogging import DEADMAN
from common.control.record_file import record_file
from common.control.requester import Alone, WhenAlone, objection
from common.control.sole_use import sole_use
from common.errors import ConfigError, Refused
from common.hardware.interface import ControlledArm, Limits
from common.hardware.loading import is_simulated, load_hardware
from common.messages import (
    UNKNOWN_OPERATOR,
    ExecuteRequest,
    FollowedRequest,
    GripperCommand,
    GripperState,
    Header,
    HoldRequest,
    MotionOwner,
    MotionStatus,
    OwnRequest,
    RobotCommand,
    RobotStatus,
    StopRequest,
    WorldEdit,
    WorldEditReply,
)
from common.perception.pinhole import cameras_at_home
from common.process.service import main
from common.robot.model import RobotModel
from common.scene.workspace import WorkspaceBounds, bounds_told, reach_reason
from common.sim.interface import GraspTolerances, PhysicalWorld, load_world
from common.sim.layout import layout
from common.sim.standing import SavedBeside, Standing, state_file
from common.transport.bus import Bus

T = TypeVar("T")

MOST_TOLD = 16  # who jogs in vain, told of once
MOST_CYCLES = 250.0  # per second of wall time
MOST_STOPS = 50  # requests to stop that may wait to be read: each takes about 1 ms
REACH_MARGIN = 0.008  # [m] random places keep from the ends of the reach: what is seen is a few millimetres off


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
        2.0, ge=0.1, le=60, description="a motion that was decided longer ago is refused [s, wall time]"
    )
    clock_tolerance: Tunable[float] = Field(
        0.2, ge=0.01, le=10, description="one that was decided so far in the future is refused too [s, wall time]"
    )
    when_alone: Tunable[WhenAlone] = Field(
        "finish", description="what the arm does when the task is gone in the middle of a motion: finish it, or hold "
                              "on the path until the task is back"
    )
    tolerances: Tolerances = Tolerances()
    grasp_tolerances: GraspTolerances = Field(GraspTolerances(), description="simulated hardware only")


def make_cycle(
    config: Config, simulated: bool, kept: Standing | None, now: float, interlocks: Interlocks | None = None,
    period: float = PERIOD, speed: float = 1.0,
) -> ControlCycle:
    """The controller with its hardware at the home pose and, when simulated, everything laid out.

    Its cycles come every `period` of cell time [s], which passes at this `speed`. Simulated hardware is found as it was
    `kept`, if that was of the same world.
    """
    robot = RobotModel.load(config.robot)
    deceleration = np.array(config.robot.deceleration_limits) if config.robot.deceleration_limits else None
    limits = Limits(
        tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration, deceleration, robot.jerk
    )
    start = robot.named("home")
    world = None
    if simulated:
        bounds = bounds_told(config.reach.told)
        seen = cameras_at_home(config.world, robot)
        objects = layout(
            seen, config.run.seed, lambda x, y, z: within_reach(robot, (x, y, z), config.grasp, bounds))
        world = load_world(config.world, objects, config.grasp_tolerances, config.robot.gripper)
        if kept is not None and (
            kept.simulator != config.world.simulator or kept.layout != world.layout or len(kept.q) != robot.dof
        ):
            kept = None
        if kept is not None:
            start = np.array(kept.q)
    physical = world if isinstance(world, PhysicalWorld) else None
    arm = partial(physical.hardware, robot, limits, start) if physical is not None else None
    hardware = load_hardware(config.robot, limits, start, arm)
    if isinstance(hardware, ControlledArm) and speed != 1.0:
        hardware.close()
        raise ConfigError("speed", speed, "must be 1: the arm has a controller with a clock of its own")
    cycle = ControlCycle(
        hardware, limits, start,
        tolerances=config.tolerances, gripper=config.robot.gripper, controller=config.robot.controller,
        kinematics=robot, world=world, interlocks=interlocks, period=period,
    )
    if kept is not None:
        cycle.restore(kept, now)
    return cycle


def within_reach(
    robot: RobotModel, place: tuple[float, float, float], grasp: Grasp, bounds: WorkspaceBounds
) -> bool:
    """Whether the arm can take something from a place [m], and from a little nearer and farther as well."""
    x, y, z = place
    radius = max(math.hypot(x, y), REACH_MARGIN)
    scales = (1 + off / radius for off in (REACH_MARGIN, -REACH_MARGIN, 0.0))
    return all(not reach_reason(robot, (s * x, s * y, z), grasp, bounds, explained=False) for s in scales)


async def run(bus: Bus, config: Config) -> None:
    """Control the arm until cancelled."""
    async with contextlib.AsyncExitStack() as ours:
        await control(bus, config, ours)


async def control(bus: Bus, config: Config, ours: contextlib.AsyncExitStack) -> None:
    """Control the arm until cancelled; what is ours alone meanwhile is let go of afterwards."""
    simulated = is_simulated(config.robot)
    joints, motion = bus.writer(topics.JOINT_STATES), bus.writer(topics.MOTION_STATUS)
    robot, owner = bus.writer(topics.ROBOT_STATUS), bus.writer(topics.MOTION_OWNER)
    jogged = bus.reader(topics.MOTION_JOG)
    gripper = bus.writer(topics.GRIPPER_STATE) if config.robot.gripper else None
    updates = bus.writer(topics.SCENE_OBJECT_UPDATES) if simulated else None
    objects = bus.writer(topics.SCENE_OBJECTS) if simulated else None
    application = config.members.application
    views = find_application(application).truth_views if simulated and application else {}
    called = [(bus.writer(topic), view) for topic, view in views.items()]  # the truth in the application's words

    def too_late(header: Header) -> Refused | None:
        age, uptime = (bus.clock.age_ms(stamp) * 1e-3 for stamp in (header.stamp, began))
        return objection(age, config.request_timeout, config.clock_tolerance, uptime)

    async def execute(request: ExecuteRequest) -> MotionStatus:
        late = too_late(request.header)
        judged = None
        if late is None and cycle.takes_long(request):  # set-points go on leaving meanwhile
            judged = await asyncio.to_thread(cycle.judge, request)
        status = cycle.execute(request, bus.clock.now(), late, judged)
        if status.state == "rejected":
            bus.log.warning("goal %s rejected: %s [%s]", request.id, status.message, status.error)
        return await kept_answer(status)

    async def stop(request: StopRequest) -> MotionStatus:
        if request.by == "operator":
            bus.log.info("stopped by %s: %s", request.owner or UNKNOWN_OPERATOR, request.reason)
        return await kept_answer(cycle.authority.stop(request, bus.clock.now()))

    noting: list[asyncio.Task[MotionStatus]] = []

    def stops_unread() -> str:
        """Stop the robot, as one of the requests to stop that nobody has time to read may be a person's."""
        for done in [each for each in noting if each.done()]:
            noting.remove(done)
            done.result()
        if not any(one.by == bus.service for one in interlocks.stops):
            bus.log.error("more than %d requests to stop wait: the robot is stopped for all of them", MOST_STOPS)
            unread = StopRequest(owner=bus.service, reason="more requests to stop come than can be read")
            status = cycle.authority.stop(unread, bus.clock.now())
            noting.append(asyncio.create_task(kept_answer(status), name="stop"))
        return "the robot is stopped for all of them"

    async def hold(request: HoldRequest) -> MotionStatus:
        before, owned = len(interlocks.all), cycle.authority.owner
        status, let_go = cycle.authority.hold(request, bus.clock.now())
        who = (request.owner or UNKNOWN_OPERATOR) if request.by == "operator" else request.by
        why = request.reason or "asked to"
        if request.hold and not status.held:
            bus.log.info("%s asked to hold %s, which is over: %s", who, request.goal, why)
        elif request.hold:
            bus.log.info("held by %s: %s", who, why)
        elif status.interlocks:
            told = "; ".join(interlock.description for interlock in status.interlocks)
            part = "a part" if let_go or len(status.interlocks) < before else "nothing"
            bus.log.info("%s let go of %s: %s; still %s", who, part, why, told)
        else:
            bus.log.info("let go by %s: %s", who, why)
        for interlock in let_go:
            if interlock.by != who:
                bus.log.warning("%s let go of what another said: %s", who, interlock.description)
        if owned.kind not in ("none", "task", cycle.authority.owner.kind) and owned.owner != who:
            bus.log.warning("%s has the task move the arm: the motion was %s", who, owned.description)
        return await kept_answer(status)

    async def kept_answer(status: MotionStatus) -> MotionStatus:
        """The answer, which is given once what was decided outlives us."""
        if problem := await decisions.keep():
            message = f"{status.message}; {problem}".removeprefix("; ")
            status = status.model_copy(update={"message": message, "interlocks": interlocks.all})
        if news := cycle.news_of_motion(bus.header("world")):  # who has the answer may ask for the state next
            motion.put(news)
        return status.model_copy(update={"header": bus.header()})

    async def keep_speed() -> None:
        if config.speed_scaling != (interlocks.speed.scaling if interlocks.speed else configured):
            interlocks.speed = Speed(scaling=config.speed_scaling, configured=configured)
            await decisions.keep()

    async def followed(request: FollowedRequest) -> ExecuteRequest:
        return cycle.followed(request.id)

    async def command(request: GripperCommand) -> GripperState:
        late = too_late(request.header) if request.header.stamp else None
        state = cycle.command(request, bus.clock.now(), late)
        await decisions.keep()  # whom somebody else's motion refused is stopped
        return state.model_copy(update={"header": bus.header()})

    async def own(request: OwnRequest) -> MotionOwner:
        before = cycle.authority.owner
        now = cycle.authority.own(request, bus.clock.now())
        if now.owner != before.owner and {before.kind, now.kind} != {"none", "task"}:
            bus.log.info("%s: the motion was %s, it is %s now", request.owner, before.description, now.description)
        if problem := await decisions.keep():
            bus.log.error("%s", problem)
        if news := cycle.authority.news(bus.header("world")):
            owner.put(news)
        return now.model_copy(update={"header": bus.header()})

    async def jog() -> None:
        """Take what somebody who jogs asks for; why it does not count is logged once."""
        told: dict[str, str] = {}
        async for asked in jogged:
            try:
                cycle.jog(asked, objection(
                    bus.clock.age_ms(asked.header.stamp) * 1e-3, DEADMAN + config.clock_tolerance,
                    config.clock_tolerance))
                told.pop(asked.owner, None)
            except Refused as refusal:
                if refusal.code not in (told.get(asked.owner), "let_go"):
                    bus.log.warning("%s does not jog the arm: %s [%s]", asked.owner, refusal, refusal.code)
                told[asked.owner] = refusal.code
                while len(told) > MOST_TOLD:
                    told.pop(next(iter(told)))

    async def order(request: RobotCommand) -> RobotStatus:
        who = request.owner or UNKNOWN_OPERATOR
        bus.log.info("%s asks the arm: %s", who, request.act + (f" {request.value:g}" if request.value else ""))
        if request.header.stamp and (late := too_late(request.header)):
            raise late  # what has stopped the arm since is not what this recovers from
        ordered[number := cycle.order(request)] = asyncio.get_running_loop().create_future()
        if outcome := await ordered[number]:
            raise Refused("robot", f"{request.act}: {outcome}")
        return cycle.robot.model_copy(update={"header": bus.header()})

    async def edit(request: WorldEdit) -> WorldEditReply:
        if not world_changes.locked() and not cycle.edit_takes_long(request):
            return cycle.edit(request, bus.clock.now())
        return await in_world(lambda: cycle.edit(request, bus.clock.now()))

    async def in_world(change: Callable[[], T]) -> T:
        """Change the world beside the loop: the arm goes on meanwhile, and the world stands still."""
        async with world_changes:
            cycle.apart = True
            try:
                return await asyncio.to_thread(change)
            finally:
                cycle.apart = False

    ordered: dict[int, asyncio.Future[str]] = {}  # of the arm's own controller, and what became of it
    world_changes = asyncio.Lock()
    moving: asyncio.Task[None] | None = None
    keeping: asyncio.Task[str] | None = None

    def move_world() -> None:
        """Have done beside the loop what takes long of what the hand does to the world."""
        nonlocal moving
        if moving is not None and moving.done():
            moving.result()
            moving = None
        if moving is None and cycle.due is not None:
            moving = asyncio.create_task(in_world(cycle.due), name="world")
            cycle.due = None

    bus.keep_parameters = keep_speed
    bus.serve(topics.MOTION_EXECUTE, execute)
    bus.serve(topics.MOTION_FOLLOWED, followed)
    bus.serve(topics.MOTION_STOP, stop, most=MOST_STOPS, crowded=stops_unread)
    bus.serve(topics.MOTION_HOLD, hold)
    bus.serve(topics.MOTION_OWN, own)
    bus.serve(topics.ROBOT_COMMAND, order)
    if gripper is not None:
        bus.serve(topics.GRIPPER_COMMAND, command)
    if simulated:
        bus.serve(topics.WORLD_EDIT, edit)
    await bus.owned()  # until then another executor may change what is read now
    file = record_file(bus.cell)
    if not bus.declares_only:
        if bus.has_process:  # nor may one of another cell of that name
            await ours.enter_async_context(sole_use(file.path, f"{bus.service} of {bus.cell}"))
        file.require_writable()
    began = bus.clock.now_ns()  # who had the arm while we waited may have carried out what was decided until now
    decisions = Decisions(file, bus.log)
    interlocks, configured = decisions.interlocks, config.speed_scaling
    config.speed_scaling = speed_of(interlocks.speed, configured)
    if config.speed_scaling != configured:
        bus.log.warning("speed is at %.0f %%, as it was set while the cell ran: `zencell param set "
                        "services.trajectory_executor.speed_scaling=1` ends that", 100 * config.speed_scaling)
    standing_file = state_file(bus.cell) if simulated else None
    kept = standing_file.load() if standing_file else None
    period = 1 / bus.clock.wall_rate(config.joint_state_rate, MOST_CYCLES)
    cycle = await asyncio.to_thread(
        make_cycle, config, simulated, kept, bus.clock.now(), interlocks, period * bus.clock.speed,
        bus.clock.speed,
    )
    cycle.beside = True
    decisions.on_change = cycle.authority.report_interlocks
    memory = SavedBeside(standing_file) if standing_file and bus.has_threads else standing_file
    if cycle.restored:
        bus.log.info("the arm and what is about it are as they were")
    alone, task = Alone(), config.members.task
    loop = asyncio.get_running_loop()
    due, aborted, arm_stopped = loop.time(), "", interlocks.arm_stopped

    def turn() -> None:
        nonlocal due, aborted, arm_stopped, keeping
        cycle.speed_scaling = config.speed_scaling
        report = cycle.step(bus.header("world"))
        for note in report.notes:
            bus.log.warning("%s", note)
        if interlocks.arm_stopped != arm_stopped:
            arm_stopped = interlocks.arm_stopped
            keeping = asyncio.create_task(decisions.keep(), name="keep")
        move_world()
        if memory is not None and (standing := cycle.standing()) is not None:
            standing.simulator = config.world.simulator
            memory.save(standing)
        if report.joints is not None:
            joints.put(report.joints)
        if report.motion is not None:
            motion.put(report.motion)
            if report.motion.state == "aborted" and report.motion.id != aborted:
                aborted = report.motion.id
                bus.log.warning("goal %s: %s [%s]", report.motion.id, report.motion.message, report.motion.error)
        for number in list(ordered):
            if (outcome := cycle.outcome(number)) is not None and not (asked := ordered.pop(number)).done():
                asked.set_result(outcome)
        if report.robot is not None:
            robot.put(report.robot)
        if report.owner is not None:
            owner.put(report.owner)
        if report.gripper is not None and gripper is not None:
            gripper.put(report.gripper)
        if report.objects is not None and objects is not None:
            objects.put(report.objects)
            for writer, view in called:
                writer.put(view(report.objects))
        if updates is not None:
            for update in report.updates:
                updates.put(update)
        due = max(due + period, loop.time())  # after an overrun from now on: no burst

    there, jogs = False, asyncio.create_task(jog(), name="jog")
    try:
        await bus.ready()
        while True:
            was, there = there, task in bus.alive
            if was and not there:
                cycle.authority.disown()
            cycle.authority.wait(alone.look(there, cycle.goal, config.when_alone), f"{task} is gone")
            turn()
            if jogs.done():
                jogs.result()
            await asyncio.sleep(due - loop.time())
    except asyncio.CancelledError:  # whatever ends it: the arm comes to rest on its path first
        cycle.authority.wait(True, f"{bus.service} ends")
        while not cycle.at_rest:
            await asyncio.sleep(due - loop.time())
            turn()
        raise
    finally:
        jogs.cancel()
        if moving is not None:
            moving.cancel()
        if keeping is not None:
            await keeping
        decisions.close()
        cycle.close()
        if memory is not None:
            memory.close()


if __name__ == "__main__":
    main(run, Config)
