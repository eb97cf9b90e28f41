"""Tend a machine: bring each part to the fixture, clamp it, let the machine run, and put it onto the pallet.

What is done already is decided by what the camera sees; only how far the part in the fixture is must be remembered.
"""

from __future__ import annotations

import math
from typing import Literal

from pydantic import BaseModel, Field

from common import messages as m
from common.config import Tunable
from common.config.basics import Coordinate
from common.tasks.handling import Handling, HandlingConfig
from common.tasks.palletizing import Pattern, filled, free_slots, slot_at
from common.tasks.signals import Output, WaitFor
from common.tasks.stages import Cycle, Grip, Move, Stage, View, place_of

NEAR = 0.03  # [m] a part this close to the fixture's center is in it
CLAMPINGS = 2  # attempts to close the clamp
PALLET = Pattern(item=(0.05, 0.04, 0.03), columns=2, layers=2, gap=(0.045, 0.045), position=(0.45, 0.25, 0.0),
                 yaw=math.pi / 2)


class Config(HandlingConfig):
    """Places of fixture and pallet, and time limits."""

    fixture: tuple[Coordinate, Coordinate] = Field((0.60, 0.0), description="center of a clamped part [m]")
    pallet: Pattern = Field(PALLET, description="pattern of the machined parts")
    clamp_timeout: Tunable[float] = Field(2.0, gt=0, le=60, description="until the clamp has opened or closed [s]")
    machine_timeout: Tunable[float] = Field(60.0, gt=0, le=86_400, description="until the machine has finished [s]")


class Part(BaseModel):
    """What camera and gripper do not show: how far the part is that is neither in the tray nor on the pallet."""

    state: Literal["raw", "machining", "machined"] = "raw"


class Tending(Handling):
    """One part at a time. The arm is at home while the machine works."""

    p: Config
    _part = Part()
    _clampings = 0

    @property
    def memory(self) -> Part:
        """State of the part, for a restart."""
        return self._part

    def remember(self, memory: BaseModel) -> None:
        """Continue with the part."""
        assert isinstance(memory, Part)
        self._part = memory

    def choose(self, view: View) -> None:
        """Machine what is in the fixture, clear the fixture, or bring the next part."""
        parts = view.objects("target")
        in_fixture = [part for part in parts if math.dist(place_of(part.pose)[:2], self.p.fixture) < NEAR]
        stored = [part for part in parts if slot_at(self.p.pallet, place_of(part.pose)) is not None]
        raw = [part for part in parts if part not in in_fixture and part not in stored]
        if in_fixture and self._part.state != "machined":
            self.queue += self._machine(in_fixture[0].id)
        elif self._part.state != "raw" and not in_fixture:
            self._lost()
        elif in_fixture or raw:
            if not free_slots(self.p.pallet, (place_of(part.pose) for part in stored)):
                self.lack("the pallet is full", view)
                return
            self.bring(in_fixture or raw, view)
            for stage in self.queue:
                if isinstance(stage, Move):  # the arm stays out while the machine works or the clamp is closed
                    stage.requires = {"busy": False, "clamp_closed": False}
        elif stored:
            self.finish(view)
        else:
            self.lack("no part is seen", view)

    def _machine(self, part: str) -> list[Stage]:
        cycle, limit = Cycle(part), self.p.clamp_timeout
        start = [Output("clamp", True, state="MACHINING", cycle=cycle),
                 WaitFor("clamp_closed", True, limit, name="clamp", cycle=cycle), Output("start", True, cycle=cycle),
                 WaitFor("busy", True, limit, name="machine starts", cycle=cycle)]
        return [*(start if self._part.state == "raw" else []), Output("start", False, state="MACHINING", cycle=cycle),
                WaitFor("busy", False, self.p.machine_timeout, name="machine works", cycle=cycle),
                Output("clamp", False, cycle=cycle),
                WaitFor("clamp_closed", False, limit, name="unclamp", cycle=cycle)]

    def _lost(self) -> None:
        """Ask for the operator: what was in the fixture or in the gripper may lie among the raw parts now."""
        self.end("ERROR", f"the part that was {self._part.state} is not in the fixture any more: put it onto the "
                          "pallet or away, then start the task")

    def on_restart(self) -> None:
        """Continue after the operator has found a lost part, freed the clamp or started the machine."""
        super().on_restart()
        self._clampings = 0
        if self.status.message.startswith("the part that was"):
            self._part = Part()

    def signal_failed(self, stage: Stage, view: View, problem: str) -> None:
        """Clamp once again; else end with ERROR. The arm stays where it is, out of the machine."""
        if stage.name == "clamp" and self._clampings + 1 < CLAMPINGS:
            self._clampings += 1
            self.status.retries += 1
            self.clear()
            self.queue += [Output("clamp", False), WaitFor("clamp_closed", False, self.p.clamp_timeout, name="unclamp "
                           "again"), *self._machine(stage.cycle.subject if stage.cycle else "")]
            return
        self.end("ERROR", f"{stage.name}: {problem}; see to it, then start the task")

    def succeeded(self, stage: Stage, view: View) -> None:
        """Note how far the part is."""
        super().succeeded(stage, view)
        if stage.name == "machine starts":
            self._part, self._clampings = Part(state="machining"), 0
        elif stage.name == "unclamp":
            self._part = Part(state="machined")
        elif isinstance(stage, Grip) and stage.name == "release" and self._part.state == "machined" and (
                slot_at(self.p.pallet, view.tool) is not None):
            self._part = Part()

    def destination(self, thing: m.CollisionObject, view: View) -> m.Pose | None:
        """Return the pose in the fixture, or in the next free slot once the part is machined."""
        if self._part.state == "machined":
            free = free_slots(self.p.pallet, (place_of(part.pose) for part in view.objects("target")))
            return free[0].pose if free else None
        x, y = self.p.fixture
        return m.Pose(position=m.Vector3(x=x, y=y, z=self.p.world.table_height + thing.dimensions[2] / 2))

    def note(self, view: View) -> None:
        """Count the parts on the pallet, also those below others."""
        if self.shown(view):
            places = [place_of(part.pose) for part in view.objects("target")]
            self.status.done = len(filled(self.p.pallet, places))
            self.status.total = self.status.done + sum(slot_at(self.p.pallet, place) is None for place in places)
