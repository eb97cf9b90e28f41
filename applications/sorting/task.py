"""The sorting task: take the objects of a tray, one after the other, into the containers that a rule names.

What is decided follows from heap, planning scene and gripper; `common/tasks/engine.py` does the rest. The next grasp is
chosen while the arm is above a container, where it hides nothing of the tray.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import BaseModel, Field, model_validator

from applications.sorting import motions
from applications.sorting.checking import by_picture, by_width, width_remark
from applications.sorting.choice import Choice, Failure
from applications.sorting.motions import Pick
from applications.sorting.placing import ABOVE, Dropped, Full, free_spot, release_height
from applications.sorting.rules import NoDestination, Rule
from applications.sorting.scene import FOREIGN
from applications.sorting.topics import Grasp, Heap, SeenObject, SortingStatus
from common import messages as m
from common.config import Container, Surroundings, Tunable
from common.errors import ConfigError
from common.robot.home import is_home
from common.tasks.decisions import TaskConfig
from common.tasks.engine import Task
from common.tasks.stages import AwaitImage, Grip, Move, Stage, View, place_of

SERVICE = "services.sorter."
RISEN = 0.03  # [m] of the lowest held point above the walls: high enough to move across
BELOW = 0.06  # [m] of an unseen object below the tool
RADIUS = 0.05  # [m] of an unseen object from above
LOWERED = 0.015  # [m] above its support at which an object is put back
MOST_FAILURES = 25  # in a row; each pick that has no plan is one
STEADY = 0.6  # share of images that show an object at the same place
SAME = 0.025  # [m]
STILL = 0.01  # [m] that an object at rest may seem to move between two images
NO_MOTION = ("no_ik", "collision")  # errors of a goal itself; a planner without an answer says nothing about it
OLD = 20.0  # [s] an older image decides nothing, also while the arm only was on its way


class Config(TaskConfig):
    """The rule, and when an object is given up; times are cell time unless they say wall."""

    world: Surroundings
    tray: str = Field("tray", description="id of the container that objects are taken from")
    by: str = Field("color", description="color, size, shape, or module:function of yours, which gets a SeenObject and "
                                         "returns the id of a container")
    where: dict[str, str] = Field({}, description="container by color, size or shape; '*' for all others")
    large: float = Field(0.06, gt=0, le=1, description="an object this long or longer is large [m]")
    frame_timeout: Tunable[float] = Field(
        3.0, ge=0.1, le=60, description="an older picture starts no motion [s, wall time]")
    obstacle_patience: Tunable[float] = Field(
        3.0, ge=0, le=3600, description="a motion that a foreign body blocks for longer is planned again [s]")
    penalty: Tunable[float] = Field(60.0, ge=0, le=3600, description="a place where a grasp failed is avoided for [s]")
    most_tries: Tunable[int] = Field(4, ge=1, le=100, description="failed grasps of an object until it is left")
    most_stirs: Tunable[int] = Field(3, ge=0, le=20, description="pushes through the heap, in a row, if nothing can be "
                                                                 "grasped")
    width_tolerance: Tunable[float] = Field(
        0.015, gt=0, le=0.1, description="what is held may be so much wider or narrower than it was seen [m]")
    carrying: Tunable[float] = Field(
        0.25, gt=0, le=1, description="fraction of the joints' acceleration limits while an object is held")
    check_patience: Tunable[float] = Field(
        1.0, ge=0, le=60, description="wait for a picture of the tray before an object is released [s]")
    empty: Tunable[float] = Field(1.0, ge=0, le=600, description="the tray must look empty for so long [s]")
    give_up: Tunable[float] = Field(4.0, ge=0, le=600, description="for so long nothing must be graspable before the "
                                                                   "heap is stirred or the task ends [s]")

    @model_validator(mode="after")
    def _require_rule(self) -> Config:
        try:
            self.rule()
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self

    def rule(self) -> Rule:
        """Return the rule.

        Raises:
            ConfigError: the tray, a value or a container is unknown.
        """
        if self.tray not in self.world.containers:
            raise ConfigError(f"{SERVICE}tray", self.tray,
                              f"is no container; choices: {', '.join(self.world.containers) or 'none'}")
        others = [name for name in self.world.containers if name != self.tray]
        return Rule(self.by, self.where, others, self.large, SERVICE)


@dataclass
class SortingView(View):
    """What the task knows: in addition what the cameras see."""

    heap: Heap | None = None


class Memory(BaseModel):
    """What a restarted task cannot see: counters, failed places, and where the held object goes."""

    attempts: int = 0
    done: int = 0
    sorted: dict[str, int] = {}
    outcomes: dict[str, int] = {}
    failures: list[Failure] = []
    thing: SeenObject | None = None
    grasp: Grasp | None = None
    container: str = ""
    back: bool = False
    inside: int = 0  # objects seen in that container before
    stirs: int = 0


class Sorting(Task[SortingView]):
    """Clears a tray."""

    p: Config
    status: SortingStatus

    def __init__(self, config: Config, status: SortingStatus, prefix: str, speed: float = 1.0) -> None:
        """Start with nothing known: see `Task`."""
        super().__init__(config, status, prefix, speed)
        self._rule = config.rule()
        self._choice = Choice(self._rule, config.tray, self.gripper.closing_axis)
        self._memory = Memory()
        self._heap: Heap | None = None  # the newest that shows the whole tray and is not outdated
        self._recent: deque[Heap] = deque()  # of the last seconds
        self._dropped: list[Dropped] = []
        self._carried_since = math.inf
        self._skipped = 0  # spots tried for the held object
        self._descending: Pick | None = None

    # --- what to do next -------------------------------------------------------------------------------------

    def decide(self, view: SortingView) -> None:
        """Carry what is held, take the next object, stir, or end."""
        if self.status.state == "DONE":
            return
        if view.holding:
            if view.attached:  # else the planning scene is not up to date yet
                self._place_held(view)
        elif self._memory.thing is not None:
            self._find_lost(view)
        elif not self._refresh(view):
            self._look(view)
        elif not self._queue_pick(view) and len(self._recent) > 1:  # one image does not show what is at rest
            self._nothing_to_take(view)

    def decide_ahead(self, running: Stage, view: SortingView) -> None:
        """Choose the next object while one is carried above its container."""
        cycle = running.cycle
        if running.name not in ("carry", "across", "release") or not isinstance(cycle, Pick) or not cycle.checked:
            return
        if not any(isinstance(stage, Move | AwaitImage) for stage in self.queue) and not cycle.back:
            self._queue_pick(view)

    def _refresh(self, view: SortingView) -> bool:
        """Take the newest heap if it shows the whole tray after what was done; return whether one is there."""
        heap = view.heap
        if heap is not None and heap.at_home and self.has_fresh_image(view):
            stamp = heap.header.stamp
            shown = view.scene is not None and view.scene.settled == stamp
            if shown and stamp * 1e-9 > self.images_after and heap is not self._heap:
                self._heap = heap
                self._recent.append(heap)
                while self._recent[0].header.stamp * 1e-9 < max(self.images_after, stamp * 1e-9 - self.p.give_up - 1.0):
                    self._recent.popleft()
        if self._heap is not None and not self.images_after < self._heap.header.stamp * 1e-9 >= view.now - OLD:
            self._heap = None
        return self._heap is not None

    def _look(self, view: SortingView) -> None:
        """Wait for an image; first move the arm out of it."""
        assert view.q is not None
        if unseen := self.unseen(view):
            self.status.message = unseen
        elif self.status.message in ("no fresh picture",):
            self.status.message = ""
        if is_home(view.q, self.p.robot.named_poses["home"]):
            return
        if self._is_clear(view) and self.wait_timer.elapsed("look", view.now) < self.p.check_patience:
            return
        self.wait_timer.reset()
        near = view.tool[2] < self._rim(self.p.tray) + 0.1 and not self._is_clear(view)
        self.queue += self.back_off(view) if near else [self.home(view), AwaitImage()]

    def _is_clear(self, view: SortingView) -> bool:
        """Return whether the tool is above a container, where the arm hides nothing of the tray."""
        x, y, _ = view.tool
        return any(max(abs(x - box.x), abs(y - box.y)) < box.half_side
                   for name, box in self.p.world.containers.items() if name != self.p.tray)

    def _is_at_rest(self, thing: SeenObject, heap: Heap) -> bool:
        """Return whether an earlier image shows the object, too: what still falls or rolls is not gripped."""
        here = (thing.center.x, thing.center.y, thing.top)
        return any(math.dist((other.center.x, other.center.y, other.top), here) < STILL
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
        cycle = Pick(options[0].thing.id, options=options, before=self._choice.left(heap))
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

    def _box(self, container: str) -> Container:
        return self.p.world.containers[container]

    def _rim(self, container: str) -> float:
        return self.p.world.table_height + self._box(container).wall_height

    # --- a held object ---------------------------------------------------------------------------------------

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
        try:
            container = self._memory.container or self._rule.destination(thing)
            spot = self._spot(thing, container, below)
        except (NoDestination, Full) as error:
            self.status.message = str(error)
            self._put_back(view)
            return
        if self._memory.back:
            self._put_back(view)
            return
        cycle = Pick(thing.id, spot=spot, gripped=True, checked=True)
        if view.tool[2] - below > self._rim(self.p.tray) + RISEN:
            across = Move("across", "PLACING", cycle, goal=motions.over_spot(spot), carries=True)
            self.queue += [across, motions.release(cycle, self.gripper)]
            return
        near = motions.neighbors(view, view.tool[:2])
        touches = [(link, name) for link in self.gripper.links for name in near]
        touches += [(held.id, name) for name in [*near, *motions.supports(thing, view)]]
        self.queue += motions.carry(cycle, self.gripper, view.tcp, touches)

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

    # --- checks ----------------------------------------------------------------------------------------------

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
        """Compare the tray with the picture before the grasp; return whether the object may be released."""
        assert cycle.chosen is not None
        self.images_after = max(self.images_after, min(self._carried_since, view.now))
        if not self._refresh(view) or self._heap is None:
            waited = self.wait_timer.elapsed("check", view.now)
            arrived = self.running is None
            if not arrived or waited < self.p.check_patience:
                return False
            cycle.checked = True
            self.status.held = "one"
            return True
        found = by_picture(cycle.chosen.thing, place_of(cycle.chosen.grasp.pose)[:2], cycle.before,
                           self._choice.left(self._heap))
        cycle.checked, self.status.held = True, found.held
        if found.held != "two":
            return True
        self._choice.penalize(cycle.chosen.grasp, view.now, found.why)
        self._note("two", f"{cycle.subject}: {found.why}")
        self._remember(back=True)
        self.clear()
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
                       inside=cycle.inside)

    def _released(self, cycle: Pick, view: SortingView) -> None:
        thing, container = self._memory.thing, self._memory.container
        if not container:
            container = next((name for name, box in self.p.world.containers.items()
                              if math.dist(cycle.spot[:2], (box.x, box.y)) < box.half_side), "")
        self._count_sorted(cycle.subject, container)
        size = max(thing.size.x, thing.size.y) / 2 if thing else RADIUS
        height = thing.size.z if thing else RADIUS
        self._dropped = [*self._dropped[-50:], Dropped(container, cycle.spot[:2], size, height)]

    def _count_sorted(self, name: str, container: str) -> None:
        counts = Counter(self._memory.sorted) + Counter({container: 1})
        self._remember(done=self._memory.done + 1, sorted=dict(counts), thing=None, container="", back=False, stirs=0)
        self._note("one", f"{name} to {container}")

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
        if self._inside(container) > self._memory.inside and not self._memory.back:
            self._count_sorted(thing.id, container)
            return
        if self._memory.grasp is not None:
            self._choice.penalize(self._memory.grasp, view.now, "it fell out of the fingers")
        self._note("slipped", f"{thing.id} fell")
        self._remember(thing=None, container="", back=False)

    def _inside(self, container: str) -> int:
        """Return how many objects are seen in a container."""
        return sum(thing.place == container for thing in self._heap.objects) if self._heap is not None else 0

    def _note(self, outcome: str, last: str) -> None:
        counts = Counter(self._memory.outcomes) + Counter({outcome: 1})
        self.status.held, self.status.last = outcome, last
        self._remember(outcomes=dict(counts))

    # --- what cannot be done ---------------------------------------------------------------------------------

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
        left = steady([self._choice.left(each) for each in self._recent])
        foreign = [thing for thing in view.objects("target") if thing.kind == FOREIGN]
        waited = 1e-9 * (heap.header.stamp - self._recent[0].header.stamp)
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

    def _finish(self, left: list[SeenObject], heap: Heap) -> None:
        reasons = [(thing, self._choice.reason(thing, heap)) for thing in left]
        self.status.skipped = [
            m.Rejection(position=thing.center, reason=f"{thing.id}: {reason}") for thing, reason in reasons]
        overlooked = "; ".join(
            f"{thing.id} at ({thing.center.x:.3f}, {thing.center.y:.3f}): {reason}" for thing, reason in reasons)
        message = f"{len(left)} objects are left" if left else "the tray is empty"
        self.end("DONE", message)
        self.status.overlooked = overlooked[:400]

    # --- motions ---------------------------------------------------------------------------------------------

    def request(self, move: Move, start: list[float], view: SortingView) -> m.PlanRequest:
        """Add the carried object, by its id in the planning scene, and the contact that it may have at first."""
        cycle = move.cycle
        gripped = isinstance(cycle, Pick) and cycle.gripped and view.attached
        if move.carries and not gripped and isinstance(cycle, Pick) and cycle.chosen is not None:
            move.attach = self._scene_id(cycle.chosen.thing, view)
            move.attach_pose = motions.attach_pose(cycle.chosen, view, move.attach)
        elif move.carries:
            move.attach, move.attach_pose = view.attached, None
        request = super().request(move, start, view)
        if move.carries:
            request.contact_distance = motions.CONTACT
            request.acceleration_scaling = self.p.carrying
        if move.name in ("approach",):
            request.gripper_width = self.gripper.max_width
        return request

    def _scene_id(self, thing: SeenObject, view: SortingView) -> str:
        """Return the id of an object in the planning scene; of the nearest one if images renamed it."""
        targets = [each for each in view.objects("target") if each.kind != FOREIGN]
        if any(each.id == thing.id for each in targets):
            return thing.id
        place = (thing.center.x, thing.center.y)
        return min(targets, key=lambda each: math.dist(place_of(each.pose)[:2], place)).id if targets else ""

    def obstacles(self, move: Move, view: SortingView) -> list[tuple[float, float]]:
        """Return the foreign bodies: the heap itself changes with every grasp."""
        return [place_of(thing.pose)[:2] for thing in view.objects("target") if thing.kind == FOREIGN]

    @property
    def moved(self) -> float:
        """Distance at which a foreign body is a new one [m]: boxes around few points are inexact."""
        return 0.05

    @property
    def failure_limit(self) -> int:
        """Number of failures in a row after which the task gives up."""
        return MOST_FAILURES

    # --- status ----------------------------------------------------------------------------------------------

    def note(self, view: SortingView) -> None:
        """Update the counters of the status."""
        self._follow_up(view)
        memory, status = self._memory, self.status
        status.done, status.attempts = memory.done, memory.attempts
        if self._heap is not None and not view.holding:
            status.total = memory.done + len(self._choice.left(self._heap))
        status.total = max(status.total, memory.done)
        seconds = status.task_seconds
        status.figures = {
            "attempts": memory.attempts,
            "success_rate": round(memory.done / memory.attempts, 3) if memory.attempts else None,
            "picks_per_hour": round(3600 * memory.done / seconds, 1) if seconds > 0 and memory.done else None,
            **{f"sorted_{name}": count for name, count in sorted(memory.sorted.items())},
            **{f"check_{name}": count for name, count in sorted(memory.outcomes.items())},
            "stirs": memory.stirs,
        }

    @property
    def memory(self) -> Memory:
        """Counters, failed places, and where the held object goes."""
        if self._memory.failures != self._choice.failures:
            self._memory = self._memory.model_copy(update={"failures": self._choice.failures})
        return self._memory

    def remember(self, memory: BaseModel) -> None:
        """Continue from the memory of the task before its restart."""
        assert isinstance(memory, Memory)
        self._memory, self._choice.failures = memory, memory.failures

    def _remember(self, **changes: object) -> None:
        self._memory = self._memory.model_copy(update=changes)

    def on_restart(self) -> None:
        """Allow given-up objects again."""
        self._choice.forget()
        self._remember(stirs=0)
        self.images_after, self._heap = 0.0, None


def steady(images: Sequence[Sequence[SeenObject]]) -> list[SeenObject]:
    """Return the objects that most images show at the same place: the others are noise."""
    found: list[SeenObject] = []
    for things in reversed(images):
        for thing in things:
            if not any(_near(thing, known) for known in found):
                found.append(thing)
    return [thing for thing in found
            if sum(any(_near(thing, other) for other in things) for things in images) > STEADY * len(images)]


def _near(one: SeenObject, other: SeenObject) -> bool:
    return math.dist((one.center.x, one.center.y), (other.center.x, other.center.y)) < SAME


def seen_as(held: m.CollisionObject) -> SeenObject:
    """Return a held object of the planning scene as an object that was seen."""
    corners = held.outline or [(held.dimensions[0] / 2, held.dimensions[-1] / 2)]
    x, y = (max(abs(corner[axis]) for corner in corners) for axis in (0, 1))
    size = m.Vector3(x=2 * x, y=2 * y, z=held.dimensions[0])
    return SeenObject(id=held.id, center=m.Vector3(), size=size, color=held.color)


def depth_below(held: m.CollisionObject) -> float:
    """Return how far a held object reaches below a tool that points down [m]."""
    return max(0.01, held.pose.position.z + held.dimensions[-1 if held.shape == "box" else 0] / 2)
