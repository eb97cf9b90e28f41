"""Answers to requests: run them on the executor, persist interlocks before the answer, log who requested what."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Protocol, TypeVar

from common.clock import Clock
from common.control.executor import Executor
from common.control.interlocks import InterlockStore, Speed
from common.control.jogging import DEADMAN
from common.control.motion_authority import check_age
from common.control.status import Report
from common.control.trajectory_controller import TrajectoryController
from common.errors import Refused
from common.hardware.interface import WorldBackend
from common.messages import (
    UNKNOWN_OPERATOR,
    ConveyorSet,
    ConveyorState,
    ExecuteRequest,
    FollowedRequest,
    ForceMotion,
    GripperCommand,
    GripperState,
    Header,
    HoldRequest,
    JogCommand,
    MotionOwner,
    MotionStatus,
    OwnRequest,
    RobotCommand,
    RobotStatus,
    StopRequest,
    WorldEdit,
    WorldEditReply,
    Wrench,
    ZeroWrench,
)

T = TypeVar("T")

MAX_STOPS = 50  # unread requests to stop: each takes about 1 ms
ON_REQUEST = "on request"  # logged for a stop or a hold without a reason
SETTLE_TIMEOUT = 1.0  # [s] cell time for an arm at rest to be so for long enough to zero its wrench
MAX_JOG_NAMES = 16  # operators whose refused jogging was logged


class Settings(Protocol):
    """Parameters that may change while the executor runs."""

    request_timeout: float
    clock_tolerance: float
    speed_scaling: float


class WorldThread:
    """Runs long changes of the simulated world in a thread; the control cycle does not advance it meanwhile."""

    def __init__(self, world: WorldBackend) -> None:
        """Change this world."""
        self._world, self._lock = world, asyncio.Lock()
        self._step: asyncio.Task[None] | None = None
        world.defers_steps = True

    async def edit(self, request: WorldEdit, clock: Clock) -> WorldEditReply:
        """Change the world as requested."""
        if not self._lock.locked() and not self._world.edit_takes_long(request):
            return self._world.edit(request, clock.now())
        return await self._run(lambda: self._world.edit(request, clock.now()))

    def start_step(self) -> None:
        """Start a deferred step."""
        if self._step is not None and self._step.done():
            self._step.result()
            self._step = None
        if self._step is None and self._world.deferred is not None:
            self._step = asyncio.create_task(self._run(self._world.deferred), name="world")
            self._world.deferred = None

    async def _run(self, change: Callable[[], T]) -> T:
        async with self._lock:
            self._world.suspended = True
            try:
                return await asyncio.to_thread(change)
            finally:
                self._world.suspended = False

    def close(self) -> None:
        """Do not wait for a step."""
        if self._step is not None:
            self._step.cancel()


class Permission(Protocol):
    """Asks for permission to move in a cell of several arms; see `common.process.reservation`."""

    def check(self, request: ExecuteRequest) -> Refused | None:
        """Return why a motion cannot be permitted, or None."""

    def ask_for(self, request: ExecuteRequest, arm: TrajectoryController, held: Callable[[], bool]) -> None:
        """Ask for a goal that is held at its start."""

    def check_alone(self) -> Refused | None:
        """Return why the arm may not move on an unknown path now, or None."""

    def close(self) -> None:
        """Stop asking."""


class RequestHandlers:
    """One method for each request of the executor's service; call `start` before the first request.

    Attributes:
        permission: to move, in a cell of several arms; None in a cell of one.
    """

    permission: Permission | None = None

    def __init__(
        self, name: str, settings: Settings, clock: Clock, log: logging.Logger,
        publish: Callable[[MotionStatus | MotionOwner], None],
    ) -> None:
        """Handle requests of the service `name`; `publish` sends a state ahead of the answer to its change."""
        self._name, self._settings, self._clock, self._log, self._publish = name, settings, clock, log, publish
        self._orders: dict[int, asyncio.Future[str]] = {}  # in progress in the arm's own controller
        self._saving: list[asyncio.Task[MotionStatus]] = []  # answers of stops for unread requests
        self._arm_stop_saving: asyncio.Task[str] | None = None
        self._refused_jogging: dict[str, str] = {}  # logged error code by operator
        self._aborted = ""  # newest goal whose abort was logged

    def start(self, executor: Executor, store: InterlockStore, began: int, configured_speed: float) -> None:
        """Set the executor, its interlocks, its start [ns of cell time], and the speed scaling of the cell file."""
        self._executor, self._store, self._began, self._configured = executor, store, began, configured_speed
        self._arm_stopped = store.interlocks.arm_stopped
        self._world = WorldThread(executor.world) if executor.world is not None else None
        store.on_change = executor.authority.apply_interlocks

    def _header(self, frame: str = "") -> Header:
        return Header(stamp=self._clock.now_ns(), frame_id=frame)

    def _check_age(self, header: Header) -> Refused | None:
        age, uptime = (self._clock.age_ms(stamp) * 1e-3 for stamp in (header.stamp, self._began))
        return check_age(age, self._settings.request_timeout, self._settings.clock_tolerance, uptime)

    async def _persisted(self, status: MotionStatus) -> MotionStatus:
        """Return the answer once all interlocks are on disk, or with the problem."""
        if problem := await self._store.save():
            message = f"{status.message}; {problem}".removeprefix("; ")
            status = status.model_copy(update={"message": message, "interlocks": self._store.interlocks.all})
        # A client that has the answer may read the published state next.
        if changed := self._executor.changed_motion(self._header("world")):
            self._publish(changed)
        return status.model_copy(update={"header": self._header()})

    # --- motion ---------------------------------------------------------------------------------------------------

    async def execute(self, request: ExecuteRequest) -> MotionStatus:
        """Follow a trajectory."""
        refusal = self._check_age(request.header)
        assessment = None
        if refusal is None and self._executor.takes_long(request):  # the control cycle continues meanwhile
            assessment = await asyncio.to_thread(self._executor.assess, request)
        permission, executor = self.permission, self._executor
        new = permission is not None and not executor.arm.knows(request.id)
        if permission is not None and new:
            refusal = refusal or permission.check(request)
            if not executor.arm.goal:
                executor.authority.hold_at_start(request.id, "waits for the permission of the coordinator")
        status = executor.execute(request, self._clock.now(), refusal, assessment)
        if permission is not None and new and status.state == "active":
            permission.ask_for(request, executor.arm, lambda: "coordinator" in executor.arm.reports.holds)
        if status.state == "rejected":
            self._log.warning("goal %s rejected: %s [%s]", request.id, status.message, status.error)
        return await self._persisted(status)

    async def move_by_force(self, request: ForceMotion) -> MotionStatus:
        """Move by the wrench at the tool."""
        if not request.trajectory.points:
            return self._executor.move_by_force(request, self._clock.now())
        refusal = self._check_age(request.header)
        if self.permission is not None:
            refusal = Refused("several_arms", "a motion by force is not proved against other arms")
        status = self._executor.move_by_force(request, self._clock.now(), refusal)
        if status.state == "rejected":
            self._log.warning("force motion %s rejected: %s [%s]", request.id, status.message, status.error)
        return await self._persisted(status)

    async def followed(self, request: FollowedRequest) -> ExecuteRequest:
        """Return the request of the goal that is followed."""
        return self._executor.followed(request.id)

    async def stop(self, request: StopRequest) -> MotionStatus:
        """Bring the arm to rest; an operator's stop blocks other motions."""
        if request.by == "operator":
            by = request.owner or UNKNOWN_OPERATOR  # the task passes the stop of its operator on: one line is enough
            again = any(one.by == by for one in self._store.interlocks.stops)
            self._log.log(logging.DEBUG if again else logging.INFO, "stopped by %s: %s", by,
                          request.reason or ON_REQUEST)
        return await self._persisted(self._executor.authority.stop(request, self._clock.now()))

    def stop_for_unread(self) -> str:
        """Stop the robot, as one of too many unread requests to stop may be an operator's."""
        for done in [each for each in self._saving if each.done()]:
            self._saving.remove(done)
            done.result()
        if not any(one.by == self._name for one in self._store.interlocks.stops):
            self._log.error("more than %d requests to stop wait: the robot is stopped for all of them", MAX_STOPS)
            unread = StopRequest(owner=self._name, reason="more requests to stop come than can be read")
            status = self._executor.authority.stop(unread, self._clock.now())
            self._saving.append(asyncio.create_task(self._persisted(status), name="stop"))
        return "the robot is stopped for all of them"

    async def hold(self, request: HoldRequest) -> MotionStatus:
        """Hold the arm on its path, or release interlocks."""
        authority = self._executor.authority
        before, owner = len(self._store.interlocks.all), authority.owner
        status, released = authority.hold(request, self._clock.now())
        by = (request.owner or UNKNOWN_OPERATOR) if request.by == "operator" else request.by
        why = request.reason or ON_REQUEST
        if request.hold and not status.held:
            self._log.info("%s requested a hold of %s, which is over: %s", by, request.goal, why)
        elif request.hold:
            self._log.info("held by %s: %s", by, why)
        elif status.interlocks:
            remaining = "; ".join(interlock.description for interlock in status.interlocks)
            part = "some interlocks" if released or len(status.interlocks) < before else "no interlock"
            self._log.info("%s released %s: %s; still %s", by, part, why, remaining)
        else:
            self._log.info("released by %s: %s", by, why)
        for interlock in released:
            if interlock.by != by:
                self._log.warning("%s released an interlock of another operator: %s", by, interlock.description)
        if owner.kind not in ("none", "task", authority.owner.kind) and owner.owner != by:
            self._log.warning("%s starts the task: the motion was %s", by, owner.description)
        return await self._persisted(status)

    async def own(self, request: OwnRequest) -> MotionOwner:
        """Take or release motion ownership."""
        before = self._executor.authority.owner
        now = self._executor.authority.own(request, self._clock.now())
        if now.owner != before.owner and {before.kind, now.kind} != {"none", "task"}:
            self._log.info("%s: the motion was %s, it is %s now", request.owner, before.description, now.description)
        if problem := await self._store.save():
            self._log.error("%s", problem)
        if changed := self._executor.authority.changed_owner(self._header("world")):
            self._publish(changed)
        return now.model_copy(update={"header": self._header()})

    def jog(self, request: JogCommand) -> None:
        """Jog the arm; the reason of a refusal is logged once."""
        logged = self._refused_jogging
        try:
            age, tolerance = self._clock.age_ms(request.header.stamp) * 1e-3, self._settings.clock_tolerance
            refusal = check_age(age, DEADMAN + tolerance, tolerance)
            if self.permission is not None:
                refusal = refusal or self.permission.check_alone()
            self._executor.jog(request, refusal)
            logged.pop(request.owner, None)
        except Refused as refusal:
            if refusal.code not in (logged.get(request.owner), "let_go"):
                self._log.warning("%s cannot jog the arm: %s [%s]", request.owner, refusal, refusal.code)
            logged[request.owner] = refusal.code
            while len(logged) > MAX_JOG_NAMES:
                logged.pop(next(iter(logged)))

    async def save_speed(self) -> None:
        """Persist a speed scaling that was set live."""
        speed = self._store.interlocks.speed
        if self._settings.speed_scaling != (speed.scaling if speed else self._configured):
            self._store.interlocks.speed = Speed(scaling=self._settings.speed_scaling, configured=self._configured)
            await self._store.save()

    # --- gripper, arm and world -----------------------------------------------------------------------------------

    async def command_gripper(self, request: GripperCommand) -> GripperState:
        """Move the fingers."""
        refusal = self._check_age(request.header) if request.header.stamp else None
        state = self._executor.command_gripper(request, self._clock.now(), refusal)
        await self._store.save()  # a task that is refused for the owner of the motion is stopped
        return state.model_copy(update={"header": self._header()})

    async def order(self, request: RobotCommand) -> RobotStatus:
        """Run a function of the arm's own controller."""
        what = request.act + (f" {request.value:g}" if request.value else "")
        self._log.info("%s orders the arm: %s", request.owner or UNKNOWN_OPERATOR, what)
        if request.header.stamp and (refusal := self._check_age(request.header)):
            raise refusal  # it does not recover from a stop after the request
        if request.act == "freedrive" and request.value and self.permission is not None:
            raise Refused("several_arms", "an arm next to others is not moved by hand: nothing proves where it goes")
        self._orders[number := self._executor.vendor.order(request)] = asyncio.get_running_loop().create_future()
        if outcome := await self._orders[number]:
            raise Refused("robot", f"{request.act}: {outcome}")
        return self._executor.robot.model_copy(update={"header": self._header()})

    async def zero_wrench(self, request: ZeroWrench) -> Wrench:
        """Take the present wrench as zero; wait for the end of a motion's swing, but for no motion."""
        refusal = self._check_age(request.header) if request.header.stamp else None
        if refusal := refusal or self._executor.authority.check_owner(request.owner):
            raise refusal
        end = self._clock.now() + SETTLE_TIMEOUT
        while True:
            try:
                self._executor.force.zero()
                break
            except Refused as refused:
                if refused.code != "settling" or self._clock.now() > end:
                    raise
            await self._clock.sleep(SETTLE_TIMEOUT / 20)
        self._log.info("%s zeroed the wrench", request.owner or "the task")
        return self._executor.force.message(self._header())

    async def set_conveyor(self, request: ConveyorSet) -> ConveyorState:
        """Start or stop a belt, or change its speed."""
        refusal = self._check_age(request.header) if request.header.stamp else None
        state = self._executor.set_conveyor(request, self._header("world"), refusal)
        wanted = [] if request.running is None else ["on" if request.running else "off"]
        wanted += [] if request.speed is None else [f"{request.speed:g} m/s"]
        self._log.info("conveyor %s: %s by %s", request.name or state.belts[0].name, ", ".join(wanted) or "unchanged",
                       request.owner)
        return state

    async def edit(self, request: WorldEdit) -> WorldEditReply:
        """Change the simulated world."""
        if self._world is None:
            raise Refused("not_simulated", "the world of real hardware cannot be edited")
        return await self._world.edit(request, self._clock)

    # --- the cycle ------------------------------------------------------------------------------------------------

    def after_cycle(self, report: Report) -> None:
        """Log what has happened in a cycle, start what it has deferred, and answer orders that are done."""
        for note in report.notes:
            self._log.warning("%s", note)
        if report.motion is not None and report.motion.state == "aborted" and report.motion.id != self._aborted:
            self._aborted = report.motion.id
            self._log.warning("goal %s: %s [%s]", report.motion.id, report.motion.message, report.motion.error)
        if self._store.interlocks.arm_stopped != self._arm_stopped:
            self._arm_stopped = self._store.interlocks.arm_stopped
            self._arm_stop_saving = asyncio.create_task(self._store.save(), name="save interlocks")
        if self._world is not None:
            self._world.start_step()
        for number in list(self._orders):
            outcome = self._executor.vendor.outcome(number)
            if outcome is not None and not (order := self._orders.pop(number)).done():
                order.set_result(outcome)

    async def close(self) -> None:
        """Finish writing a safety stop of the arm; do not wait for anything else."""
        if self.permission is not None:
            self.permission.close()
        if self._world is not None:
            self._world.close()
        if self._arm_stop_saving is not None:
            await self._arm_stop_saving
        self._store.close()
