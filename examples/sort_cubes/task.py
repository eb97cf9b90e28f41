"""Sort cubes into boxes: each goes into the box named after its color."""

from __future__ import annotations

import math

from applications.pick_place.topics import DETECTION_IMAGE
from common import messages as m
from common.application import Application, ApplicationTopics
from common.process.service import main
from common.process.task_runner import run_task
from common.tasks.handling import Handling, HandlingConfig, HandlingStatus
from common.tasks.stages import View
from common.topics import Topic
from common.transport.bus import Bus


class SortStatus(HandlingStatus):
    """Status of the task; `done` counts the cubes seen in their own box."""


STATUS = Topic("sort_cubes_status", SortStatus, "state", "number of cubes in the box of their color")


class Config(HandlingConfig):
    """Parameters; nothing besides those of every task that moves objects."""


class SortCubes(Handling):
    """Decides only by what is seen, so it continues after a restart."""

    def choose(self, view: View) -> None:
        """Bring the nearest cube that is not in its box; finish without any."""
        left = [cube for cube in self._cubes(view) if self.container_of(cube) != cube.kind]
        if left:
            self.bring(sorted(left, key=lambda cube: math.hypot(cube.pose.position.x, cube.pose.position.y)), view)
        elif not self.status.done:
            self.lack("no cube is seen", view)
        else:
            self.finish(view, **{kind: len(self.inside(kind, view)) for kind in self.p.world.containers})

    def destination(self, thing: m.CollisionObject, view: View) -> m.Pose:
        """Return the pose above the box of its color with most room."""
        return self.room_in(thing.kind, thing, view)

    def note(self, view: View) -> None:
        """Count the cubes in an image taken while nothing moves."""
        if self.shown(view):
            cubes = self._cubes(view)
            self.status.total = len(cubes)
            self.status.done = sum(self.container_of(cube) == cube.kind for cube in cubes)

    def _cubes(self, view: View) -> list[m.CollisionObject]:
        """Cubes that have a box."""
        seen = [*view.objects("target"), *view.objects("contained")]
        return [thing for thing in seen if thing.kind in self.p.world.containers]


def find_misplaced(truth: m.WorldObjects) -> str:
    """Return which cubes are misplaced at the end, by ground truth: for `zencell simulate` only."""
    misplaced = [cube.id for cube in truth.objects
                 if cube.container != ("red" if cube.color.r > cube.color.g else "green")]
    return f"not in their own box: {', '.join(misplaced)}" if misplaced else ""


async def run(bus: Bus, config: Config) -> None:
    """Run the task as a service."""
    await run_task(bus, config, SortCubes, STATUS, View)


APPLICATION = Application(
    topics=ApplicationTopics(status=STATUS, annotated=DETECTION_IMAGE),
    grasps=True,  # it holds objects with the gripper
    fills_containers=True,  # and what it has done lies in containers
    truth_check=find_misplaced,
)


if __name__ == "__main__":
    main(run, Config)
