"""The arm and the hand of a cell, for a program: where they are, plans, motions, jogging, and whose the motion is."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Iterator, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from common import topics
from common.client.goals import GoalLike, Plan, Point, WaypointPath, goal_of, numbers
from common.client.operator_motion import PATIENCE, MotionFailed, OperatorMotion
from common.client.part import Part
from common.client.subscriptions import NothingReceived, Subscriptions
from common.config import check
from common.errors import ConfigError, RequestLost, RequestTimeout, UnknownName, ZencellError
from common.messages import (
    ArcGoal,
    GripperCommand,
    GripperState,
    HoldRequest,
    JogCommand,
    JointState,
    MotionOwner,
    MotionStatus,
    OwnRequest,
    PathConstraints,
    RobotCommand,
    RobotDescription,
    RobotStatus,
    StopRequest,
)
from common.time_source import new_id

Array = NDArray[np.float64]

TIMEOUT = 5.0  # [s] wall for an answer
POWER = 60.0  # [s] wall: power and brakes take some
JOG_PERIOD = 0.02  # [s] wall
LONGEST_JOG = 60.0  # [s] wall
FIRST_WORD = 3.0  # [s] in which the motion has become ours
RESTS, AT_REST = 1.0, 1e-3  # [s] wall in which a jogged arm rests, [rad/s, m/s]
UNHEARD, LET_GO = 0.3, 0.4  # [s] of jogging in vain, and without it, after which it counts anew
SCENE_KNOWS = 0.5  # [s] wall until the planning scene has what is held, if it can know of that
FINGERS = 10.0  # [s] wall in which fingers have come to their end
ARCS = "circ"  # plans arcs, and need not be in the pipeline of a cell
ACTIVE = ("active", "none")
NO_WAY = "the arm cannot go that way, or its controller does not take it in time"


class JogFailed(ZencellError):
    """The arm did not go as it was asked to."""

    exit_code = 1

    def __init__(self, owner: str, why: str) -> None:
        super().__init__(f"the arm is not jogged: the motion is {owner}{why and f'; {why}'}. The log of the executor "
                         "says more: zencell topic echo log/trajectory_executor")


class Arm(Part):
    """The arm. Lengths in metres, angles in radians; poses are (4, 4), of the tool centre point in world.

    Nothing moves while a task has the robot, or somebody else; whoever runs the program can always move what they
    stopped or hold themselves. A motion that is cancelled, also by Ctrl-C, is stopped.
    """

    owner: str  # in whose name it is moved

    def __init__(self, ear: Subscriptions, owner: str, tf: Callable[[str, str], Coroutine[Any, Any, Array]]) -> None:
        """The arm of a cell, moved in the name of `owner`."""
        self._has(owner=owner)
        self._motion = OperatorMotion(ear.bus, owner=owner)
        self._ear, self._bus, self._tf = ear, ear.bus, tf
        self._moving: set[asyncio.Task[Any]] = set()  # what moves it in this program
        self._owning, self._lease = 0, 0.0  # blocks in which it is ours, and for how long without a motion [s]

    # --- where it is ----------------------------------------------------------------------------------------------

    async def description(self) -> RobotDescription:
        """Names of its joints, limits, named poses, the frame of its tool."""
        return await self._ear.newest(topics.ROBOT_DESCRIPTION)

    async def joints(self) -> Array:
        """Positions (dof,) [rad or m] now, in the order of `description().joints`."""
        return (await self._measured())[0]

    async def velocities(self) -> Array:
        """Velocities (dof,) [rad/s or m/s] now."""
        return (await self._measured())[1]

    async def _measured(self) -> tuple[Array, Array]:
        names = (await self.description()).joints
        state: JointState = await self._ear.fresh(topics.JOINT_STATES)
        q = dict(zip(state.name, state.position, strict=True))
        dq = dict(zip(state.name, state.velocity or [0.0] * len(state.name), strict=True))
        missing = [name for name in names if name not in q]
        if missing:
            raise NothingReceived(f"{self._bus.cell}/joint_states of {', '.join(missing)}")
        return np.array([q[name] for name in names]), np.array([dq[name] for name in names])

    async def pose(self, frame: str = "world") -> Array:
        """The pose (4, 4) of the tool centre point in a frame now."""
        return await self._tf(frame, (await self.description()).tcp)

    async def status(self) -> MotionStatus:
        """What it follows, how far that is, and who stopped or holds it."""
        return await self._ear.now(topics.MOTION_STATUS)

    async def robot(self) -> RobotStatus:
        """What the arm's own controller says: mode, why it cannot be moved, speed slider, inputs and outputs."""
        return await self._ear.now(topics.ROBOT_STATUS)

    # --- motion ---------------------------------------------------------------------------------------------------

    async def plan(
        self, to: GoalLike | WaypointPath, *, straight: bool = False, via: Point | None = None,
        around: Point | None = None, speed: float | None = None, touch: Iterable[str] = (), planner: str = "",
        constraints: PathConstraints | None = None, **more: Any,
    ) -> Plan:
        """A motion from where the arm is; nothing moves.

        Args:
            to: a named pose, joint positions, a pose (4, 4), `region(...)`, `any_of(...)`, `through(...)` or a goal.
            straight: the tool goes in a straight line.
            via: a point that the tool passes on an arc [m].
            around: the centre of that arc [m].
            speed: share of the speed limits, up to 1; else that of the cell.
            touch: ids of objects that the fingers may touch on the way, such as the one to be grasped.
            planner: only this one; for arcs `circ` if none is named.
            constraints: what is kept to on the way.
            more: other fields of a `PlanRequest`, such as planning_time [s] and allowed_collisions.

        Raises:
            ConfigError: it is no goal.
            UnknownName: nothing of that name is there to touch; with the choices.
            MotionFailed: there is no way; `code` says which kind of no, the line what is in the way.
            RequestFailed: the planner does not answer.
        """
        if straight and (via is not None or around is not None):
            raise ConfigError("straight", straight, "does not go with via or around, which are arcs")
        if isinstance(to, WaypointPath):
            to = to.starting_at(await self.pose())
        goal = goal_of(to, via=via, around=around)
        if names := [touch] if isinstance(touch, str) else list(touch):
            await self._require_there(names)
            pairs = [(link, name) for link in (await self.description()).fingers for name in names]
            more["allowed_collisions"] = [*more.get("allowed_collisions", ()), *pairs]
        planner = planner or (ARCS if isinstance(goal, ArcGoal) else "")
        response = await self._motion.plan(goal, **_asked(
            more, straight=straight, velocity_scaling=speed, planner=planner, constraints=constraints))
        if not response.ok or response.trajectory is None:
            raise MotionFailed(response.error, response.message)
        return Plan.of(response)

    async def _require_there(self, names: Iterable[str]) -> None:
        scene = await self._ear.now(topics.PLANNING_SCENE)
        there = [thing.id for thing in scene.objects] + [held.object.id for held in scene.attached]
        for name in names:
            if name not in there:
                raise UnknownName("object to touch", str(name), there)

    async def execute(self, plan: Plan, *, timeout: float = PATIENCE) -> MotionStatus:
        """Follow a plan to its end.

        Args:
            plan: begins where the arm is.
            timeout: give up and stop after so long without progress, but for the time it is held [s, wall].

        Raises:
            MotionFailed: somebody else has the robot, or the motion ended otherwise: `code` and the line say how.
            RequestFailed: the executor does not answer.
        """
        return await self._follow(plan, timeout)

    async def move(self, to: GoalLike | WaypointPath, *, timeout: float = PATIENCE, **how: Any) -> MotionStatus:
        """Plan and execute: see there. What somebody says while it is planned keeps the arm, whoever that is."""
        acknowledged = (await self.status()).newest  # may miss our last request
        await self.require_free()
        return await self._follow(await self.plan(to, **how), timeout, acknowledged)

    async def _follow(self, plan: Plan, timeout: float, acknowledged: int | None = None) -> MotionStatus:
        """Follow a plan; what was said later than `heard` keeps the arm, left out: than now."""
        if not isinstance(plan, Plan) or plan.response.trajectory is None:
            raise ConfigError("plan", plan, "must be a Plan, as `arm.plan(...)` returns it")
        with self._noted():
            return await self._motion.follow(
                plan.response.trajectory, timeout=timeout, plan=plan.response, acknowledged=acknowledged)

    @contextlib.contextmanager
    def _noted(self) -> Iterator[None]:
        """Have what is done inside be ended by `end`."""
        task = asyncio.current_task()
        assert task is not None
        self._moving.add(task)
        try:
            yield
        finally:
            self._moving.discard(task)

    async def end(self) -> None:
        """Stop what this program moves: whoever waits for it is cancelled."""
        moving = self._moving - {asyncio.current_task()}
        for task in moving:
            task.cancel()
        if moving:
            await asyncio.wait(moving)

    async def require_free(self) -> MotionStatus:
        """The motion status, when nothing and nobody moves the robot.

        Raises:
            MotionFailed: a task or another person has it, or nobody says how it is.
        """
        return await self._motion.require_free()

    async def stop(self, reason: str = "a program asked for it") -> MotionStatus:
        """Bring it to rest, whoever moves it; a task waits for a start then, also after a restart of anything."""
        asked = check(StopRequest, {"reason": reason, "owner": self.owner}, "stop")
        return await self._bus.client(topics.MOTION_STOP).call(asked, TIMEOUT)

    async def hold(self, reason: str = "") -> MotionStatus:
        """Bring it to rest on its path until `release`."""
        return await self._hold(True, reason)

    async def release(self) -> MotionStatus:
        """Let it go on along its path."""
        return await self._hold(False, "")

    async def _hold(self, hold: bool, reason: str) -> MotionStatus:
        asked = check(HoldRequest, {"hold": hold, "reason": reason, "owner": self.owner}, "hold")
        return await self._bus.client(topics.MOTION_HOLD).call(asked, TIMEOUT)

    async def jog(
        self, *, joints: Mapping[str, float] | None = None, linear: Point = (0.0, 0.0, 0.0),
        angular: Point = (0.0, 0.0, 0.0), frame: Literal["base", "tool", "world"] = "base", seconds: float = 1.0,
    ) -> None:
        """Move with a velocity for a while. The arm stands 0.2 s after the end of it, or of this program.

        Args:
            joints: velocities by names of joints [rad/s].
            linear: velocity of the tool centre point [m/s], at most 0.25.
            angular: rotation of the tool about it [rad/s].
            frame: whose axes linear and angular are along.
            seconds: wall time, at most a minute.

        Raises:
            ConfigError, UnknownName: what cannot be asked for.
            JogFailed: the motion does not become ours, or is not any more.
            RequestFailed: nobody says how the robot is.
        """
        check_seconds(seconds)
        with self._noted():
            await self._jog(joints or {}, numbers("linear", linear), numbers("angular", angular), frame, seconds)
        with contextlib.suppress(TimeoutError):  # who moves it next is refused while it comes to rest
            async with asyncio.timeout(RESTS):
                # An arm that was told to move just now may not have begun: the executor knows whether it is over.
                while np.abs(await self.velocities()).max() > AT_REST or (await self.owner_now()).jogging:
                    pass

    async def _jog(
        self, joints: Mapping[str, float], linear: Array, angular: Array, frame: str, seconds: float
    ) -> None:
        asked = check(JogCommand, {
            "owner": self.owner, "joints": dict(joints), "frame": frame,
            "linear": dict(zip("xyz", linear.tolist(), strict=True)),
            "angular": dict(zip("xyz", angular.tolist(), strict=True))}, "jog")
        known = (await self._ear.newest(topics.JOINT_STATES)).name
        for name in asked.joints:
            if name not in known:
                raise UnknownName("joint", name, known)
        motion, owners = self._ear.reader(topics.MOTION_STATUS), self._ear.reader(topics.MOTION_OWNER)
        acknowledged = (await self._ear.newest(topics.MOTION_STATUS)).newest
        await self._ear.newest(topics.MOTION_OWNER)
        writer = self._bus.writer(topics.MOTION_JOG)
        clock = asyncio.get_running_loop().time
        first = began = clock()
        ours = False
        try:
            while (past := clock() - began) < seconds:
                writer.put(asked.model_copy(update={"header": self._bus.header(), "acknowledged": acknowledged}))
                await asyncio.sleep(JOG_PERIOD)
                now, state = owners.latest, motion.latest
                assert now is not None and state is not None
                goes = now.jogging and now.owner == self.owner
                another = now.kind != "none" and now.owner != self.owner
                waits = not (goes or ours or another) and clock() - first < FIRST_WORD
                if waits and past > UNHEARD:  # an executor that has just begun, or refused us, wants a pause first
                    await asyncio.sleep(LET_GO)
                    began = clock()
                elif not goes and not waits:
                    late = ours and not now.jogging
                    why = "" if another else "words of this program came too late" if late else NO_WAY
                    raise JogFailed(now.description, _kept(state) or why)
                ours = ours or goes
        finally:
            writer.put(JogCommand(header=self._bus.header(), owner=self.owner, acknowledged=acknowledged))
        while not ours and clock() - began < UNHEARD:  # that it moves is told a moment after it was asked for
            await asyncio.sleep(JOG_PERIOD)
            now = owners.latest
            assert now is not None
            ours = now.jogging and now.owner == self.owner
        if not ours:
            now, state = owners.latest, motion.latest
            assert now is not None and state is not None
            another = now.kind != "none" and now.owner != self.owner
            raise JogFailed(now.description, _kept(state) or ("" if another else NO_WAY))

    # --- whose the motion is --------------------------------------------------------------------------------------

    async def own(
        self, act: Literal["take", "give"], *, over: bool = False, lease: float = 0.0,
        kind: Literal["operator", "script"] = "script",
    ) -> MotionOwner:
        """Take the motion until it is given back, or give it back: see `owned`."""
        asked = check(OwnRequest, {"act": act, "owner": self.owner, "kind": kind, "over": over, "lease": lease}, "own")
        return await self._bus.client(topics.MOTION_OWN).call(asked, TIMEOUT)

    @contextlib.asynccontextmanager
    async def owned(self, *, over: bool = False, lease: float = 0.0) -> AsyncIterator[MotionOwner]:
        """Have the motion inside the block: neither a task nor anybody else moves the robot meanwhile.

        A block within another one leaves the motion to that, and has its lease unless it is given one.

        Args:
            over: take it from whoever has it; what they move comes to rest, and a task waits for a start.
            lease: give it back after so long without a motion [s, wall], should this program hang; 0: never.

        Raises:
            RemoteError: it is somebody else's.
        """
        before = self._lease
        try:
            owner = await self.own("take", over=over, lease=lease or before)
        except (asyncio.CancelledError, RequestLost, RequestTimeout):  # it may have been carried out
            await self._give()
            raise
        self._owning, self._lease = self._owning + 1, lease or before
        try:
            yield owner
        finally:
            self._owning, self._lease = self._owning - 1, before
            await self._give()

    async def _give(self) -> None:
        """Give the motion back, unless a block of this program still has it."""
        if not self._owning:
            await self.own("give")

    async def owner_now(self) -> MotionOwner:
        """Whose the motion is."""
        return await self._ear.now(topics.MOTION_OWNER)

    async def order(self, act: str, value: float = 0.0, **more: Any) -> RobotStatus:
        """Have the arm's own controller enable, recover, freedrive (1 or 0), payload [kg] or set an output."""
        asked = check(RobotCommand, {
            "header": self._bus.header(), "act": act, "value": value, "owner": self.owner, **more}, act)
        return await self._bus.client(topics.ROBOT_COMMAND).call(asked, POWER)


