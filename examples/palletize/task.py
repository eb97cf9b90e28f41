"""Palletize boxes: four columns, each of one color, a large box below and a small one on top."""

from __future__ import annotations

from applications.pick_place.topics import DETECTION_IMAGE
from common import messages as m
from common.application import Application, ApplicationTopics
from common.process.service import main
from common.process.task_runner import run_task
from common.tasks.handling import Handling, HandlingConfig, HandlingStatus
from common.tasks.palletizing import Pattern, filled, slot_at, slots
from common.tasks.stages import View, place_of
from common.topics import Topic
from common.transport.bus import Bus

COLUMNS = ("red", "green", "blue", "red")  # in the order of the slots
LAYERS = {size: Pattern(item=(side, side, side), columns=2, rows=2, pitch=(0.11, 0.11), position=(0.5, 0.25, bottom))
          for size, side, bottom in (("large", 0.05, 0.0), ("small", 0.04, 0.05))}
STATUS = Topic("palletize_status", HandlingStatus, "state", "number of boxes on the pallet")
Config = HandlingConfig


class Palletize(Handling):
    """Decides only by what is seen, so it continues after a restart."""

    def choose(self, view: View) -> None:
        """Bring a box that is missing in the lowest incomplete layer."""
        missing = self._missing(view)
        wanted = {kind for kind, _ in missing}
        loose = [box for box in view.objects("target") if box.kind in wanted
                 and not any(slot_at(layer, place_of(box.pose)) for layer in LAYERS.values())]
        if not missing:
            self.finish(view)
        elif loose:
            self.bring(loose, view)
        else:
            self.lack(f"no {missing[0][0]} is seen", view)

    def destination(self, thing: m.CollisionObject, view: View) -> m.Pose | None:
        """Return the first slot for a box of this kind."""
        return next((pose for kind, pose in self._missing(view) if kind == thing.kind), None)

    def note(self, view: View) -> None:
        """Count the boxes on the pallet."""
        if self.shown(view):
            self.status.total, self.status.done = 8, sum(len(taken) for taken in self._taken(view).values())

    def _taken(self, view: View) -> dict[str, set[int]]:
        """Return filled slots by layer; a small box hides the large one below it."""
        taken = {size: filled(layer, (place_of(box.pose) for box in view.objects("target")))
                 for size, layer in LAYERS.items()}
        return {"large": taken["large"] | taken["small"], "small": taken["small"]}

    def _missing(self, view: View) -> list[tuple[str, m.Pose]]:
        """Return kind and pose of what the lowest incomplete layer lacks."""
        found = [[(f"{color}_{size}", slot.pose) for slot, color in zip(slots(LAYERS[size]), COLUMNS, strict=True)
                  if slot.index not in taken] for size, taken in self._taken(view).items()]
        return found[0] or found[1]


def find_misplaced(truth: m.WorldObjects) -> str:
    """Return which boxes are not in a slot of their kind, by ground truth: for `zencell simulate` only."""
    right = {(size, slot.index): f"{color}_{size}" for size, layer in LAYERS.items()
             for slot, color in zip(slots(layer), COLUMNS, strict=True)}
    found = {box.id: next(((size, slot.index) for size, layer in LAYERS.items()
                           if (slot := slot_at(layer, place_of(box.pose)))), None) for box in truth.objects}
    return ", ".join(name for name, at in found.items() if at is None or not name.startswith(right[at]))


async def run(bus: Bus, config: HandlingConfig) -> None:
    """Run the task as a service."""
    await run_task(bus, config, Palletize, STATUS, View)


APPLICATION = Application(topics=ApplicationTopics(status=STATUS, annotated=DETECTION_IMAGE), grasps=True,
                          truth_check=find_misplaced)

if __name__ == "__main__":
    main(run, Config)
