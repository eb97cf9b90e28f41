"""The arm and the gripper of a cell, for a program: state, plans, motions, jogging, and motion authority."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Iterator, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from common import topics
from common.client.arguments import given, listed, require_seconds
from common.client.force import ForceArm
from common.client.goals import GoalLike, Plan, Point, WaypointPath, goal_of, numbers
from common.client.operator_motion import LONGEST_JOG, PROGRESS_TIMEOUT, Jogging, MotionFailed, OperatorMotion
from common.client.subscriptions import Part, Subscriptions
from common.config import check
from common.errors import ConfigError, RequestLost, RequestTimeout, UnknownName
from common.messages import (
    ArcGoal,
    GripperCommand,
    GripperState,
    HoldRequest,
    JogCommand,
    MotionOwner,
    MotionStatus,
    OwnRequest,
    PathConstraints,
    RobotCommand,
    RobotStatus,
    StopRequest,
)
from common.time_source import new_id

Array = NDArray[np.float64]

TIMEOUT = 5.0  # [s] wall for an answer
POWER_TIMEOUT = 60.0  # [s] wall to power the joints and release the brakes
STANDSTILL_TIMEOUT, STANDSTILL = 1.0, 1e-3  # [s] wall until a jogged arm is at rest, [rad/s, m/s]
ARC_PLANNER = "circ"  # plans arcs; it need not be in the pipeline of a cell


class Arm(ForceArm):
    """The arm. Lengths in metres, angles in radians; poses are (4, 4), of the tool centre point in world.

    Nothing moves while a task or another client has the robot; the operator can always move what they stopped or hold
    themselves. A cancelled motion, also by Ctrl-C, is stopped.
    """

    def __init__(
        self, subscriptions: Subscriptions, owner: str, tf: Callable[[str, str], Coroutine[Any, Any, Array]]
    ) -> None:
        """The arm of a cell, requested by the client `owner`."""
        self._set(owner=owner)
        self._motion = OperatorMotion(subscriptions.bus, owner=owner)
        self._subscriptions, self._bus, self._tf = subscriptions, subscriptions.bus, tf
        self._moving: set[asyncio.Task[Any]] = set()  # tasks of this program that move it
        self._owning, self._lease = 0, 0.0  # nested `owned` blocks, and their lease [s]

    # --- motion ---------------------------------------------------------------------------------------------------

    async def plan(
        self, to: GoalLike | WaypointPath, *, straight: bool = False, via: Point | None = None,
        around: Point | None = None, speed: float | None = None, touch: Iterable[str] = (), planner: str = "",
        constraints: PathConstraints | None = None, **more: Any,
    ) -> Plan:
        """Plan a motion from the current state; nothing moves.

        Args:
            to: a named pose, joint positions, a pose (4, 4), `region(...)`, `any_of(...)`, `through(...)` or a goal.
            straight: move the tool in a straight line.
            via: a point that the tool passes on an arc [m].
            around: the centre of that arc [m].
            speed: share of the speed limits, up to 1; default: that of the cell.
            touch: ids of objects that the fingers may touch on the way, such as the object to grasp.
            planner: use only this one; default for arcs: `circ`.
            constraints: of the path.
            more: other fields of a `PlanRequest`, such as planning_time [s] and allowed_collisions.

        Raises:
            ConfigError: it is not a goal.
            UnknownName: there is no such object to touch; with the choices.
            MotionFailed: there is no path; `code` says why, the message what obstructs it.
            RequestFailed: the planner does not answer.
        """
        if straight and (via is not None or around is not None):
            raise ConfigError("straight", straight, "excludes via and around, which describe arcs")
        if isinstance(to, WaypointPath):
            to = to.starting_at(await self.pose())
        goal = goal_of(to, via=via, around=around)
        if names := listed("touch", touch):
            await self._require_objects(names)
            pairs = [(link, name) for link in (await self.description()).fingers for name in names]
            more["allowed_collisions"] = [*listed("allowed_collisions", more.get("allowed_collisions", ())), *pairs]
        planner = planner or (ARC_PLANNER if isinstance(goal, ArcGoal) else "")
        response = await self._motion.plan(goal, **given({
            "straight": straight, "velocity_scaling": speed, "planner": planner, "constraints": constraints}, more))
        if not response.ok or response.trajectory is None:
            raise MotionFailed(response.error, response.message)
        return Plan.of(response)

    async def _require_objects(self, names: Iterable[str]) -> None:
        scene = await self._subscriptions.query(topics.PLANNING_SCENE)
        there = [each.id for each in scene.objects] + [held.object.id for held in scene.attached]
        for name in names:
            if name not in there:
                raise UnknownName("object to touch", str(name), there)

    async def execute(self, plan: Plan, *, timeout: float = PROGRESS_TIMEOUT) -> MotionStatus:
        """Follow a plan to its end.

        Args:
            plan: starts at the current state.
            timeout: stop after this long without progress, not counting holds [s, wall].

        Raises:
            MotionFailed: another client has motion authority, or the motion failed; see `code` and the message.
            RequestFailed: the executor does not answer.
        """
        return await self._follow(plan, timeout)

    async def move(
        self, to: GoalLike | WaypointPath, *, timeout: float = PROGRESS_TIMEOUT, **how: Any
    ) -> MotionStatus:
        """Plan and execute, with the arguments of both. Any stop or hold during planning blocks the motion."""
        acknowledged = (await self.status()).newest  # may miss our last request
        await self.require_free()
        return await self._follow(await self.plan(to, **how), timeout, acknowledged)

    async def _follow(self, plan: Plan, timeout: float, acknowledged: int | None = None) -> MotionStatus:
        """Follow a plan; interlocks newer than `acknowledged` (default: now) block it."""
        if not isinstance(plan, Plan) or plan.response.trajectory is None:
            raise ConfigError("plan", plan, "must be a Plan, as `arm.plan(...)` returns it")
        with self._registered():
            return await self._motion.follow(
                plan.response.trajectory, timeout=timeout, plan=plan.response, acknowledged=acknowledged)

    @contextlib.contextmanager
    def _registered(self) -> Iterator[None]:
        """Let `end` cancel the current task while the block runs."""
        task = asyncio.current_task()
        assert task is not None
        self._moving.add(task)
        try:
            yield
        finally:
            self._moving.discard(task)

    async def end(self) -> None:
        """Stop all motions of this program by cancelling the tasks that wait for them."""
        moving = self._moving - {asyncio.current_task()}
        for task in moving:
            task.cancel()
        if moving:
            await asyncio.wait(moving)

    async def require_free(self) -> MotionStatus:
        """Return the motion status if the robot is at standstill and no other client has motion authority.

        Raises:
            MotionFailed: a task or another operator has motion authority, or the state is unknown.
        """
        return await self._motion.require_free()

    async def stop(self, reason: str = "requested by a program") -> MotionStatus:
        """Stop the arm, also if another client moves it; a task then waits for a start, also after any restart."""
        request = check(StopRequest, {"reason": reason, "owner": self.owner}, "stop")
        return await self._bus.client(topics.MOTION_STOP).call(request, TIMEOUT)

    async def hold(self, reason: str = "") -> MotionStatus:
        """Stop the arm on its path until `release`."""
        return await self._hold(True, reason)

    async def release(self) -> MotionStatus:
        """Let the arm continue along its path."""
        return await self._hold(False, "")

    async def _hold(self, hold: bool, reason: str) -> MotionStatus:
        request = check(HoldRequest, {"hold": hold, "reason": reason, "owner": self.owner}, "hold")
        return await self._bus.client(topics.MOTION_HOLD).call(request, TIMEOUT)

    async def jog(
        self, *, joints: Mapping[str, float] | None = None, linear: Point = (0.0, 0.0, 0.0),
        angular: Point = (0.0, 0.0, 0.0), frame: Literal["base", "tool", "world"] = "base", seconds: float = 1.0,
    ) -> None:
        """Move with a velocity for a while. The arm is at standstill 0.2 s after the end of this, or of the program.

        Args:
            joints: velocities by joint name [rad/s].
            linear: velocity of the tool centre point [m/s], at most 0.25.
            angular: angular velocity of the tool about it [rad/s].
            frame: whose axes linear and angular refer to.
            seconds: duration, at most 60 [s, wall].

        Raises:
            ConfigError, UnknownName: invalid values.
            JogFailed: motion authority was not obtained, or was lost.
            RequestFailed: the state of the robot is unknown.
        """
        require_seconds("seconds", seconds, LONGEST_JOG)
        command = check(JogCommand, {
            "owner": self.owner, "joints": {} if joints is None else joints, "frame": frame,
            "linear": dict(zip("xyz", numbers("linear", linear).tolist(), strict=True)),
            "angular": dict(zip("xyz", numbers("angular", angular).tolist(), strict=True))}, "jog")
        known = (await self._subscriptions.latest(topics.JOINT_STATES)).name
        for name in command.joints:
            if name not in known:
                raise UnknownName("joint", name, known)
        with self._registered():
            await Jogging(self._subscriptions, command).run(seconds)
        with contextlib.suppress(TimeoutError):  # the next motion is rejected until the arm is at rest
            async with asyncio.timeout(STANDSTILL_TIMEOUT):
                # The arm may not have started yet: the executor knows whether it still jogs.
                while np.abs(await self.velocities()).max() > STANDSTILL or (await self.owner_now()).jogging:
                    pass

    # --- motion authority -----------------------------------------------------------------------------------------

    async def own(
        self, act: Literal["take", "give"], *, over: bool = False, lease: float = 0.0,
        kind: Literal["operator", "script"] = "script",
    ) -> MotionOwner:
        """Take motion authority until it is released, or release it; see `owned`."""
        request = check(
            OwnRequest, {"act": act, "owner": self.owner, "kind": kind, "over": over, "lease": lease}, "own")
        return await self._bus.client(topics.MOTION_OWN).call(request, TIMEOUT)

    @contextlib.asynccontextmanager
    async def owned(self, *, over: bool = False, lease: float = 0.0) -> AsyncIterator[MotionOwner]:
        """Hold motion authority inside the block: neither a task nor another client can move the robot.

        A nested block keeps the authority of the outer one, and its lease unless it has one of its own.

        Args:
            over: take it from its owner; the owner's motion is stopped, and a task then waits for a start.
            lease: release it after this long without a motion [s, wall], in case this program hangs; 0: never.

        Raises:
            RemoteError: another client has it.
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
        """Release motion authority, unless an outer block still needs it."""
        if not self._owning:
            await self.own("give")

    async def owner_now(self) -> MotionOwner:
        """Return the owner of motion authority."""
        return await self._subscriptions.query(topics.MOTION_OWNER)

    async def order(self, act: str, value: float = 0.0, **more: Any) -> RobotStatus:
        """Send a command to the arm's own controller: enable, recover, freedrive (1 or 0), payload [kg] or output."""
        command = check(RobotCommand, given({
            "header": self._bus.header(), "act": act, "value": value, "owner": self.owner}, more), "order")
        return await self._bus.client(topics.ROBOT_COMMAND).call(command, POWER_TIMEOUT)


