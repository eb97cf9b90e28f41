"""The gripper of a cell, for a program."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

from common import topics
from common.client.arm import TIMEOUT, Arm
from common.client.operator_motion import MotionFailed
from common.client.subscriptions import Part, Subscriptions
from common.config import check
from common.messages import GripperCommand, GripperState
from common.time_source import new_id

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
        return await self.move(0.0, force, **more)
