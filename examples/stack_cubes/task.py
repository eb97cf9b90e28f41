"""Stack cubes: put each on the highest one until the stack is complete."""

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

HEIGHT = 3  # cubes


class StackStatus(HandlingStatus):
    """Status of the task; `done` is the number of cubes in the highest stack."""


STATUS = Topic("stack_cubes_status", StackStatus, "state", "number of cubes in the stack")


class Config(HandlingConfig):
    """Parameters: the height of the stack."""

    cubes: Tunable[int] = Field(HEIGHT, ge=2, le=4, description="number of cubes in a complete stack")


class StackCubes(Handling):
    """Decides only by what is seen, so it continues after a restart."""

    p: Config

    def choose(self, view: View) -> None:
        """Bring the nearest other cube until the stack is high enough."""
        stack = self._stack(view)
        if stack is None:
            self.lack("no cube is seen", view)
        elif self._cubes_to(stack) >= self.p.cubes:
            self.finish(view, height_mm=round(1e3 * (top_of(stack) - self.p.world.table_height), 1))
        elif others := [cube for cube in view.objects("target") if cube is not stack]:
            self.bring(sorted(others, key=lambda cube: _away(cube, stack)), view)
        else:
            self.lack(f"{self._cubes_to(stack)} cubes are stacked, and no other is seen", view)

    def destination(self, thing: m.CollisionObject, view: View) -> m.Pose | None:
        """Return the pose on top of the stack; None while none is known: put the cube aside first."""
        stack = self._stack(view)
        return self.on_top(thing, stack) if stack is not None and stack.id != thing.id else None

    def note(self, view: View) -> None:
        """Count the cubes in an image taken while nothing moves."""
        stack = self._stack(view)
        self.status.total = self.p.cubes
        if stack is not None and self.shown(view):
            self.status.done = min(self._cubes_to(stack), self.p.cubes)

    def _stack(self, view: View) -> m.CollisionObject | None:
        """Return the top cube of the highest stack, the nearest one of several; None while none is seen."""
        return max(view.objects("target"), default=None, key=lambda cube: (
            self._cubes_to(cube), -math.hypot(cube.pose.position.x, cube.pose.position.y)))

    def _cubes_to(self, cube: m.CollisionObject) -> int:
        """Return the number of cubes from the table to the top of one."""
        return round((top_of(cube) - self.p.world.table_height) / height_of(cube))


def _away(a: m.CollisionObject | m.WorldObject, b: m.CollisionObject | m.WorldObject) -> float:
    return math.dist((a.pose.position.x, a.pose.position.y), (b.pose.position.x, b.pose.position.y))


def find_misplaced(truth: m.WorldObjects) -> str:
    """Return what is wrong with the stack at the end, by ground truth: for `zencell simulate` only."""
    cubes = sorted(truth.objects, key=lambda cube: cube.pose.position.z)
    for number, cube in enumerate(cubes[:HEIGHT]):
        off, low = _away(cube, cubes[0]), abs(cube.pose.position.z - (number + 0.5) * cube.size.z)
        if cube.state != "table" or off > cube.size.x / 4 or low > 1e-3:
            return f"{cube.id} is not number {number + 1} of a stack from below"
    return "" if len(cubes) >= HEIGHT else f"there are {len(cubes)} of {HEIGHT} cubes"


async def run(bus: Bus, config: Config) -> None:
    """Run the task as a service."""
    await run_task(bus, config, StackCubes, STATUS, View)


APPLICATION = Application(
    topics=ApplicationTopics(status=STATUS, annotated=DETECTION_IMAGE),
    grasps=True,  # it holds objects with the gripper
    truth_check=find_misplaced,
)


if __name__ == "__main__":
    main(run, Config)
