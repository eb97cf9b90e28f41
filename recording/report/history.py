"""History of a run for its report, and its ground truth. Times are wall time since the start of the recording [s]."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from common import messages as m
from common import topics as t
from common.topics import Topic

Array = npt.NDArray[np.float64]
Position = tuple[float, float, float]  # x, y, z [m] in world

SAME_OBJECT = 0.05  # [m] from an object to its detection: less accurate at the image border
BOX = "box"  # the container in recordings without container ids
MOST_LINES = 300  # of the log, and of any other list
MOST_ENTRIES = 20_000  # of a list of the history; later ones are left out
MOST_JOINT_STATES = 100_000  # 17 min at 100 Hz; of a longer recording every second, fourth, ... is used
SAME_PLACE = 0.002  # [m] detections closer than this are shown as one
_LEVELS = ("warning", "error", "critical")
_ENDED = ("succeeded", "aborted", "cancelled", "rejected")


# --- ground truth, for evaluation only --------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrueObject:
    """An object: centre in world, state, and the container that it is in."""

    position: Position
    state: str
    container: str = ""


@dataclass
class Truth:
    """Newest ground truth of the objects."""

    containers: tuple[str, ...] = ()  # ids of those that objects are put into, if known
    world: m.WorldObjects | None = None
    _objects: list[TrueObject] | None = None
    _labelled: list[TrueObject] | None = None

    def on_objects(self, message: m.WorldObjects) -> None:
        """Store the true objects of a message; old recordings lack their state and are ignored."""
        if all("state" in each.model_fields_set for each in message.objects):
            self.world = message
            self._objects = [TrueObject(_xyz(each.pose), each.state, each.container) for each in message.objects]

    def on_labels(self, message: m.PoseArray) -> None:
        """Take labelled poses."""
        labels = message.labels or [""] * len(message.poses)
        self._labelled = [
            TrueObject(_xyz(pose), "contained" if label == BOX else label, BOX if label == BOX else "")
            for pose, label in zip(message.poses, labels, strict=False)
        ]

    @property
    def objects(self) -> list[TrueObject] | None:
        """All objects; None if no ground truth is published, as with real hardware."""
        if self._objects or self._labelled is None:
            return self._objects
        return self._labelled

    @property
    def settled(self) -> bool:
        """Whether no object falls or is held."""
        return not any(each.state in ("falling", "held") for each in self.objects or ())

    def left(self, explained: Sequence[Sequence[float]]) -> list[TrueObject]:
        """Return the objects that are not put away and at none of the explained positions (x, y, ...) [m]."""
        return [each for each in self.objects or () if not self._is_put_away(each) and all(
            math.dist(each.position[:2], place[:2]) > SAME_OBJECT for place in explained)]

    def _is_put_away(self, each: TrueObject) -> bool:
        return each.state == "contained" and (not self.containers or each.container in self.containers)

    def is_left_at(self, place: Sequence[float]) -> bool:
        """Return whether an object that is not put away is at a position (x, y, ...) [m]."""
        return len(self.left([place])) < len(self.left([]))

    def counted(self) -> dict[str, Any] | None:
        """Return the number of objects in containers, on the table and elsewhere; None without ground truth.

        Objects in a container that objects are taken out of are only in the count of that container.
        """
        if self.objects is None:
            return None
        contained = dict.fromkeys(self.containers, 0)
        for each in self.objects:
            if each.state == "contained":
                contained[each.container] = contained.get(each.container, 0) + 1
        in_box = sum(self._is_put_away(each) for each in self.objects)
        on_table = sum(each.state == "table" for each in self.objects)
        elsewhere = len(self.objects) - sum(contained.values()) - on_table
        return {"in_box": in_box, "on_table": on_table, "elsewhere": elsewhere, "containers": contained}


# --- history ----------------------------------------------------------------------------------------------------------


@dataclass
class Span:
    """A period with a label and a note. `until` is None while it is open."""

    label: str
    since: float
    until: float | None = None
    note: str = ""


@dataclass
class Motion(Span):
    """A goal of the controller: the label is its id, the note its end state."""

    error: str = ""
    message: str = ""
    source: str = ""


@dataclass(frozen=True)
class Event:
    """A moment: `what` names the subject, `note` the rest."""

    time: float
    what: str
    note: str = ""
    level: str = ""


@dataclass(frozen=True)
class Mark:
    """A labelled position."""

    time: float
    position: Position
    label: str = ""


@dataclass(frozen=True, eq=False)
class Footprint:
    """A solid from above: corners (n, 2) in world [m]."""

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
    """What happened in a run, from its messages in order of arrival."""

    tasks: list[Span] = field(default_factory=list)  # label: state, note: subject
    paused: list[Span] = field(default_factory=list)
    held: list[Span] = field(default_factory=list)
    motions: list[Motion] = field(default_factory=list)
    holding: list[Span] = field(default_factory=list)
    trajectories: list[tuple[float, float]] = field(default_factory=list)  # time of planning, duration [s]
    latencies: list[float] = field(default_factory=list)  # of frames [ms]
    joint_times: list[float] = field(default_factory=list)
    joint_states: list[m.JointState] = field(default_factory=list)
    rejections: list[Mark] = field(default_factory=list)
    skipped: dict[Position, Mark] = field(default_factory=dict)
    picks: list[Mark] = field(default_factory=list)
    footprints: dict[str, Footprint] = field(default_factory=dict)
    services: dict[str, Service] = field(default_factory=dict)
    restarts: list[Event] = field(default_factory=list)
    failures: list[Event] = field(default_factory=list)  # failures and retries of the task
    losses: list[Event] = field(default_factory=list)  # by ground truth: objects out of reach
    signals: list[Event] = field(default_factory=list)  # changes of inputs and outputs, and losses of their backend
    log: list[Event] = field(default_factory=list)
    lines_left_out: int = 0
    counters: dict[str, m.ServiceCounters] = field(default_factory=dict)
    truth: Truth = field(default_factory=Truth)  # that of the aggregator
    end: float = 0.0
    _joint_count: int = 0
    _joint_stride: int = 1
    _target: str = ""
    _failed: int | None = None  # failures so far; those before the recording are no events
    _ended_before: str | None = None  # goal that had ended before the recording
    _scene: dict[str, Position] = field(default_factory=dict)
    _signals: dict[str, str] = field(default_factory=dict)  # newest values as text
    _in_place: set[str] = field(default_factory=set)  # ids of objects that were not lost

    def listeners(self) -> dict[Topic[Any], Callable[[float, Any], None]]:
        """Return listeners of the platform's topics."""
        return {
            t.MOTION_STATUS: self.on_motion, t.GRIPPER_STATE: self.on_gripper, t.DISPLAY_TRAJECTORY: self.on_trajectory,
            t.JOINT_STATES: self.on_joints, t.PLANNING_SCENE: self.on_scene, t.SUPERVISOR_STATUS: self.on_services,
            t.IO_STATE: self.on_signals, t.LOG: self.on_log, t.COUNTERS: self.on_counters,
            t.SCENE_OBJECTS: self.on_objects,
        }

    def on_task(self, time: float, status: m.TaskStatus) -> None:
        """Add a task status."""
        self._target = status.subject or self._target
        _change(self.tasks, time, status.state, status.subject)
        failed = status.failures + status.retries
        if self._failed is not None and failed > self._failed:
            _append(self.failures, Event(time, f"{status.state} {status.subject}".strip(), status.message))
        self._failed = failed  # lower after a restart of the task
        _while(self.paused, time, status.paused, "paused")
        for place in status.skipped:
            p = place.position
            if len(self.skipped) < MOST_ENTRIES:
                self.skipped.setdefault((p.x, p.y, p.z), Mark(time, (p.x, p.y, p.z), place.reason))

    def on_motion(self, time: float, status: m.MotionStatus) -> None:
        """Add a motion status."""
        _while(self.held, time, status.held, "held")
        if self._ended_before is None:
            self._ended_before = status.id if status.state in _ENDED else ""
        if status.id and status.id == self._ended_before:
            return
        current = self.motions[-1] if self.motions else None
        if status.id and (current is None or current.label != status.id) and status.state != "none":
            current = Motion(status.id, time)
            _append(self.motions, current)
        if current is not None and status.state in _ENDED and current.until is None:
            current.until, current.note = time, status.state
            current.error, current.message, current.source = status.error, status.message, status.source

    def on_gripper(self, time: float, state: m.GripperState) -> None:
        """Add a gripper state; the start of holding is a pick."""
        if _while(self.holding, time, state.holding, self._target or "something") and self._target in self._scene:
            _append(self.picks, Mark(time, self._scene[self._target], self._target))

    def on_trajectory(self, time: float, trajectory: m.JointTrajectory) -> None:
        """Add a plan."""
        _append(self.trajectories, (time, trajectory.points[-1].time_from_start if trajectory.points else 0.0))

    def on_signals(self, time: float, state: m.IoState) -> None:
        """Add changes of inputs and outputs; the first values are no changes."""
        shown = {"backend": state.reason or "connected"}
        for signal in state.signals:
            value = ("on" if signal.value else "off") if isinstance(signal.value, bool) else signal.value
            if signal.value is not None:
                shown[signal.name] = signal.reason or f"{value} {signal.unit}".rstrip()
        for name, value in shown.items():
            if self._signals.setdefault(name, value) != value:
                _append(self.signals, Event(time, name, value))
                self._signals[name] = value

    def on_joints(self, time: float, state: m.JointState) -> None:
        """Add joint states."""
        self._joint_count += 1
        if self._joint_count % self._joint_stride:
            return
        if len(self.joint_states) >= MOST_JOINT_STATES:
            del self.joint_times[::2], self.joint_states[::2]
            self._joint_stride *= 2
        self.joint_times.append(time)
        self.joint_states.append(state)

    def on_rejections(self, time: float, rejections: m.Rejections) -> None:
        """Add rejected targets."""
        for one in rejections.rejected:
            _append(self.rejections, Mark(time, (one.position.x, one.position.y, one.position.z), one.reason))

    def on_scene(self, _time: float, scene: m.PlanningScene) -> None:
        """Add obstacles, and the newest position of each target: the gripper occludes it during the grasp."""
        for item in scene.objects:
            if item.role in ("target", "contained"):
                self._scene[item.id] = _xyz(item.pose)
            elif item.id not in self.footprints and len(self.footprints) < MOST_ENTRIES:
                self.footprints[item.id] = footprint(item)

    def on_objects(self, time: float, world: m.WorldObjects) -> None:
        """Add objects that are lost, unless they were before the recording."""
        for each in world.objects:
            if each.state != "elsewhere":
                self._in_place.add(each.id)
            elif each.id in self._in_place:
                self._in_place.discard(each.id)
                position = "({:.3f}, {:.3f}, {:.3f})".format(*_xyz(each.pose))
                _append(self.losses, Event(time, each.id, f"lies elsewhere, at {position}"))

    def on_services(self, time: float, status: m.SupervisorStatus) -> None:
        """Add the states of processes."""
        for one in status.services:
            before = self.services.get(one.name)
            if before is not None and one.restarts > before.restarts:
                _append(self.restarts, Event(time, one.name, one.message))
            self.services[one.name] = Service(one.state, one.restarts, one.ready_seconds)

    def on_log(self, time: float, line: m.LogLine) -> None:
        """Add a warning or error."""
        if line.level not in _LEVELS:
            return
        if len(self.log) < MOST_LINES:
            self.log.append(Event(time, line.service, line.message, line.level))
        else:
            self.lines_left_out += 1

    def on_counters(self, _time: float, counters: m.ServiceCounters) -> None:
        """Add the counters of a service since its start."""
        self.counters[counters.service] = counters

    def finish(self, end: float) -> None:
        """Close all open spans."""
        self.end = end
        for spans in (self.tasks, self.paused, self.held, self.holding, self.motions):
            for span in spans:
                if span.until is None:
                    span.until = end
                    if isinstance(span, Motion):
                        span.note = "not ended"

    def joints(self, names: list[str]) -> tuple[Array, Array, Array]:
        """Return times (n,) [s], positions (n, dof) [rad] and velocities (n, dof) [rad/s], NaN where not recorded."""
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


