"""Gathers from the messages of a run what every report shows. Times are wall time since the recording began [s]."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from common import messages as m
from common import topics as t
from common.messages import PoseArray, WorldObjects
from common.topics import Topic

SAME = 0.05  # [m] from where something is to where it was seen: less well where the picture cuts it off
BOX = "box"  # the container of recordings that do not tell its id


@dataclass(frozen=True)
class TrueObject:
    """An object: its centre [m] in world, what becomes of it, and the container in which it lies."""

    position: tuple[float, float, float]
    state: str
    container: str = ""


@dataclass
class Truth:
    """Where everything is, as it was said last."""

    containers: tuple[str, ...] = ()  # of the cell, as far as they are known
    _objects: list[TrueObject] | None = None
    _labelled: list[TrueObject] | None = None

    def on_objects(self, message: WorldObjects) -> None:
        """Take note of all objects; in old recordings they do not tell what becomes of them."""
        if all("state" in thing.model_fields_set for thing in message.objects):
            self._objects = [
                TrueObject((thing.pose.position.x, thing.pose.position.y, thing.pose.position.z), thing.state,
                      thing.container)
                for thing in message.objects
            ]

    def on_labels(self, message: PoseArray) -> None:
        """Take note of what is told as poses with labels."""
        labels = message.labels or [""] * len(message.poses)
        self._labelled = [
            TrueObject((pose.position.x, pose.position.y, pose.position.z), "contained" if label == BOX else label,
                  BOX if label == BOX else "")
            for pose, label in zip(message.poses, labels, strict=False)
        ]

    @property
    def things(self) -> list[TrueObject] | None:
        """Everything that there is; None when nobody said anything, as with real hardware."""
        if self._objects or self._labelled is None:
            return self._objects
        return self._labelled

    @property
    def settled(self) -> bool:
        """Whether nothing is on its way any more."""
        return not any(thing.state in ("falling", "held") for thing in self.things or ())

    def left(self, named: Sequence[Sequence[float]]) -> list[TrueObject]:
        """What lies in no container and at none of the places (x, y, ...) [m] that are named."""
        return [thing for thing in self.things or () if thing.state != "contained" and all(
            math.dist(thing.position[:2], place[:2]) > SAME for place in named)]

    def counted(self) -> dict[str, Any] | None:
        """How much lies in containers, on the table and anywhere else; None without simulated hardware."""
        if self.things is None:
            return None
        contained = _counts(self.containers, (t.container for t in self.things if t.state == "contained"))
        in_box, on_table = sum(contained.values()), sum(thing.state == "table" for thing in self.things)
        elsewhere = len(self.things) - in_box - on_table
        return {"in_box": in_box, "on_table": on_table, "elsewhere": elsewhere, "containers": contained}


def _counts(known: Iterable[str], found: Iterable[str]) -> dict[str, int]:
    counts = dict.fromkeys(known, 0)
    for name in found:
        counts[name] = counts.get(name, 0) + 1
    return counts




Array = npt.NDArray[np.float64]

MOST_LINES = 300  # of the log, and of anything else that is listed
SAME_PLACE = 0.002  # [m] detections closer than this are shown as one
_LEVELS = ("warning", "error", "critical")
_ENDED = ("succeeded", "aborted", "cancelled", "rejected")


@dataclass
class Span:
    """Something that lasted: `label` says what, `note` more of it. `until` is None while it lasts."""

    label: str
    since: float
    until: float | None = None
    note: str = ""


@dataclass
class Motion(Span):
    """A goal of the controller: its label is the id, its note the state in which it ended."""

    error: str = ""
    message: str = ""
    source: str = ""


@dataclass(frozen=True)
class Event:
    """Something that happened: `what` is who or which, `note` the rest."""

    time: float
    what: str
    note: str = ""
    level: str = ""


@dataclass(frozen=True)
class Place:
    """Something at a place in world [m]."""

    time: float
    position: tuple[float, float, float]
    label: str = ""


@dataclass(frozen=True, eq=False)
class Footprint:
    """A solid seen from above: corners (n, 2) in world [m]."""

    label: str
    role: str
    corners: Array
    color: tuple[float, float, float]


@dataclass(frozen=True)
class Service:
    """A process at the end of the recording."""

    state: str
    restarts: int
    ready_seconds: float | None


@dataclass
class RunHistory:
    """Feed it the messages of a run in the order in which they came."""

    tasks: list[Span] = field(default_factory=list)  # label: state, note: what is worked on
    paused: list[Span] = field(default_factory=list)
    held: list[Span] = field(default_factory=list)
    motions: list[Motion] = field(default_factory=list)
    holding: list[Span] = field(default_factory=list)
    trajectories: list[tuple[float, float]] = field(default_factory=list)  # when planned, how long it takes [s]
    latencies: list[float] = field(default_factory=list)  # of frames [ms]
    joint_times: list[float] = field(default_factory=list)
    joint_states: list[m.JointState] = field(default_factory=list)
    rejections: list[Place] = field(default_factory=list)
    skipped: dict[tuple[float, float, float], Place] = field(default_factory=dict)
    picks: list[Place] = field(default_factory=list)
    footprints: dict[str, Footprint] = field(default_factory=dict)
    services: dict[str, Service] = field(default_factory=dict)
    restarts: list[Event] = field(default_factory=list)
    failures: list[Event] = field(default_factory=list)  # of the task, and what it tries again
    losses: list[Event] = field(default_factory=list)  # by truth: what came to lie out of reach of everything
    log: list[Event] = field(default_factory=list)
    lines_left_out: int = 0
    counters: dict[str, m.ServiceCounters] = field(default_factory=dict)
    truth: Truth = field(default_factory=Truth)  # that of the fold which feeds this
    end: float = 0.0
    _target: str = ""
    _failed: int | None = None  # so far; what there was before the recording began is no event of it
    _before: str | None = None  # the goal that had ended by then
    _scene: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    _in_place: set[str] = field(default_factory=set)  # ids of objects that lay or moved where they may

    def listeners(self) -> dict[Topic[Any], Callable[[float, Any], None]]:
        """What of the platform's topics is listened to."""
        return {
            t.MOTION_STATUS: self.on_motion, t.GRIPPER_STATE: self.on_gripper, t.DISPLAY_TRAJECTORY: self.on_trajectory,
            t.JOINT_STATES: self.on_joints, t.PLANNING_SCENE: self.on_scene, t.SUPERVISOR_STATUS: self.on_services,
            t.LOG: self.on_log, t.COUNTERS: self.on_counters, t.SCENE_OBJECTS: self.on_objects,
        }

    def on_task(self, time: float, status: m.TaskStatus) -> None:
        """Take note of how far the task is."""
        self._target = status.subject or self._target
        _change(self.tasks, time, status.state, status.subject)
        failed = status.failures + status.retries
        if self._failed is not None and failed > self._failed:
            self.failures.append(Event(time, f"{status.state} {status.subject}".strip(), status.message))
        self._failed = failed  # fewer after the task was started again
        _while(self.paused, time, status.paused, "paused")
        for place in status.skipped:
            p = place.position
            self.skipped.setdefault((p.x, p.y, p.z), Place(time, (p.x, p.y, p.z), place.reason))

    def on_motion(self, time: float, status: m.MotionStatus) -> None:
        """Take note of the state of a goal."""
        _while(self.held, time, status.held, "held")
        if self._before is None:
            self._before = status.id if status.state in _ENDED else ""
        if status.id and status.id == self._before:
            return
        current = self.motions[-1] if self.motions else None
        if status.id and (current is None or current.label != status.id) and status.state != "none":
            current = Motion(status.id, time)
            self.motions.append(current)
        if current is not None and status.state in _ENDED and current.until is None:
            current.until, current.note = time, status.state
            current.error, current.message, current.source = status.error, status.message, status.source

    def on_gripper(self, time: float, state: m.GripperState) -> None:
        """Take note of what the fingers hold; what they begin to hold was picked."""
        if _while(self.holding, time, state.holding, self._target or "something") and self._target in self._scene:
            self.picks.append(Place(time, self._scene[self._target], self._target))

    def on_trajectory(self, time: float, trajectory: m.JointTrajectory) -> None:
        """Take note of a plan."""
        self.trajectories.append((time, trajectory.points[-1].time_from_start if trajectory.points else 0.0))

    def on_joints(self, time: float, state: m.JointState) -> None:
        """Take note of where the joints are."""
        self.joint_times.append(time)
        self.joint_states.append(state)

    def on_rejections(self, time: float, rejections: m.Rejections) -> None:
        """Take note of what is not offered, and why."""
        for one in rejections.rejected:
            self.rejections.append(Place(time, (one.position.x, one.position.y, one.position.z), one.reason))

    def on_scene(self, _time: float, scene: m.PlanningScene) -> None:
        """Take note of what the planner avoids. Where a target was seen last counts: the hand hides what it takes."""
        for thing in scene.objects:
            p = thing.pose.position
            if thing.role in ("target", "contained"):
                self._scene[thing.id] = (p.x, p.y, p.z)
            elif thing.id not in self.footprints:
                self.footprints[thing.id] = footprint(thing)

    def on_objects(self, time: float, world: m.WorldObjects) -> None:
        """Take note of what is lost; what lay there before the recording began was lost before."""
        for thing in world.objects:
            if thing.state != "elsewhere":
                self._in_place.add(thing.id)
            elif thing.id in self._in_place:
                self._in_place.discard(thing.id)
                p = thing.pose.position
                self.losses.append(Event(time, thing.id, f"lies elsewhere, at ({p.x:.3f}, {p.y:.3f}, {p.z:.3f})"))

    def on_services(self, time: float, status: m.SupervisorStatus) -> None:
        """Take note of the processes."""
        for one in status.services:
            before = self.services.get(one.name)
            if before is not None and one.restarts > before.restarts:
                self.restarts.append(Event(time, one.name, one.message))
            self.services[one.name] = Service(one.state, one.restarts, one.ready_seconds)

    def on_log(self, time: float, line: m.LogLine) -> None:
        """Take note of a warning or an error."""
        if line.level not in _LEVELS:
            return
        if len(self.log) < MOST_LINES:
            self.log.append(Event(time, line.service, line.message, line.level))
        else:
            self.lines_left_out += 1

    def on_counters(self, _time: float, counters: m.ServiceCounters) -> None:
        """Take note of what a service has counted since it was started."""
        self.counters[counters.service] = counters

    def finish(self, end: float) -> None:
        """End what still lasts."""
        self.end = end
        for spans in (self.tasks, self.paused, self.held, self.holding, self.motions):
            for span in spans:
                if span.until is None:
                    span.until = end
                    if isinstance(span, Motion):
                        span.note = "not ended"

    def joints(self, names: list[str]) -> tuple[Array, Array, Array]:
        """Times (n,) [s], positions (n, dof) [rad], velocities (n, dof) [rad/s] of joints; nan where none is told."""
        empty = [float("nan")] * len(names)
        times, positions, velocities = [], [], []
        for time, state in zip(self.joint_times, self.joint_states, strict=True):
            index = {name: k for k, name in enumerate(state.name)}
            if all(name in index for name in names):
                times.append(time)
                positions.append([state.position[index[name]] for name in names])
                velocities.append([state.velocity[index[name]] for name in names] if state.velocity else empty)
        shape = (len(times), len(names))
        return np.array(times), np.array(positions).reshape(shape), np.array(velocities).reshape(shape)


