"""What must hold at every step of a cell, whatever happens to it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np

from common import topics
from common.application import find_application
from common.config import Cell
from common.hardware.interface import Limits, Vector
from common.messages import (
    CameraInfo,
    ExecuteRequest,
    GripperCommand,
    GripperState,
    HoldRequest,
    Image,
    LogLine,
    Message,
    MotionOwner,
    MotionStatus,
    OwnRequest,
    ParameterRequest,
    PlanRequest,
    PointCloud2,
    ServiceCounters,
    StopRequest,
    TaskCommand,
    WorldEdit,
    WorldObjects,
)
from common.topics import AnyTopic
from common.transport.codec import decode
from common.transport.local import intersects
from common.transport.session import RawSample
from lab.doubles import is_double
from lab.loop import Incarnation, current_incarnation
from lab.processes import RequestLog

Place = tuple[float, float, float]  # x, y, z [m]

GOALS = (ExecuteRequest, GripperCommand)
WITH_ID = (*GOALS, PlanRequest)
OVER = ("succeeded", "aborted", "cancelled")
SEEN_BY_CAMERAS = (Image, CameraInfo, PointCloud2, ServiceCounters, LogLine)  # what one who sees the truth may say
MOST_BROKEN = 5  # are told of
OLDEST = 2.3  # [s] from when a motion is decided to its begin; later ones are refused, by clocks that are wrong
LATE = 0.5  # [s] that the end of a request may come after its time-out
MOVED = 2e-3  # [m] farther from where it lay, a thing was moved
JUMP = 2.0  # [rad/s] times a period: from where the arm was to the first set-point of another process
AT_REST = 2.0  # [s] of cell time after which an arm that is held is at rest
STILL = 1e-9  # [rad]
ENDS = ("stop", "pause", "hold")
PERSON = "person"
EXECUTOR, RATE = "trajectory_executor", 100.0  # [Hz] its cycles, if the cell does not say
UNTOLD = 3  # set-points that may come before it is told of the goal, or of being let go
CYCLES = 2.5  # periods at most between two cycles of a controller in time; a late one moves no further
STALL = 0.3  # [s] of cell time after which a trajectory goes on where it was
CARRIED, CONTAINED, LOST = ("held", "falling"), "contained", "elsewhere"  # what the truth says of an object

OBJECTS = "no object lost or doubled"
TWO = "never two goals"
ONCE = "a goal id acts once"
LIMITS = "every set-point within limits"
FRESH = "no motion begins that was decided long ago"
GOAL = "the arm moves for a goal only"
HELD = "an arm that is held rests"
SLOW = "never faster than a person allows"
NEVER = "a goal that was stopped before it began never moves"
ALONE = "one of each name speaks"
ASKED = "no motion that nobody asked for since the last stop"
TRUTH = "nothing that decides saw the truth"
OUTCOMES = "every request ends in one of five ways"
NEWER = "nothing is read twice, or after what is newer"
BELIEVED = "as many lie there as the task says"
JUDGED = "everything is in the end where its application wants it"


def rate_of(cell: Cell) -> float:
    """Cycles of its controller per second of cell time."""
    entries = [entry for entry in cell.services.values() if entry.kind == EXECUTOR]
    return next((float(entry.parameters["joint_state_rate"]) for entry in entries
                 if "joint_state_rate" in entry.parameters), RATE)


def _speeds(request: ParameterRequest) -> list[float]:
    """The share of the speed that it sets, if it does."""
    values = [value for path, value in request.set.items() if path.endswith(".speed_scaling")]
    return [value for value in values if isinstance(value, float)]


@dataclass
class _Goals:
    """What one controller said of its goals."""

    active: str = ""
    life: str = ""  # of the process


class Invariants:
    """Looks at all messages, set-points and requests. `broken` says what did not hold, `checked` how many looks."""

    def __init__(self, cell: Cell, requests: RequestLog, now: Callable[[], float]) -> None:
        """Begin without having seen anything; `now` is the virtual time [s]."""
        self.broken: list[str] = []
        self.checked: Counter[str] = Counter()
        self.ended = False  # what comes from now on is no part of the run
        self.truth_readers: set[str] = set()  # processes that hear what only cameras may see
        self._requests, self._now = requests, now
        requests.on_ask, requests.on_serve, requests.on_answer = self._on_ask, self._on_serve, self._on_answer
        application = find_application(cell.application)
        self._fills, self._wrong_in = application.fills_containers, application.truth_check
        self._newest_truth = b""  # as it travelled
        self._doubles = {entry.name for entry in cell.services.values() if is_double(entry)}
        self._cycle = CYCLES / rate_of(cell)  # [s] of cell time
        known: dict[str, AnyTopic] = {**topics.platform_topics(), **application.topics_by_key}
        self._objects = f"{cell.name}/{topics.SCENE_OBJECTS.key}"
        self._truth = [self._objects, *(f"{cell.name}/{view.key}" for view in application.truth_views)]
        self._messages = {t.message.__name__: t.message for t in known.values()}
        self._log = f"/{topics.LOG.expression.partition('/')[0]}/"
        self._motion = f"{cell.name}/{topics.MOTION_STATUS.key}"
        self._gripper = f"{cell.name}/{topics.GRIPPER_STATE.key}"
        self._owner, self._jogged = f"{cell.name}/{topics.MOTION_OWNER.key}", False  # whether the arm moves by hand
        self._goals: dict[str, _Goals] = {}
        self._over: dict[tuple[str, str], str] = {}  # by key and goal
        self._ids: list[str] = []  # what there is
        self._edits = 0  # of the world, that were asked for and not answered yet
        self._edited = False  # and nothing was said of what there is since
        self._forces = cell.world.simulator != "kinematic"  # what lies is pushed, and rolls
        self._lying: dict[str, tuple[str, Place]] = {}  # by object: state and place
        self._held_since: float | None = None  # cell time
        self._last: tuple[Vector, Vector, float] | None = None  # newest set-points and when
        self._decided: dict[str, float] = {}  # by goal: when it was asked for first
        self._asked: dict[str, Message] = {}  # by id
        self._told: dict[tuple[str, str], bool] = {}  # by controller's process and goal: whether it was accepted
        self._moves: Incarnation | None = None  # the process whose set-points they are
        self._stray = 0  # set-points that moved without a goal
        self._restless = 0  # set-points that moved although the arm is held
        self._last_word = ""  # of persons: what they told the task, or "stop" to the executor
        self._ended = False  # the arm was stopped or is held, as a person said last
        self._ended_at: float | None = None  # cell time of the first set-point since
        self._ended_by: Incarnation | None = None  # the process that was told so, which brakes first
        self._unasked = 0  # set-points that moved nevertheless
        self._by_persons: set[str] = set()  # goals
        self._cap = 1.0  # share of the velocity that a person allows
        self._cap_at: float | None = None  # cell time of the first set-point since
        self._speaks: dict[str, str] = {}  # by service: the process that said anything last
        self._never: set[str] = set()  # goals that were stopped before anybody said that they move
        self._silent: dict[str, str] = {}  # processes whose place another one has taken: it
        self._parted: set[str] = set()  # processes that were cut off
        self._strange = 0

    def _broke(self, holds: object, what: str) -> bool:
        self.checked[what] += 1
        return not holds

    def _tell(self, what: str, how: str) -> None:
        if len(self.broken) < MOST_BROKEN:
            self.broken.append(f"{self._now():.3f} s: {what}: {how}")

    # --- messages -----------------------------------------------------------------------------------------------------

    def on_listen(self, service: str, key: str) -> None:
        """Take note of who subscribes to what."""
        if any(intersects(key, truth) for truth in self._truth):
            self.truth_readers.add(service)

    def on_put(self, service: str, life: str, sample: RawSample, parted: bool = False) -> None:
        """Look at what a process puts.

        Args:
            service: name of the process.
            life: name and number of it, another after each start.
            sample: as it travels.
            parted: whether it was cut off from the others before, so that another may have taken its place meanwhile.
        """
        self._parted |= {life} if parted else set()
        if self._log not in sample.key:  # who is refused may say so
            speaks = self._speaks.setdefault(service, life)
            after = self._silent.get(life, "")
            if self._broke(not after or self._parted & {life, after}, ALONE):
                self._tell(ALONE, f"{life} says {sample.key} after {after} did")
            if life != speaks:
                self._silent[speaks], self._speaks[service] = life, life
        if service in self.truth_readers and service not in self._doubles:
            model = self._messages.get(sample.encoding.rpartition(";")[2], Message)
            if self._broke(issubclass(model, SEEN_BY_CAMERAS), TRUTH):
                self._tell(TRUTH, f"{service} hears it and says {sample.key}")
        if sample.key == self._motion:
            motion = decode(MotionStatus, sample.payload)
            self._on_goal(sample.key, life, motion.id, motion.state)
            held = motion.held and motion.state == "active"
            self._held_since = None if not held else self._held_since or motion.header.stamp * 1e-9
        elif sample.key == self._gripper:
            gripper = decode(GripperState, sample.payload)
            self._on_goal(sample.key, life, gripper.id, gripper.state)
        elif sample.key == self._owner:
            self._jogged = decode(MotionOwner, sample.payload).jogging
        elif sample.key == self._objects:
            self._on_truth(msgpack.unpackb(sample.payload)["objects"])
            self._newest_truth = sample.payload

    def _on_goal(self, key: str, life: str, goal: str, state: str) -> None:
        known = self._goals.setdefault(key, _Goals())
        if life != known.life:  # another process, which knows nothing of goals before it
            known.life, known.active = life, ""
        before = self._over.get((key, goal), "")
        if self._broke(not before or state == before, ONCE):
            self._tell(ONCE, f"{key}: {goal} is {state} after it was {before}")
        if state in OVER:
            self._over[key, goal] = state
            if goal == known.active:
                known.active = ""
        elif state == "active":
            # The fingers' newer goal ends the older one.
            if self._broke(not known.active or goal == known.active or key == self._gripper, TWO):
                self._tell(TWO, f"{key}: {goal} is active while {known.active} is")
            if goal != known.active and self._broke(goal not in self._never, NEVER):
                self._tell(NEVER, goal)
            if goal != known.active and goal in self._decided:
                age = self._now() - self._decided[goal]
                if self._broke(age <= OLDEST, FRESH):
                    self._tell(FRESH, f"{goal} begins {age:.2f} s after it was asked for first")
            known.active = goal

    def _on_truth(self, objects: list[dict[str, Any]]) -> None:
        ids = sorted(str(thing["id"]) for thing in objects)
        touched, self._edited = self._edited, self._edits > 0  # somebody's hands were on the table
        if touched or not self._ids:
            self._ids = ids
        if self._broke(ids == self._ids and len(set(ids)) == len(ids), OBJECTS):
            self._tell(OBJECTS, f"{ids} instead of {self._ids}")
        things: dict[str, tuple[str, Place]] = {}
        for thing in objects:
            place = thing["pose"]["position"]
            things[thing["id"]] = thing["state"], (place["x"], place["y"], place["z"])
        held = [name for name, (state, _) in things.items() if state in CARRIED[:1]]
        if self._broke(len(held) <= 1, OBJECTS):
            self._tell(OBJECTS, f"{held} are held at once")
        for name, (state, place) in things.items():
            was, there = self._lying.get(name, (state, place))
            self._lying[name] = state, place
            way = 0.0 if state in CARRIED else math.dist(place, there)
            legal = touched or self._forces or state in CARRIED or was in CARRIED or (state == was and way < MOVED)
            if self._broke(legal and state != LOST, OBJECTS):
                self._tell(OBJECTS, f"{name} went from {was} to {state} by itself, {way:.3f} m")

    def on_clock(self, step: float) -> None:
        """Take note that cell time goes on from another time, later by so much [s]: the cell was brought up again."""
        if self._held_since is not None:
            self._held_since += step
        if self._ended_at is not None:
            self._ended_at += step
        if self._cap_at is not None:
            self._cap_at += step

    @property
    def ended_by_person(self) -> bool:
        """Whether the last word of a person was that the robot is to rest."""
        return self._last_word in ENDS

    # --- the arm ------------------------------------------------------------------------------------------------------

    def on_set_point(self, limits: Limits, measured: Vector, q: Vector, dq: Vector, now: float) -> None:
        """Look at set-points q (dof,) [rad] and dq [rad/s], given where the arm is, at cell time [s]."""
        if self.ended:
            return
        fastest = 1.03 * limits.velocity
        fits = (q >= limits.lower - 2e-3) & (q <= limits.upper + 2e-3) & (np.abs(dq) <= fastest)
        if self._broke(fits.all(), LIMITS):  # what is not a number is within nothing
            self._tell(LIMITS, f"q {np.round(q, 4).tolist()}, dq {np.round(dq, 3).tolist()}")
        last, self._last = self._last, (q.copy(), dq.copy(), now)
        if last is None:
            return
        passed, way = now - last[2], np.abs(q - last[0])
        before, self._moves = self._moves, current_incarnation()
        if passed <= 0 or passed > STALL or before is not self._moves:  # another process, or one that stood still
            if self._broke((way <= JUMP * self._cycle / CYCLES).all(), LIMITS):
                self._tell(LIMITS, f"a jump of {way.max():.3f} rad after {passed:.3f} s")
            return
        if self._broke((way <= fastest * min(passed, self._cycle) + 1e-3).all(), LIMITS):
            self._tell(LIMITS, f"a step of {way.max():.4f} rad in {passed * 1e3:.1f} ms")
        if passed > self._cycle:  # it goes on from rest
            last = (last[0], 0.0 * last[1], last[2])
        change = np.abs(dq - last[1])
        if self._broke((change <= 1.1 * limits.braking * max(passed, self._cycle / CYCLES) + 1e-3).all(), LIMITS):
            self._tell(LIMITS, f"velocity changes by {change.max():.3f} rad/s in {passed * 1e3:.1f} ms")
        if self._cap_at is None:
            self._cap_at = now
        if self._ended and self._ended_at is None:
            self._ended_at = now
        if way.max() <= STILL or passed > 2 * self._cycle:
            return
        goals = self._goals.get(self._motion)
        self._stray = 0 if self._jogged or (goals is not None and goals.active) else self._stray + 1
        if self._broke(self._stray <= UNTOLD, GOAL):
            self._tell(GOAL, f"{way.max():.4f} rad without one")
        resting = self._held_since is not None and now - self._held_since >= AT_REST
        self._restless = self._restless + 1 if resting else 0
        if self._broke(self._restless <= UNTOLD, HELD):
            self._tell(HELD, f"it moves {way.max():.4f} rad")
        if self._cap < 1 and now - self._cap_at >= AT_REST:
            too_fast = np.abs(dq) > fastest * self._cap + 1e-3
            if self._broke(not too_fast.any(), SLOW):
                self._tell(SLOW, f"dq {np.round(dq, 3).tolist()} at {self._cap:.0%}")
        brakes = (current_incarnation() is self._ended_by and self._ended_at is not None
                  and now - self._ended_at < AT_REST)
        asked = self._jogged or (goals is not None and goals.active in self._by_persons)
        unasked = self._ended and not brakes and not asked
        self._unasked = self._unasked + 1 if unasked else 0
        if self._broke(self._unasked <= UNTOLD, ASKED):
            self._tell(ASKED, f"it moves {way.max():.4f} rad for {goals.active if goals else 'nobody'}")

    # --- requests -----------------------------------------------------------------------------------------------------

    def _on_ask(self, service: str, request: Message) -> None:
        """An id stands for one thing, whoever asks for it and however often."""
        if isinstance(request, WITH_ID):
            known = self._asked.setdefault(request.id, request)
            if self._broke(known is request or known == request, ONCE):
                self._tell(ONCE, f"{request.id} is asked for twice, as {type(known).__name__} and another time as "
                                 f"{type(request).__name__}, which are not the same")
        if isinstance(request, TaskCommand):
            self._last_word = request.command
        elif isinstance(request, ParameterRequest):  # it holds before it is answered, and slower counts from then on
            self._cap = max([self._cap, *_speeds(request)])
        elif isinstance(request, StopRequest) and request.owner:  # of the task's own it has none
            self._last_word = "stop"
        elif isinstance(request, OwnRequest) and request.over:
            self._last_word = "stop"  # of a task
        elif isinstance(request, HoldRequest) and request.hold and service == PERSON:
            self._last_word = "hold"
        if self._last_word not in ENDS:
            self._ended, self._ended_at = False, None
        if isinstance(request, ExecuteRequest) and request.owner:
            self._by_persons.add(request.id)
        if isinstance(request, ExecuteRequest):
            self._decided.setdefault(request.id, self._now())
        elif isinstance(request, WorldEdit):
            self._edits, self._edited = self._edits + 1, True

    def _on_serve(self, life: str, request: Message, answer: Message) -> None:
        """Who asks for a goal again hears what became of it: what was accepted stays so, and what was refused too."""
        if isinstance(request, StopRequest) and request.id:
            unknown = getattr(answer, "error", "") == "unknown_goal"
            if unknown and (self._motion, request.id) not in self._over:
                self._never.add(request.id)
        if isinstance(request, ParameterRequest):
            for speed in _speeds(request):
                self._cap, self._cap_at = speed, None
        stop = isinstance(request, StopRequest) or (isinstance(request, HoldRequest) and request.hold)
        if stop and getattr(request, "by", "") == "operator" and self._last_word in ENDS:
            self._ended, self._ended_at, self._ended_by = True, None, current_incarnation()
        if isinstance(request, GOALS) and isinstance(answer, MotionStatus | GripperState):
            accepted = answer.state != "rejected"
            before = self._told.setdefault((life, request.id), accepted)
            if self._broke(before == accepted, ONCE):
                self._tell(ONCE, f"{request.id} was {'accepted' if before else 'refused'}, then asked for again and "
                                 f"{answer.state}: {answer.message}")

    def _on_answer(self, service: str, request: Message, answer: Message) -> None:
        if isinstance(request, WorldEdit):
            self._edits -= 1
        asked = isinstance(request, HoldRequest) and request.hold and isinstance(answer, MotionStatus)
        if asked and getattr(request, "goal", "") not in ("", getattr(answer, "id", "")):
            return  # nobody has to be held for a goal that is over
        if asked and self._broke(getattr(answer, "held", False), HELD):
            self._tell(HELD, f"it is not held when {service} asks for it")

    def look(self) -> None:
        """Look at the requests that are under way, and at what was read that should not have been."""
        now = self._now()
        for service, key, end in self._requests.open.values():
            if self._broke(now <= end + LATE, OUTCOMES):
                self._tell(OUTCOMES, f"{key} of {service} should have ended by {end:.1f} s")
        self.checked[OUTCOMES] += self._requests.begun
        for strange in self._requests.strange[self._strange:]:
            self._tell(OUTCOMES, strange)
        for repeated in self._requests.repeated[:1]:
            self._tell(NEWER, repeated)
        self.checked[NEWER] = self._requests.read
        self._strange = len(self._requests.strange)

    def on_end(self, done: int, state: str) -> None:
        """Compare what the task believes in the end with what there is."""
        if state == "DONE" and self._fills and not self._forces:  # how many a pile has, one camera does not see
            within = sum(label == CONTAINED for label, _ in self._lying.values())
            if self._broke(done == within, BELIEVED):
                self._tell(BELIEVED, f"{done} are, {within} really")
        if state == "DONE" and self._wrong_in is not None and self._newest_truth:
            wrong = self._wrong_in(decode(WorldObjects, self._newest_truth))
            if self._broke(not wrong, JUDGED):
                self._tell(JUDGED, wrong)
