"""From the descent to the release: what is held is checked, and goes to its container or back to the tray."""

from __future__ import annotations

import math

from applications.sorting import motions
from applications.sorting.checking import Check, by_picture, by_width, width_remark
from applications.sorting.motions import Pick
from applications.sorting.placing import ABOVE, Dropped, Full, free_spot, release_height
from applications.sorting.progress import SortingProgress
from applications.sorting.rules import NoDestination
from applications.sorting.settings import SortingView
from applications.sorting.steady import depth_below, seen_as
from applications.sorting.topics import Heap, SeenObject
from common import messages as m
from common.robot.home import is_home
from common.tasks.stages import AwaitImage, Grip, Move, Stage, place_of

RISEN = 0.03  # [m] of the lowest held point above the walls: high enough to move across
BELOW = 0.06  # [m] of an unseen object below the tool
RADIUS = 0.05  # [m] of an unseen object from above
CHECKS = "waiting for an image of the tray: is one object held, or two?"
LOWERED = 0.015  # [m] above its support at which an object is put back


class Holding(SortingProgress):
    """Takes, checks and places one object."""

    def may_start(self, stage: Stage, view: SortingView) -> bool:
        """Release only what was checked; the descent makes the picture of the tray outdated."""
        if not super().may_start(stage, view):
            return False
        cycle = stage.cycle
        if isinstance(cycle, Pick) and stage.name == "release" and not cycle.checked:
            return self._check(cycle, view)
        if isinstance(cycle, Pick) and stage.name == "descend":
            if self._replans(cycle, view):
                return False
            self.images_after, self._heap, self._descending = view.now, None, cycle
        return True

    def _replans(self, cycle: Pick, view: SortingView) -> bool:
        """Return whether the scene has other objects near the grasp than when it was planned: it is planned again."""
        down, up = motions.contacts(cycle, self.gripper, view)
        moves = [stage for stage in self.queue if isinstance(stage, Move) and stage.cycle is cycle]
        known = {pair for stage in moves if stage.name == "descend" for pair in stage.touches}
        if known.issuperset(down):
            return False
        for stage in moves:
            stage.touches, stage.trajectory = (down if stage.name == "descend" else up), None
            for other in stage.fallback:
                if isinstance(other, Move) and other.name == "lift":
                    other.touches = up
        self._planning = None
        return True

    def _check(self, cycle: Pick, view: SortingView) -> bool:
        """Compare the tray with the picture before the grasp; return whether the object may be released.

        If the tray cannot be seen from here, it is looked at from home, with the object.
        """
        self.images_after = max(self.images_after, min(self._carried_since, view.now))
        if not self._refresh(view) or self._needs_another():
            if self.running is None and self.wait_timer.elapsed("check", view.now) >= self.p.check_patience:
                self.clear()
                self.queue += [self.home(view), AwaitImage()]
            return False
        cycle.checked = self._compare(view)
        if not cycle.checked:
            self.clear()
        return cycle.checked

    def _held_by(self, heap: Heap) -> Check:
        """Return what is held by one image."""
        memory = self._memory
        assert memory.thing is not None and memory.grasp is not None
        return by_picture(memory.thing, place_of(memory.grasp.pose)[:2], memory.before, self._choice.left(heap),
                          memory.wider)

    def _needs_another(self) -> bool:
        """Return whether the only image after the lift shows that two objects are held: a second one confirms that."""
        after = [heap for heap in self._recent if heap.header.stamp * 1e-9 > self.images_after]
        return self._memory.thing is not None and len(after) == 1 and self._held_by(after[0]).held == "two"

    def _compare(self, view: SortingView) -> bool:
        """Find out by the newest image what is held; return whether it is one object."""
        memory = self._memory
        assert memory.thing is not None and memory.grasp is not None and self._heap is not None
        found = self._held_by(self._heap)
        self.status.held = found.held
        if self.status.message == CHECKS:
            self.status.message = ""
        self._remember(checked=True, doubt=found.doubt)
        if found.held != "two":
            return True
        self._choice.penalize(memory.grasp, view.now, found.why)
        self._note("two", f"{memory.thing.id}: {found.why}")
        self._remember(back=True)
        return False

    def succeeded(self, stage: Stage, view: SortingView) -> None:
        """Check what the fingers took; count a released object."""
        cycle = stage.cycle
        if not isinstance(cycle, Pick):
            return
        if stage.name == "close":
            self._closed(cycle, view)
        elif stage.name == "release" and cycle.back:
            self._remember(thing=None, container="", back=False)
            self.images_after, self._heap = view.now, None
        elif stage.name == "release":
            self._released(cycle, view)

    def _closed(self, cycle: Pick, view: SortingView) -> None:
        assert view.gripper is not None
        self._remember(attempts=self._memory.attempts + 1)
        self._carried_since, self._skipped = view.now, 0
        if cycle.chosen is None:
            return
        chosen, cycle.gripped = cycle.chosen, True
        self.status.message = ""
        self.status.grasp = chosen.grasp.id
        remark = width_remark(view.gripper.width, chosen.grasp.width, self.p.width_tolerance)
        self.status.held, self.status.last = "", f"{cycle.subject}: {remark or 'gripped'}"
        self._remember(thing=chosen.thing, grasp=chosen.grasp, container=chosen.container, back=False,
                       inside=cycle.inside, left=len(cycle.before), before=cycle.before, checked=False, doubt="",
                       wider=remark if view.gripper.width > chosen.grasp.width else "")

    def _released(self, cycle: Pick, view: SortingView) -> None:
        thing, container = self._memory.thing, self._memory.container
        if not container:
            container = next((name for name, box in self.p.world.containers.items()
                              if math.dist(cycle.spot[:2], (box.x, box.y)) < box.half_side), "")
        self._count_sorted(cycle.subject, container)
        size = max(thing.size.x, thing.size.y) / 2 if thing else RADIUS
        height = thing.size.z if thing else RADIUS
        self._dropped = [*self._dropped[-50:], Dropped(container, cycle.spot[:2], size, height)]

    def missed(self, stage: Grip, view: SortingView) -> None:
        """Penalize an empty grasp, open, back off and look again."""
        assert view.gripper is not None
        cycle = stage.cycle
        self._remember(attempts=self._memory.attempts + 1)
        found = by_width(view.gripper.width, view.holding)
        if isinstance(cycle, Pick) and cycle.chosen is not None:
            self.status.grasp = cycle.chosen.grasp.id
            self._choice.penalize(cycle.chosen.grasp, view.now, found.why or stage.problem)
            self._note(found.held or "empty", f"{cycle.subject}: {found.why or stage.problem}")
        self.clear()
        self.status.retries += 1
        self.images_after, self._heap = view.now, None
        opening = min(view.gripper.width + 0.02, self.gripper.max_width)
        self.queue += [Grip("open", "GRASPING", width=opening), *self.back_off(view.released())]

    def fail(self, message: str, view: SortingView, *, go_home: bool = True) -> None:
        """Count a failure; back off from what the arm ran into on its way down."""
        stopped = self._descending if message.startswith("descend ") else None
        super().fail(message, view, go_home=go_home and stopped is None)
        if stopped is not None and stopped.chosen is not None:
            self._choice.penalize(stopped.chosen.grasp, view.now, message)
            self._remember(attempts=self._memory.attempts + 1)
            self._note("empty", f"{stopped.subject}: {message}")
            if self.status.state != "ERROR":
                self.queue += self.back_off(view)

    def _find_lost(self, view: SortingView) -> None:
        """Find out by a picture from home whether an object fell, or was released before the task could note it."""
        assert view.q is not None and self._memory.thing is not None
        if not is_home(view.q, self.p.robot.named_poses["home"]):
            self.queue += self.back_off(view)
            return
        if not self._refresh(view) or self._heap is None:
            self._look(view)
            return
        thing, container = self._memory.thing, self._memory.container
        fewer = len(self._choice.left(self._heap)) < self._memory.left
        if self._inside(container) > self._memory.inside and fewer and not self._memory.back:
            self._count_sorted(thing.id, container)
            return
        if self._memory.grasp is not None:
            self._choice.penalize(self._memory.grasp, view.now, "it fell out of the fingers")
        self._note("slipped", f"{thing.id} fell")
        self._remember(thing=None, container="", back=False)

    def _below(self, cycle: Pick) -> float:
        """Return how far the object reaches below the tool that grips it [m]."""
        if cycle.chosen is None:
            return BELOW
        return max(0.01, cycle.chosen.grasp.pose.position.z - cycle.chosen.thing.bottom)

    def _spot(self, thing: SeenObject, container: str, below: float) -> tuple[float, float, float]:
        """Return (x, y) of a free spot of a container [m] and z of the tool that releases there.

        Raises:
            Full: the container is full.
        """
        box, floor = self._box(container), self.p.world.table_height
        seen = [other for other in (self._heap.objects if self._heap else []) if other.place == container]
        radius = max(thing.size.x, thing.size.y) / 2
        spot = free_spot(box, radius, seen, [one for one in self._dropped if one.container == container], floor,
                         self._skipped)
        return spot.x, spot.y, release_height(box, spot, floor, below)

    def _place_held(self, view: SortingView) -> None:
        """Bring what is held to its container, also if another process of this task took it."""
        assert view.scene is not None and view.scene.attached and view.q is not None and view.tcp is not None
        home = is_home(view.q, self.p.robot.named_poses["home"])
        if not view.scene.settled and not home:  # nothing around the arm is known yet
            self.queue += [self.retreat(view), self.home(view), AwaitImage()]
            return
        held = view.scene.attached[0].object
        thing = self._memory.thing or seen_as(held)
        below = depth_below(held)
        if not home and view.tool[2] - below <= self._rim(self.p.tray) + RISEN:
            self._lift_held(thing, held, view)
            return
        if self._memory.thing is None:  # it was never compared with an image
            self.status.message = "what is held is unknown: it goes back to the tray"
            self._remember(back=True)
        if not (self._memory.checked or self._memory.back or self._look_at_tray(view)):
            return
        if self._memory.back:
            self._put_back(view)
            return
        try:
            container = self._memory.container or self._rule.destination(thing)
            spot = self._spot(thing, container, below)
        except (NoDestination, Full) as error:
            self.status.message = str(error)
            self._put_back(view)
            return
        cycle = Pick(thing.id, spot=spot, gripped=True, checked=True)
        across = Move("across", "PLACING", cycle, goal=motions.over_spot(spot), carries=True)
        self.queue += [across, motions.release(cycle, self.gripper)]

    def _lift_held(self, thing: SeenObject, held: m.CollisionObject, view: SortingView) -> None:
        """Lift what is held out of the heap."""
        assert view.tcp is not None
        near = motions.neighbors(view, view.tool[:2])
        touches = [(link, name) for link in self.gripper.links for name in near]
        touches += [(held.id, name) for name in [*near, *motions.supports(thing, view)]]
        self.queue.append(motions.lift(Pick(thing.id, gripped=True), view.tcp, touches))

    def _look_at_tray(self, view: SortingView) -> bool:
        """Compare the tray with the picture before the grasp, from home if need be; return whether that was done."""
        if math.isinf(self._carried_since):  # another process of this task took it
            self._carried_since = view.now
        self.images_after = max(self.images_after, self._carried_since)
        if self._refresh(view) and not self._needs_another():
            self._compare(view)
            return True
        self._look(view)
        self.status.message = self.status.message or CHECKS
        return False

    def _put_back(self, view: SortingView) -> None:
        """Queue the way of the held object to the freest spot of the tray."""
        assert view.scene is not None
        held = view.scene.attached[0].object if view.scene.attached else None
        below = depth_below(held) if held else BELOW
        box, floor = self._box(self.p.tray), self.p.world.table_height
        seen = [thing for thing in (self._heap.objects if self._heap else []) if thing.place == self.p.tray]
        try:
            spot = free_spot(box, RADIUS, seen, [], floor, self._skipped)
        except Full as full:
            self.end("ERROR", f"what is held cannot be put down: {full}")
            return
        above = release_height(box, spot, floor, below)
        cycle = Pick(self._memory.thing.id if self._memory.thing else "held", back=True, gripped=True, checked=True)
        self.queue += motions.put_back(cycle, self.gripper, (spot.x, spot.y, above + ABOVE), spot.top + below + LOWERED)