class Gripper(Part):
    """The fingers, or the suction cup, of which width 0 draws air in."""

    def __init__(self, ear: Subscriptions, owner: str, arm: Arm) -> None:
        """The gripper of a cell, moved in the name of `owner`."""
        self._ear, self._bus, self._owner, self._arm = ear, ear.bus, owner, arm

    async def state(self) -> GripperState:
        """Width [m], whether it holds something, and what became of the newest command."""
        return await self._ear.now(topics.GRIPPER_STATE)

    async def move(
        self, width: float, force: float = 0.0, *, expected: float | None = None, tolerance: float = 0.005,
        mass: float = 0.0, timeout: float = FINGERS,
    ) -> GripperState:
        """Move the fingers, and return what they did, once they rest.

        Args:
            width: between the fingers [m].
            force: to press with [N]; 0: the gripper's own.
            expected: width of what is to be held [m]: what is wider or narrower than that by `tolerance` is told.
            tolerance: of `expected` [m].
            mass: of what is to be held [kg], for the arm's controller; 0: not known.
            timeout: [s, wall].

        Raises:
            ConfigError: what cannot be asked for.
            MotionFailed: somebody else has the robot, it was refused, or the fingers do not come to an end.
            RequestFailed: the executor does not answer.
        """
        if not (await self._arm.description()).gripper:
            raise MotionFailed("no_gripper", "the robot of this cell has no gripper")
        acknowledged = (await self._arm.require_free()).newest
        asked = check(GripperCommand, {
            "acknowledged": acknowledged,
            "header": self._bus.header(), "id": f"{self._owner}-{new_id()}"[-100:], "owner": self._owner,
            "width": width, "effort": force, "expected_width": expected, "width_tolerance": tolerance, "mass": mass,
        }, "gripper")
        reader = self._ear.reader(topics.GRIPPER_STATE)
        scenes = self._ear.reader(topics.PLANNING_SCENE)  # has come by the time the fingers rest
        state = await self._bus.client(topics.GRIPPER_COMMAND).call(asked, TIMEOUT)
        try:
            async with asyncio.timeout(timeout):
                while state.id == asked.id and state.state in ACTIVE:
                    state = await reader.next()
                    if state.id != asked.id and state.header.stamp < asked.header.stamp:
                        state = state.model_copy(update={"id": asked.id, "state": "active"})  # of before
        except TimeoutError:
            raise MotionFailed("timeout", f"the fingers do not come to rest within {timeout:g} s") from None
        if state.id != asked.id:
            raise MotionFailed("replaced", f"another command has taken the fingers: {state.id}")
        if state.state == "rejected":
            raise MotionFailed(state.error, f"the gripper refused: {state.message}")
        with contextlib.suppress(TimeoutError):  # the next motion is planned with what is in the hand
            async with asyncio.timeout(SCENE_KNOWS):
                scene = scenes.latest
                while scene is not None and bool(scene.attached) != state.holding:
                    scene = await scenes.next()
        return state

    async def open(self, force: float = 0.0) -> GripperState:
        """As wide as it gets."""
        return await self.move((await self._arm.description()).gripper_width, force)

    async def close(self, force: float = 0.0, **more: Any) -> GripperState:
        """Until the fingers meet, or something is between them: `holding` says so."""
        return await self.move(0.0, force, **more)


def check_seconds(seconds: float, field: str = "seconds") -> None:
    """Return when an arm may be jogged for so long [s], as was said in a field.

    Raises:
        ConfigError: it may not.
    """
    if not 0 < seconds <= LONGEST_JOG:
        raise ConfigError(field, seconds, f"must be more than 0 and at most {LONGEST_JOG:g} s")


def _asked(more: dict[str, Any], **given: Any) -> dict[str, Any]:
    for name in {"goal", *given} & more.keys():
        raise ConfigError(name, more[name], "is said twice")
    return {**{name: value for name, value in given.items() if value is not None}, **more}


def _kept(state: MotionStatus) -> str:
    """Who keeps the arm from moving, in words."""
    return "; ".join(interlock.description for interlock in state.interlocks) or state.message
