"""Tend a machine: bring each part to the fixture, clamp it, let the machine run, and put it into the tray."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import BaseModel

from applications.pick_place.topics import DETECTION_IMAGE
from common import messages as m
from common.application import Application, ApplicationTopics
from common.process.service import main
from common.process.task_runner import run_task
from common.tasks.handling import Handling, HandlingConfig, HandlingStatus
from common.tasks.signals import Output, WaitFor
from common.tasks.stages import Move, Stage, View
from common.topics import Topic
from common.transport.bus import Bus

FIXTURE, NEAR = (0.60, 0.0), 0.03  # [m] in world; a part this close to it is in the fixture
TRAY = "tray"
STATUS = Topic("tending_status", HandlingStatus, "state", "number of parts in the tray")


class Part(BaseModel):
    """What camera and gripper do not show: how far the part outside the tray is."""

    state: Literal["raw", "machining", "machined"] = "raw"


class Tending(Handling):
    """One part at a time. The arm is at home while the machine works."""

    _part = Part()

    @property
    def memory(self) -> Part:
        """State of the part, for a restart."""
        return self._part

    def remember(self, memory: BaseModel) -> None:
        """Continue with the part."""
        assert isinstance(memory, Part)
        self._part = memory

    def choose(self, view: View) -> None:
        """Machine what is in the fixture; else bring the next part."""
        parts = view.objects("target")
        clamped = [part for part in parts if math.dist(_at(part), FIXTURE) < NEAR]
        if clamped and self._part.state != "machined":
            self.queue += self._machine()
        elif clamped or parts:
            self.bring(clamped or parts, view)
            for stage in self.queue:
                if isinstance(stage, Move):  # the arm stays out while the machine works
                    stage.requires = {"busy": False}
        elif self.inside(TRAY, view):
            self.finish(view)
        else:
            self.lack("no part is seen", view)

    def _machine(self) -> list[Stage]:
        start = [Output("clamp", True), WaitFor("clamp_closed", True, 2.0), Output("start", True),
                 WaitFor("busy", True, 2.0, name="machine starts")]
        return [*(start if self._part.state == "raw" else []), Output("start", False),
                WaitFor("busy", False, 60.0, name="machine works"), Output("clamp", False),
                WaitFor("clamp_closed", False, 2.0, name="unclamp")]

    def succeeded(self, stage: Stage, view: View) -> None:
        """Note how far the part is."""
        super().succeeded(stage, view)
        done = {"machine starts": "machining", "unclamp": "machined"}.get(stage.name)
        if stage.name == "release" and self._part.state == "machined":
            done = "raw"  # the next one
        if done:
            self._part = Part.model_validate({"state": done})

    def destination(self, thing: m.CollisionObject, view: View) -> m.Pose | None:
        """Return the pose in the fixture, or in the tray once the part is machined."""
        if self._part.state == "machined":
            return self.room_in(TRAY, thing, view)
        x, y = FIXTURE
        return m.Pose(position=m.Vector3(x=x, y=y, z=self.p.world.table_height + thing.dimensions[2] / 2))

    def note(self, view: View) -> None:
        """Count the parts in the tray."""
        if self.shown(view):
            self.status.done = len(self.inside(TRAY, view))
            self.status.total = self.status.done + len(view.objects("target"))


def _at(thing: m.CollisionObject) -> tuple[float, float]:
    return thing.pose.position.x, thing.pose.position.y


def find_misplaced(truth: m.WorldObjects) -> str:
    """Return which part is not in the tray at the end, by ground truth: for `zencell simulate` only."""
    return "; ".join(f"{part.id} is {part.state}" for part in truth.objects if part.container != TRAY)


async def run(bus: Bus, config: HandlingConfig) -> None:
    """Run the task as a service."""
    await run_task(bus, config, Tending, STATUS, View)


Config = HandlingConfig
APPLICATION = Application(
    topics=ApplicationTopics(status=STATUS, annotated=DETECTION_IMAGE), grasps=True, fills_containers=True,
    truth_check=find_misplaced,
)


if __name__ == "__main__":
    main(run, Config)
