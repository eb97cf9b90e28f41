"""What the sorting task knows: the newest picture of the tray, its counters, and what a plan request needs."""

from __future__ import annotations

import math
from collections import Counter, deque

from pydantic import BaseModel

from applications.sorting import motions
from applications.sorting.choice import Choice
from applications.sorting.contents import Contents
from applications.sorting.motions import Pick
from applications.sorting.placing import Dropped
from applications.sorting.rules import NoDestination
from applications.sorting.scene import FOREIGN
from applications.sorting.settings import Config, Memory, SortingView
from applications.sorting.topics import Heap, SeenObject, SortingStatus
from common import messages as m
from common.config import Container
from common.robot.home import is_home
from common.tasks.engine import Task
from common.tasks.stages import AwaitImage, Move, place_of

MOST_FAILURES = 25  # in a row; each pick that has no plan is one
OLD = 20.0  # [s] an older image decides nothing, also while the arm only was on its way


class SortingProgress(Task[SortingView]):
    """Reads heap and planning scene, and counts."""

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
        self._earlier = 0.0  # [s] that earlier processes of this task worked
        self._home_since: float | None = 0.0  # [s]; no earlier motion is known
        self._from_home: deque[Heap] = deque(maxlen=2)  # the newest images that show all containers

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

    def _box(self, container: str) -> Container:
        return self.p.world.containers[container]

    def _rim(self, container: str) -> float:
        return self.p.world.table_height + self._box(container).wall_height

    def _inside(self, container: str) -> int:
        """Return how many objects are seen in a container."""
        return sum(thing.place == container for thing in self._heap.objects) if self._heap is not None else 0

    def _watch_containers(self, view: SortingView) -> None:
        """Count objects that arrived in containers unnoticed, by two images from home: others may be older there."""
        if view.q is None or not is_home(view.q, self.p.robot.named_poses["home"]):
            self._home_since = None
            self._from_home.clear()
            return
        if self._home_since is None:
            self._home_since = view.now
        heap = view.heap
        if heap is None or not heap.at_home or heap.header.stamp * 1e-9 <= self._home_since or (
                self._from_home and heap.header.stamp <= self._from_home[-1].header.stamp):
            return
        self._from_home.append(heap)
        if len(self._from_home) < 2 or self._memory.thing is not None or view.holding:
            return
        for container in self.p.world.containers:
            if container != self.p.tray:
                self._compare_contents(container)
        self._remember(doubt="")

    def _compare_contents(self, container: str) -> None:
        images = [[thing for thing in heap.objects if thing.place == container] for heap in self._from_home]
        memory = self._memory
        known = memory.contents.get(container)
        extra, new = known.more(images) if known is not None else (0, [])
        self._remember(contents={**memory.contents, container: (known or Contents()).updated(images)})
        if not extra or known is None:
            return
        names = ", ".join(f"{thing.id} ({thing.color_name})" for thing in new)
        wrong = [f"{thing.id} belongs in {place}" for thing in new
                 if (place := self._belongs(thing)) and place != container]
        releases = "1 release" if len(known.pending) == 1 else f"{len(known.pending)} releases"
        text = "; ".join([f"two at once: {names} arrived in {container} after {releases}", *wrong])
        counts = Counter(memory.sorted) + Counter({container: extra})
        self._remember(done=memory.done + extra, sorted=dict(counts), two_at_once=memory.two_at_once + extra,
                       arrivals=[*memory.arrivals[-9:], text])
        self._note("two", text)
        self.status.message = text

    def _belongs(self, thing: SeenObject) -> str:
        """Return the container that the rule names; empty if none."""
        try:
            return self._rule.destination(thing)
        except NoDestination:
            return ""

    def _count_sorted(self, name: str, container: str) -> None:
        counts = Counter(self._memory.sorted) + Counter({container: 1})
        if container in self._memory.contents and self._memory.thing is not None:
            known = self._memory.contents[container]
            known = known.model_copy(update={"pending": [*known.pending, self._memory.thing.color_name]})
            self._remember(contents={**self._memory.contents, container: known})
        self._remember(done=self._memory.done + 1, sorted=dict(counts), thing=None, container="", back=False, stirs=0,
                       seconds=self._earlier + self.status.task_seconds)
        doubt = self._memory.doubt
        self._note("one", f"{name} to {container}{f'; may be two: {doubt}' if doubt else ''}")

    def _note(self, outcome: str, last: str) -> None:
        counts = Counter(self._memory.outcomes) + Counter({outcome: 1})
        self.status.held, self.status.last = outcome, last
        self._remember(outcomes=dict(counts))

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

    def note(self, view: SortingView) -> None:
        """Update the counters of the status."""
        self._watch_containers(view)
        memory, status = self._memory, self.status
        status.done, status.attempts = memory.done, memory.attempts
        if self._heap is not None and not view.holding:
            status.total = memory.done + len(self._choice.left(self._heap))
        status.total = max(status.total, memory.done)
        seconds = self._earlier + status.task_seconds
        status.figures = {
            "attempts": memory.attempts,
            "success_rate": round(memory.done / memory.attempts, 3) if memory.attempts else None,
            "picks_per_hour": round(3600 * memory.done / seconds, 1) if seconds > 0 and memory.done else None,
            **{f"sorted_{name}": count for name, count in sorted(memory.sorted.items())},
            **{f"check_{name}": count for name, count in sorted(memory.outcomes.items())},
            "two_at_once": memory.two_at_once,
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
        self._memory, self._choice.failures, self._earlier = memory, memory.failures, memory.seconds

    def _remember(self, **changes: object) -> None:
        self._memory = self._memory.model_copy(update=changes)

    def on_restart(self) -> None:
        """Allow given-up objects again."""
        self._choice.forget()
        self._remember(stirs=0)
        self.images_after, self._heap = 0.0, None
