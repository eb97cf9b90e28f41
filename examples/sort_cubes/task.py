"""Sorts cubes into boxes: each goes into the box that is called as its colour is."""

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
    """What every task says; `done` are the cubes that are seen in their own box."""


STATUS = Topic("sort_cubes_status", SortStatus, "state", "how many cubes are in the box of their colour")


class Config(HandlingConfig):
    """All that there is to set is what every task has that brings objects somewhere."""


class SortCubes(Handling):
    """Decides by what is seen alone, so it goes on where it was when it was started again."""

    def choose(self, view: View) -> None:
        """The nearest cube that is not in its box, until there is none."""
        left = [cube for cube in self._cubes(view) if self.container_of(cube) != cube.kind]
        if left:
            self.bring(sorted(left, key=lambda cube: math.hypot(cube.pose.position.x, cube.pose.position.y)), view)
        elif not self.status.done:
            self.lack("no cube is seen", view)
        else:
            self.finish(view, **{kind: len(self.inside(kind, view)) for kind in self.p.world.containers})

    def destination(self, thing: m.CollisionObject, view: View) -> m.Pose:
        """Above the box of its colour, where there is most room."""
        return self.room_in(thing.kind, thing, view)

    def note(self, view: View) -> None:
        """Count what a picture shows in which nothing is under way."""
        if self.shown(view):
            cubes = self._cubes(view)
            self.status.total = len(cubes)
            self.status.done = sum(self.container_of(cube) == cube.kind for cube in cubes)

    def _cubes(self, view: View) -> list[m.CollisionObject]:
        """What there is a box for."""
        seen = [*view.objects("target"), *view.objects("contained")]
        return [thing for thing in seen if thing.kind in self.p.world.containers]


def find_misplaced(truth: m.WorldObjects) -> str:
    """What is not where it belongs in the end, by truth: `zencell simulate` asks, nothing that decides does."""
    lost = [cube.id for cube in truth.objects if cube.container != ("red" if cube.color.r > cube.color.g else "green")]
    return f"not in their own box: {', '.join(lost)}" if lost else ""


async def run(bus: Bus, config: Config) -> None:
    """Be the service of the task."""
    await run_task(bus, config, SortCubes, STATUS, View)


APPLICATION = Application(
    topics=ApplicationTopics(status=STATUS, annotated=DETECTION_IMAGE),
    grasps=True,  # it holds objects with the gripper
    fills_containers=True,  # and what it has done lies in containers
    truth_check=find_misplaced,
)


if __name__ == "__main__":
    main(run, Config)
