"""Stacks cubes: each is put on the highest that is seen, until enough stand upon each other."""

from __future__ import annotations

import math

from pydantic import Field

from applications.pick_place.topics import DETECTION_IMAGE
from common import messages as m
from common.application import Application, ApplicationTopics
from common.config import Tunable
from common.process.service import main
from common.process.task_runner import run_task
from common.tasks.handling import Handling, HandlingConfig, HandlingStatus, height_of, top_of
from common.tasks.stages import View
from common.topics import Topic
from common.transport.bus import Bus

HIGH = 3  # cubes


class StackStatus(HandlingStatus):
    """What every task says; `done` is how many cubes the highest stack has."""


STATUS = Topic("stack_cubes_status", StackStatus, "state", "how many cubes stand upon each other")


class Config(HandlingConfig):
    """How high the stack is to be."""

    cubes: Tunable[int] = Field(HIGH, ge=2, le=4, description="that are to stand upon each other")


class StackCubes(Handling):
    """Decides by what is seen alone, so it goes on where it was when it was started again."""

    p: Config

    def choose(self, view: View) -> None:
        """The nearest cube beside the stack, until that is high enough."""
        stack = self._stack(view)
        if stack is None:
            self.lack("no cube is seen", view)
        elif self._cubes_to(stack) >= self.p.cubes:
            self.finish(view, height_mm=round(1e3 * (top_of(stack) - self.p.world.table_height), 1))
        elif others := [cube for cube in view.objects("target") if cube is not stack]:
            self.bring(sorted(others, key=lambda cube: _away(cube, stack)), view)
        else:
            self.lack(f"{self._cubes_to(stack)} cubes stand upon each other, and no other is seen", view)

    def destination(self, thing: m.CollisionObject, view: View) -> m.Pose | None:
        """On top of the stack; aside while none is known, to be seen from home."""
        stack = self._stack(view)
        return self.on_top(thing, stack) if stack is not None and stack.id != thing.id else None

    def note(self, view: View) -> None:
        """Count what a picture shows in which nothing is under way."""
        stack = self._stack(view)
        self.status.total = self.p.cubes
        if stack is not None and self.shown(view):
            self.status.done = min(self._cubes_to(stack), self.p.cubes)

    def _stack(self, view: View) -> m.CollisionObject | None:
        """The top cube of the highest stack, or of those the nearest to the robot; None while none is seen."""
        return max(view.objects("target"), default=None, key=lambda cube: (
            self._cubes_to(cube), -math.hypot(cube.pose.position.x, cube.pose.position.y)))

    def _cubes_to(self, cube: m.CollisionObject) -> int:
        """How many cubes there are from the table to the top of one."""
        return round((top_of(cube) - self.p.world.table_height) / height_of(cube))


def _away(a: m.CollisionObject | m.WorldObject, b: m.CollisionObject | m.WorldObject) -> float:
    return math.dist((a.pose.position.x, a.pose.position.y), (b.pose.position.x, b.pose.position.y))


def find_misplaced(truth: m.WorldObjects) -> str:
    """What does not stand in the end, by truth: `zencell simulate` asks, nothing that decides does."""
    cubes = sorted(truth.objects, key=lambda cube: cube.pose.position.z)
    for number, cube in enumerate(cubes[:HIGH]):
        off, low = _away(cube, cubes[0]), abs(cube.pose.position.z - (number + 0.5) * cube.size.z)
        if cube.state != "table" or off > cube.size.x / 4 or low > 1e-3:
            return f"{cube.id} is not number {number + 1} of a stack from below"
    return "" if len(cubes) >= HIGH else f"there are {len(cubes)} cubes, {HIGH} are to stand"


async def run(bus: Bus, config: Config) -> None:
    """Be the service of the task."""
    await run_task(bus, config, StackCubes, STATUS, View)


APPLICATION = Application(
    topics=ApplicationTopics(status=STATUS, annotated=DETECTION_IMAGE),
    grasps=True,  # it holds objects with the gripper
    truth_check=find_misplaced,
)


if __name__ == "__main__":
    main(run, Config)