def footprint(item: m.CollisionObject) -> Footprint:
    """Return a solid of the planning scene from above; a cylinder or sphere as a polygon."""
    q, p = item.pose.orientation, item.pose.position
    x = (1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.z * q.w))
    y = (2 * (q.x * q.y - q.z * q.w), 1 - 2 * (q.x**2 + q.z**2))
    if item.shape == "box":
        a, b = item.dimensions[0] / 2, item.dimensions[1] / 2
        flat = np.array([(a, b), (-a, b), (-a, -b), (a, -b)])
    elif item.shape == "prism":
        flat = np.array(item.outline)
    else:
        turn = np.linspace(0, 2 * np.pi, 49)[:-1]
        flat = item.dimensions[0] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    corners = flat @ np.array([x, y]) + (p.x, p.y)
    return Footprint(item.id, item.role, corners, (item.color.r, item.color.g, item.color.b))


def _xyz(pose: m.Pose) -> Position:
    return pose.position.x, pose.position.y, pose.position.z


def _append(entries: list[Any], entry: object) -> None:
    if len(entries) < MOST_ENTRIES:
        entries.append(entry)


def _change(spans: list[Span], time: float, label: str, note: str) -> None:
    """Start a new span if label or note change."""
    if spans and (spans[-1].label, spans[-1].note) == (label, note):
        return
    if spans:
        spans[-1].until = time
    _append(spans, Span(label, time, None, note))


def _while(spans: list[Span], time: float, active: bool, label: str) -> bool:
    """Open or close a span; return whether one was opened."""
    open_one = spans[-1] if spans and spans[-1].until is None else None
    if active and open_one is None:
        _append(spans, Span(label, time))
        return True
    if not active and open_one is not None:
        open_one.until = time
    return False


def count_positions(places: dict[tuple[int, int], int], poses: Iterable[m.Pose]) -> None:
    """Count poses by their position from above, in steps of `SAME_PLACE`."""
    for pose in poses:
        key = round(pose.position.x / SAME_PLACE), round(pose.position.y / SAME_PLACE)
        places[key] = places.get(key, 0) + 1
