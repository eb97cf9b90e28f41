"""The sorting task: take the objects of a tray, one after the other, into the containers that a rule names.

What is decided follows from heap, planning scene and gripper; `common/tasks/engine.py` does the rest. The next grasp is
chosen while the arm is above a container, where it hides nothing of the tray.
"""

from __future__ import annotations

import math

from applications.sorting import motions
from applications.sorting.holding import Holding
from applications.sorting.motions import Pick
from applications.sorting.placing import Full
from applications.sorting.rules import NoDestination
from applications.sorting.scene import FOREIGN
from applications.sorting.settings import SortingView
from applications.sorting.steady import SAME, steady
from applications.sorting.topics import Heap, SeenObject
from common import messages as m
from common.robot.home import is_home
from common.tasks.stages import AwaitImage, Grip, Move, Stage, place_of

MOST_HIDDEN = 0.4  # fraction of the tray without depth from which on it cannot be called empty
STILL = 0.01  # [m] that an object at rest may seem to move between two images
NO_MOTION = ("no_ik", "collision")  # errors of a goal itself; a planner without an answer says nothing about it


class Sorting(Holding):
    """Clears a tray."""

    def decide(self, view: SortingView) -> None:
        """Carry what is held, take the next object, stir, or end."""
        if self.status.state == "DONE":
            return
        if view.holding:
            if view.attached:  # else the planning scene is not up to date yet
                self._place_held(view)
        elif self._memory.thing is not None:
            self._find_lost(view)
        elif not self._refresh(view) or self._memory.doubt:  # an image from home shows what is in the container
            self._look(view)
        elif not self._queue_pick(view) and len(self._recent) > 1:  # one image does not show what is at rest
            self._nothing_to_take(view)

    def decide_ahead(self, running: Stage, view: SortingView) -> None:
        """Choose the next object while one is carried above its container."""
        cycle = running.cycle
        if running.name not in ("carry", "across", "release") or not isinstance(cycle, Pick) or not cycle.checked:
            return
        if not (any(isinstance(stage, Move | AwaitImage) for stage in self.queue) or cycle.back or self._memory.doubt):
            self._queue_pick(view)

    def _is_at_rest(self, thing: SeenObject, heap: Heap, within: float = STILL) -> bool:
        """Return whether an earlier image shows the object, too: what still falls or rolls is not gripped."""
        here = (thing.center.x, thing.center.y, thing.top)
        return any(math.dist((other.center.x, other.center.y, other.top), here) < within
                   for each in self._recent if each is not heap for other in each.objects)

    def _queue_pick(self, view: SortingView) -> bool:
        """Queue the approach of the best grasps; return whether there is one."""
        if not self._refresh(view) or self._heap is None:
            return False
        heap = self._heap
        options = self._choice.options(heap, view.now, self.p.penalty, self.p.most_tries)
        options = [option for option in options if self._is_at_rest(option.thing, heap)]
        if not options:
            return False
        before = [thing for thing in self._choice.left(heap) if self._is_at_rest(thing, heap, SAME)]
        cycle = Pick(options[0].thing.id, options=options, before=before)
        self.queue.append(motions.approach(cycle))
        self.wait_timer.reset()
        self.status.message = self.status.overlooked = ""
        return True

    def planned(self, move: Move, response: m.PlanResponse) -> None:
        """Queue what follows the approach of the selected grasp."""
        cycle = move.cycle
        if move.name != "approach" or not response.ok or not isinstance(cycle, Pick) or cycle.chosen is not None:
            return
        cycle.chosen = cycle.options[min(response.goal_index, len(cycle.options) - 1)]
        cycle.subject = cycle.chosen.thing.id

    def _follow_up(self, view: SortingView) -> None:
        """Queue opening, descent, grasp and carrying of the selected grasp."""
        for stage in list(self.queue):
            cycle = stage.cycle
            if not isinstance(cycle, Pick) or stage.name != "approach" or cycle.chosen is None:
                continue
            assert isinstance(stage, Move)
            if stage.trajectory is None or any(each.name == "descend" and each.cycle is cycle for each in self.queue):
                return
            cycle.inside = self._inside(cycle.chosen.container)
            try:
                cycle.spot = self._spot(cycle.chosen.thing, cycle.chosen.container, self._below(cycle))
            except Full as full:
                self._choice.penalize(cycle.chosen.grasp, view.now, str(full))
                self._drop_cycle(cycle)
                return
            at = self.queue.index(stage)
            following = motions.take(cycle, self.gripper, view)
            for offset, later in enumerate(following, 1):
                self.queue.insert(at + offset, later)
            opening = min(cycle.chosen.grasp.opening, self.gripper.max_width)
            assert view.gripper is not None
            if view.holding or abs(view.gripper.width - opening) > motions.WIDTH_OFF:
                self.queue.insert(at, Grip("open", "GRASPING", cycle, width=opening))
                stage.planned_width = opening  # the fingers move far above the objects
            return

    def plan_failed(self, move: Move, response: m.PlanResponse, view: SortingView) -> None:
        """Avoid grasps without a plan for a while; look for another spot for what is held."""
        cycle = move.cycle
        if not isinstance(cycle, Pick) or cycle.gripped:
            self._skipped += move.carries
            super().plan_failed(move, response, view)
            return
        if response.error.startswith("start_") or not (response.attempts or response.error in NO_MOTION):
            super().plan_failed(move, response, view)
            return
        for one in [cycle.chosen] if cycle.chosen is not None else cycle.options:
            self._choice.penalize(one.grasp, view.now, f"no motion: {response.message}")
        self._drop_cycle(cycle)  # the other grasps of the same image are as good as before
        self.status.message = response.message

    def _drop_cycle(self, cycle: Pick) -> None:
        self._planning = None
        for stage in [stage for stage in self.queue if stage.cycle is cycle]:
            self.queue.remove(stage)

    def obstructed(self, stage: Stage, view: SortingView, problem: str) -> None:
        """Wait for a foreign body on the path, then plan again: it is no failure of the motion."""
        self.clear()
        self.images_after = view.now
        self.status.message = problem

    def _nothing_to_take(self, view: SortingView) -> None:
        """Stir if objects are left, else end; both only once that was seen for a while."""
        assert self._heap is not None and view.q is not None
        heap = self._heap
        if not is_home(view.q, self.p.robot.named_poses["home"]):  # the pictures from there decide
            self.images_after, self._heap = view.now, None
            self.queue += [self.home(view), AwaitImage()]
            return
        if any(contents.pending for contents in self._memory.contents.values()):
            return  # two images from home show first what arrived in the containers
        left = steady([self._choice.left(each) for each in self._recent])
        foreign = [thing for thing in view.objects("target") if thing.kind == FOREIGN]
        waited = 1e-9 * (heap.header.stamp - self._recent[0].header.stamp)
        if heap.hidden > MOST_HIDDEN:
            self.status.message = f"no depth of {100 * heap.hidden:.0f} % of the tray"
            if waited >= self.p.give_up:
                self._finish(left, heap, self.status.message)
            return
        if not left:
            self.status.state = "IDLE"
            if waited >= self.p.empty:
                self._finish([], heap)
            return
        if foreign:
            x, y, _ = place_of(foreign[0].pose)
            self._recent.clear()
            self._recent.append(heap)
            self.status.message = f"waiting: a foreign body is in the cell at ({x:.2f}, {y:.2f})"
            return
        self.status.message = f"{len(left)} objects left, none can be grasped now"
        if waited < self.p.give_up:
            return
        inside = [thing for thing in left if thing.place == self.p.tray and self._goes_somewhere(thing)]
        if inside and self._memory.stirs < self.p.most_stirs:
            self._stir(inside, view)
        else:
            self._finish(left, heap)

    def _goes_somewhere(self, thing: SeenObject) -> bool:
        try:
            self._rule.destination(thing)
        except NoDestination:
            return False
        return True

    def _stir(self, things: list[SeenObject], view: SortingView) -> None:
        box, stirs = self._box(self.p.tray), self._memory.stirs
        thing = things[stirs % len(things)]
        inner = box.half_side - box.wall_thickness - motions.OFF_WALL
        start, end = motions.push_line(thing, (box.x, box.y), inner, stirs)
        self._remember(stirs=stirs + 1)
        self._choice.forget()
        self.status.message = f"pushing {thing.id}: nothing can be grasped"
        self.queue += motions.stir(view, self.gripper, start, end, self.p.world.table_height + box.floor_thickness)
        self.images_after, self._heap = view.now, None

    def _finish(self, left: list[SeenObject], heap: Heap, error: str = "") -> None:
        reasons = [(thing, self._choice.reason(thing, heap)) for thing in left]
        self.status.skipped = [
            m.Rejection(position=thing.center, reason=f"{thing.id}: {reason}") for thing, reason in reasons]
        overlooked = "; ".join(
            f"{thing.id} at ({thing.center.x:.3f}, {thing.center.y:.3f}): {reason}" for thing, reason in reasons)
        message = f"{len(left)} objects are left" if left else "the tray is empty"
        if two := self._memory.two_at_once:
            message = f"{message}; {two} more objects arrived in containers than were released"
        self.end("ERROR" if error else "DONE", error or message)
        self.status.overlooked = "; ".join([*self._memory.arrivals, *filter(None, [overlooked])])[:400]

    def note(self, view: SortingView) -> None:
        """Queue what follows a planned approach, and update the counters of the status."""
        self._follow_up(view)
        super().note(view)
