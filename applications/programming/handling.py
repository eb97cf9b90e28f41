"""The kinds of steps that pick and place objects of the planning scene."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

from pydantic import Field

from applications.programming import steps as _listed_first  # noqa: F401 of all kinds
from applications.programming.building import RUNNING, Builder, Built, Outlook
from applications.programming.model import DOWN, BaseStep, Distance, Share, Steps, Target, Timeout
from applications.programming.targets import Array, NotSeen, StepProblem, backed, pose_goal
from common import messages as m
from common.config import Number
from common.robot.transforms import invert, matrix_to_pose, pose_to_matrix, rpy_to_matrix, tool_down, transform
from common.tasks import stages as engine
from common.tasks.handling import DROP, grasp_directions, height_of
from common.tasks.palletizing import Pattern, slot_at, slots
from common.tasks.stages import place_of

ROOM = 0.02  # [m] by which the fingers open wider than the object


class Pick(BaseStep):
    """Grasp an object of the planning scene from above: the nearest one that fits."""

    step: Literal["pick"] = "pick"
    kind: str = Field("", max_length=80, description="class of the object as its detector names it; default: any")
    role: Literal["target", "contained"] = Field("target", description="free, or in a container")
    object: str = Field("", max_length=80, description="id of the object; default: any")
    force: float = Field(0.0, ge=0, le=1e4, description="[N]; 0: that of the object or gripper")
    timeout: Timeout = Field(5.0, description="until such an object is seen [s]")
    speed: Share | None = None

    def __str__(self) -> str:
        return f"pick {self.object or self.kind or 'an object'}"

    def stages(self, at: Builder) -> Built:
        """Return its stages."""
        gripper, grasp = at.cell.require_gripper(), at.cell.grasp
        if at.before.holding:
            return self._after_grasp(at)
        thing = self._choose(at)
        yaw, width = grasp_directions(thing, gripper.closing_axis, gripper.max_width)[0]
        x, y, z = place_of(thing.pose)
        T = tool_down(x, y, grasp.height(z), yaw)
        above = backed(T, grasp.approach_clearance, "world")
        opening = gripper.max_width if width is None else min(width + ROOM, gripper.max_width)
        held = matrix_to_pose(invert(T) @ pose_to_matrix(thing.pose))
        after = Outlook(above, holding=True, object=thing.id, pose=held, width=width)
        descend = at.motion(self, "descend", pose_goal(T), straight=True)
        descend.touches = at.fingers_on([thing])
        return Built([
            engine.Grip("open", RUNNING, at.cycle, width=opening),
            at.motion(self, "pre-grasp", pose_goal(above)), descend,
            engine.Grip("close", RUNNING, at.cycle, width=0.0, holds=True, effort=self.force or thing.grip_effort,
                        mass=thing.mass, expected_width=width, width_tolerance=at.cell.width_tolerance),
            at.motion(self, "lift", pose_goal(above), straight=True, carried=after)], after)

    def _after_grasp(self, at: Builder) -> Built:
        """Return the end of a pick that was interrupted after the fingers had closed."""
        if at.repeated is None or at.before.T_world_tcp is None:
            raise StepProblem("the gripper already holds something")
        above = backed(at.before.T_world_tcp, at.cell.grasp.approach_clearance, "world")
        return at.built([at.motion(self, "lift", pose_goal(above), straight=True)], above)

    def _choose(self, at: Builder) -> m.CollisionObject:
        """Return the fitting object nearest to the tool; of two that are equally near the higher one."""
        fitting = [each for each in at.view.objects(self.role)
                   if self.kind in ("", each.kind) and self.object in ("", each.id)
                   and not any(slot_at(pattern, place_of(each.pose)) for pattern in at.patterns)]
        if not fitting:
            seen = sorted({each.kind or each.id for each in at.view.objects(self.role)})
            what = self.object or self.kind or "object"
            raise NotSeen(f"no {what} with role {self.role} is seen; seen: {', '.join(seen) or 'nothing'}")
        start = at.before.T_world_tcp
        place = (0.0, 0.0) if start is None else (float(start[0, 3]), float(start[1, 3]))
        return min(fitting, key=lambda each: (round(math.dist(place_of(each.pose)[:2], place), 3), -height_of(each)))


class Place(BaseStep):
    """Move above a target, straight to it, open the fingers, and move back."""

    step: Literal["place"] = "place"
    at: Target = Field(description="of the tool centre point at the release")
    distance: Distance = 0.1
    speed: Share | None = None

    def __str__(self) -> str:
        return f"place at {self.at}"

    def stages(self, at: Builder) -> Built:
        """Return its stages."""
        return placed(self, at, self.distance, at.resolve(self.at)[1])


class Palletize(BaseStep):
    """For each place of a pattern on a pallet: do `steps`, which bring an item into the gripper, and place it there."""

    BODIES: ClassVar[tuple[str, ...]] = ("steps",)

    step: Literal["palletize"] = "palletize"
    pattern: Pattern = Field(examples=[{"item": [0.05, 0.05, 0.05], "columns": 2}])
    height: Number = Field(0.0, description="of the tool centre point above the centre of an item at the release; not "
                                            "for an item that was picked by sight [m]")
    distance: Distance = 0.1
    speed: Share | None = None
    steps: Steps

    def __str__(self) -> str:
        return f"palletize {self.pattern.columns} x {self.pattern.rows} x {self.pattern.layers}"

    @property
    def places(self) -> int:
        """Number of places on the pallet."""
        return len(slots(self.pattern))

    def placing(self, number: int) -> PlaceOnPallet:
        """Return the step that places an item at a place of the pallet, counted from 0."""
        return PlaceOnPallet(
            id=self.id, on_failure=self.on_failure, distance=self.distance, speed=self.speed, height=self.height,
            slot=slots(self.pattern)[number].pose)


class PlaceOnPallet(BaseStep):
    """Place the held item with its centre at a pose in world; in files as a part of `palletize` only."""

    step: Literal["place"] = "place"
    slot: m.Pose
    height: float  # as of Palletize
    distance: float
    speed: float | None

    def stages(self, at: Builder) -> Built:
        """Return its stages."""
        T_slot = pose_to_matrix(self.slot)
        held = at.before.pose or next(
            (each.object.pose for each in (at.view.scene.attached if at.view.scene else [])), None)
        if held is not None:
            turns = [T_slot @ transform(rpy_to_matrix(0, 0, turn), (0, 0, 0)) @ invert(pose_to_matrix(held))
                     for turn in (0.0, math.pi)]
            T = min(turns, key=lambda T: -T[0, 0])  # the tool turns less
        else:
            yaw = math.remainder(math.atan2(T_slot[1, 0], T_slot[0, 0]), math.pi)
            T = transform(rpy_to_matrix(DOWN[0], DOWN[1], yaw), T_slot[:3, 3] + (0.0, 0.0, self.height))
        return placed(self, at, self.distance, backed(T, DROP, "world"))


def placed(step: BaseStep, at: Builder, distance: float, T: Array) -> Built:
    """Return the stages that release what is held at a pose (4, 4) of the tool, from a distance above it [m]."""
    gripper, before = at.cell.require_gripper(), at.before
    above = backed(T, distance, "world")
    width = gripper.max_width if before.width is None else min(before.width + ROOM, gripper.max_width)
    after = Outlook(above, holding=False, width=width)
    leave = at.motion(step, "leave", pose_goal(above), straight=True, carried=after)
    leave.touches = at.fingers_on(at.near(T)) + [(link, before.object) for link in gripper.links if before.object]
    if not before.holding:
        if at.repeated is None or at.repeated.reached not in ("lower", "release"):
            raise StepProblem("the gripper holds nothing to place")
        return Built([leave], after)  # it was interrupted after the fingers had opened
    lower = at.motion(step, "lower", pose_goal(T), straight=True)
    if before.object:
        lower.touches = [(before.object, each.id) for each in at.near(T)]
    return Built([at.motion(step, "across", pose_goal(above)), lower,
                  engine.Grip("release", RUNNING, at.cycle, width=width, holds=False, carries=True), leave], after)