def footprint(thing: m.CollisionObject) -> Footprint:
    """A solid of the planning scene, seen from above; a cylinder or sphere as a polygon."""
    q, p = thing.pose.orientation, thing.pose.position
    x = (1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.z * q.w))
    y = (2 * (q.x * q.y - q.z * q.w), 1 - 2 * (q.x**2 + q.z**2))
    if thing.shape == "box":
        a, b = thing.dimensions[0] / 2, thing.dimensions[1] / 2
        flat = np.array([(a, b), (-a, b), (-a, -b), (a, -b)])
    elif thing.shape == "prism":
        flat = np.array(thing.outline)
    else:
        turn = np.linspace(0, 2 * np.pi, 49)[:-1]
        flat = thing.dimensions[0] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    corners = flat @ np.array([x, y]) + (p.x, p.y)
    return Footprint(thing.id, thing.role, corners, (thing.color.r, thing.color.g, thing.color.b))


def _change(spans: list[Span], time: float, label: str, note: str) -> None:
    if spans and (spans[-1].label, spans[-1].note) == (label, note):
        return
    if spans:
        spans[-1].until = time
    spans.append(Span(label, time, None, note))


def _while(spans: list[Span], time: float, lasts: bool, label: str) -> bool:
    """Begin or end a span; whether one began."""
    open_one = spans[-1] if spans and spans[-1].until is None else None
    if lasts and open_one is None:
        spans.append(Span(label, time))
        return True
    if not lasts and open_one is not None:
        open_one.until = time
    return False


def count_places(places: dict[tuple[int, int], int], poses: Iterable[m.Pose]) -> None:
    """Count how often something was at a place from above, by place in steps of `SAME_PLACE`."""
    for pose in poses:
        key = round(pose.position.x / SAME_PLACE), round(pose.position.y / SAME_PLACE)
        places[key] = places.get(key, 0) + 1
