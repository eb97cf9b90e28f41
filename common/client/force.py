"""Force motions of the arm, for a program: until contact, compliant, insertion. See docs/force.md."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal

import numpy as np

from common import topics
from common.client.arguments import given, listed
from common.client.arm_state import ArmState
from common.client.goals import number, numbers
from common.client.operator_motion import PROGRESS_TIMEOUT, MotionFailed, OperatorMotion
from common.config import check
from common.errors import ConfigError, UnknownName
from common.messages import ExecuteRequest, ForceMotion, JointTrajectory, MotionStatus, PoseGoal
from common.robot.transforms import matrix_to_pose
from common.tasks.force import OVERSHOOT

Direction = tuple[float, float, float]
Frame = Literal["tool", "world"]

DOWN = (0.0, 0.0, -1.0)


class ForceArm(ArmState):
    """The force motions of an arm. Each plans its straight line first and is refused where anything obstructs it.

    `touch` names what may be touched: ids of the planning scene, by the fingers and by what they hold. The robot file
    limits force and torque; `force_limit` and `torque_limit` only lower these limits. The arm comes to rest when the
    program ends.
    """

    _motion: OperatorMotion

    async def move_until(
        self, force: float, *, direction: Direction = DOWN, frame: Frame = "world", max_distance: float = 0.05,
        speed: float = 0.01, touch: Iterable[str] = (), **more: Any,
    ) -> MotionStatus:
        """Move along a direction until the tool presses with a force; `distance` and `force` of the result say where.

        Args:
            force: [N].
            direction: of any length.
            frame: whose axes it refers to.
            max_distance: [m]; without contact until there the motion fails with code `no_contact`.
            speed: [m/s].
            touch: what may be touched.
            more: other fields of a `ForceMotion`: force_limit [N], torque_limit [N m], timeout [s], zero (first
                takes the wrench at rest as zero).

        Raises:
            ConfigError, UnknownName: invalid values.
            MotionFailed: not possible, or not successful: `no_contact`, `force_limit`, `no_wrench`, `collision`, ...
            RequestFailed: planner or executor do not answer.
        """
        return await self._by_force(
            "until", touch, direction, more, force=force, frame=frame, max_distance=max_distance, speed=speed)

    async def comply(
        self, timeout: float, *, force: float = 0.0, direction: Direction = DOWN, frame: Frame = "world",
        max_distance: float = 0.05, touch: Iterable[str] = (), **more: Any,
    ) -> MotionStatus:
        """Yield to the force at the tool for a while, pressing with `force` along the direction.

        Args:
            timeout: how long [s, cell time].
            force: [N].
            direction: of any length; the tool stays between its start and max_distance along it.
            frame: whose axes it refers to.
            max_distance: [m].
            touch: what may be touched.
            more: other fields of a `ForceMotion`: radius [m], angle [rad], along, across, turn, damping [N s/m], ...

        Raises:
            As `move_until`.
        """
        return await self._by_force(
            "comply", touch, direction, more, timeout=timeout, force=force, frame=frame, max_distance=max_distance)

    async def insert(
        self, depth: float, *, force: float = 12.0, direction: Direction = DOWN, frame: Frame = "world",
        max_distance: float | None = None, touch: Iterable[str] = (), **more: Any,
    ) -> MotionStatus:
        """Press the held part, search its hole on a spiral, and push it in; fails with code `not_inserted`.

        Args:
            depth: below the first contact [m].
            force: [N].
            direction: of any length.
            frame: whose axes it refers to.
            max_distance: from the start [m]; default: the depth and 20 mm.
            touch: what may be touched.
            more: other fields of a `ForceMotion`: tip [m], radius [m], pitch [m], tilt [rad], timeout [s], ...

        Raises:
            As `move_until`.
        """
        if max_distance is None:
            # Within the bounds of its field, so that an error names the depth.
            max_distance = float(np.clip(number("depth", depth) + 0.02, 0.02, 0.3))
        return await self._by_force(
            "insert", touch, direction, more, depth=depth, force=force, frame=frame, max_distance=max_distance)

    async def _by_force(
        self, kind: str, touch: Iterable[str], direction: Direction, more: Mapping[str, Any], **fields: Any
    ) -> MotionStatus:
        """Plan the line, send the request, and repeat it until the motion has ended."""
        d = numbers("direction", direction)
        if not np.linalg.norm(d) > 0.0:
            raise ConfigError("direction", direction, "must not be 0")
        d = d / np.linalg.norm(d)
        names = listed("touch", touch)
        fields = given({"kind": kind, "direction": dict(zip("xyz", d.tolist(), strict=True)), **fields}, more,
                       own=ExecuteRequest.model_fields)
        nothing = JointTrajectory(joint_names=["none"], points=[])
        checked = check(ForceMotion, {"id": kind, "trajectory": nothing, **fields}, kind)
        before = await self._motion.require_free()
        T = await self.pose()
        T[:3, 3] += (d if checked.frame != "tool" else T[:3, :3] @ d) * (checked.max_distance + OVERSHOOT)
        response = await self._motion.plan(
            PoseGoal(pose=matrix_to_pose(T)), straight=True, allowed_collisions=await self._touching(names))
        if not response.ok or response.trajectory is None:
            raise MotionFailed(response.error, response.message)
        return await self._motion.follow(
            response.trajectory, plan=response, acknowledged=before.newest, force=fields,
            timeout=checked.timeout + PROGRESS_TIMEOUT)

    async def _touching(self, names: list[str]) -> list[tuple[str, str]]:
        """Return the pairs that may touch.

        Raises:
            UnknownName: a name is not in the planning scene.
        """
        scene = await self._subscriptions.query(topics.PLANNING_SCENE)
        known = [each.id for each in scene.objects]
        for name in names:
            if name not in known:
                raise UnknownName("object to touch", str(name), known)
        tools = [*(await self.description()).fingers, *(held.object.id for held in scene.attached)]
        return [(tool, name) for tool in tools for name in names]