MOVE_TIMEOUT = 10.0  # [s] wall for a motion of the fingers
SCENE_TIMEOUT = 0.5  # [s] wall until the planning scene has the held object, if it can know it
ACTIVE = ("active", "none")


class Gripper(Part):
    """The gripper: fingers, or a suction cup that draws air at width 0."""

    def __init__(self, subscriptions: Subscriptions, owner: str, arm: Arm) -> None:
        """The gripper of a cell, commanded by the client `owner`."""
        self._subscriptions, self._bus, self._owner, self._arm = subscriptions, subscriptions.bus, owner, arm

    async def state(self) -> GripperState:
        """Return width [m], whether it holds an object, and the state of the newest command."""
        return await self._subscriptions.query(topics.GRIPPER_STATE)

    async def move(
        self, width: float, force: float = 0.0, *, expected: float | None = None, tolerance: float = 0.005,
        mass: float = 0.0, timeout: float = MOVE_TIMEOUT,
    ) -> GripperState:
        """Move the fingers, and return their state at rest.

        Args:
            width: between the fingers [m].
            force: to press with [N]; 0: the gripper's default.
            expected: width of the object to grasp [m]; another width is reported.
            tolerance: of `expected` [m].
            mass: of the object to grasp [kg], for the arm's controller; 0: unknown.
            timeout: [s, wall].

        Raises:
            ConfigError: invalid values.
            MotionFailed: another client has motion authority, the command was rejected, or timed out.
            RequestFailed: the executor does not answer.
        """
        require_seconds("timeout", timeout)
        if not (await self._arm.description()).gripper:
            raise MotionFailed("no_gripper", "the robot of this cell has no gripper")
        acknowledged = (await self._arm.require_free()).newest
        command = check(GripperCommand, {
            "acknowledged": acknowledged,
            "header": self._bus.header(), "id": f"{self._owner}-{new_id()}"[-100:], "owner": self._owner,
            "width": width, "effort": force, "expected_width": expected, "width_tolerance": tolerance, "mass": mass,
        }, "gripper")
        reader = self._subscriptions.reader(topics.GRIPPER_STATE)
        scenes = self._subscriptions.reader(topics.PLANNING_SCENE)  # has a message when the fingers are at rest
        state = await self._bus.client(topics.GRIPPER_COMMAND).call(command, TIMEOUT)
        try:
            async with asyncio.timeout(timeout):
                while state.id == command.id and state.state in ACTIVE:
                    state = await reader.next()
                    if state.id != command.id and state.header.stamp < command.header.stamp:  # of an earlier command
                        state = state.model_copy(update={"id": command.id, "state": "active"})
        except TimeoutError:
            raise MotionFailed("timeout", f"the fingers do not come to rest within {timeout:g} s") from None
        if state.id != command.id:
            raise MotionFailed("replaced", f"another command has replaced this one: {state.id}")
        if state.state == "rejected":
            raise MotionFailed(state.error, f"the gripper rejected the command: {state.message}")
        with contextlib.suppress(TimeoutError):  # the next motion is planned with the held object
            async with asyncio.timeout(SCENE_TIMEOUT):
                scene = scenes.latest
                while scene is not None and bool(scene.attached) != state.holding:
                    scene = await scenes.next()
        return state

    async def open(self, force: float = 0.0) -> GripperState:
        """Open to the largest width."""
        return await self.move((await self._arm.description()).gripper_width, force)

    async def close(self, force: float = 0.0, **more: Any) -> GripperState:
        """Close until the fingers touch each other or an object; `holding` of the result is true for an object."""
        return await self.move(**given({"width": 0.0, "force": force}, more, own=()))
