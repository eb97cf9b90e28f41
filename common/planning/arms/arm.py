"""What the coordinator of several arms knows about each of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from common.hardware.interface import Limits
from common.planning.arms import way_back
from common.planning.arms.band import Delays
from common.planning.arms.pair_world import ArmBody, ArmGeometry
from common.planning.arms.proofs import SAME_POSE, Moving, resting
from common.planning.arms.timed_pairs import ArmMotion, Schedule
from common.planning.trajectory import TimedPath

Array = NDArray[np.float64]

@dataclass(frozen=True)
class Options:
    """Settings of a coordinator.

    Attributes:
        clearance: between two arms [m], beyond their tracking errors.
        patience: how long an arm at rest obstructs an older request before it moves back [s].
        overtaken: how long younger requests may overtake an older one [s].
        longest_wait: after which a request is refused [s].
        effort: cells that may be measured in a step, about 0.1 ms each; longer proofs take several steps.
        turns: one arm moves at a time.
    """

    clearance: float = 0.02
    patience: float = 1.0
    overtaken: float = 5.0
    longest_wait: float = 120.0
    effort: int = 300
    turns: bool = False
    delays: Delays = field(default_factory=Delays)


@dataclass(frozen=True)
class Observed:
    """What an executor reports about its arm at cell time `stamp` [s]."""

    stamp: float
    q: Array
    goal: str = ""  # active goal
    path_time: float = 0.0
    held_by_others: bool = False  # than the coordinator
    held: bool = False  # by the coordinator
    scaling: float = 1.0
    at_rest: bool = True  # the arm does not move, whether it follows a goal or not
    movable: bool = True  # the coordinator may request a motion: no stop, no fault, no operator controls it
    grips: bool = False  # the fingers move


@dataclass(eq=False)
class Ticket:
    """A request that waits; the number is its place in the order."""

    number: int
    goal: str
    moving: Moving | None  # None: it asks to move alone
    first: float
    last: float
    possible: bool = False  # it was proved against the home poses of all other arms
    reason: str = ""
    waits_for: set[str] = field(default_factory=set)
    ways: tuple[TimedPath | None, Moving, Moving | None] | None = None  # way back from its start; straight, reversed

    @cached_property
    def end(self) -> Moving:
        """Pose at rest after its motion; one object, so that proofs with it continue in the next step."""
        assert self.moving is not None
        return resting(self.moving.body, self.moving.motion.end)


@dataclass(eq=False)
class Committed:
    """A motion that may run.

    Attributes:
        end: pose at rest after it.
        back: way back from its end, with what the arm carries.
        before: way back from its start.
        parked_for: arms that move on while this one waits, held, at a proved place.
    """

    goal: str
    moving: Moving
    schedule: Schedule
    end: Moving
    back: Moving | None
    before: TimedPath | None
    since: float
    braking: float
    seen: bool = False
    parked_for: set[str] = field(default_factory=set)

    @property
    def motion(self) -> ArmMotion:
        """Its motion."""
        return self.moving.motion


class Arm:
    """What the coordinator knows about one arm."""

    def __init__(self, geometry: ArmGeometry) -> None:
        robot = geometry.robot
        config = robot.config
        self.name, self.geometry = geometry.name, geometry
        deceleration = np.array(config.deceleration_limits) if config.deceleration_limits else None
        self.limits = Limits(tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration,
                             deceleration, robot.jerk)
        self.body: ArmBody = geometry.body()
        self.home = resting(self.body, geometry.home)
        self.state: Observed | None = None
        self.rest: Moving = self.home
        self.rest_since = 0.0
        self.back: Moving | None = self.home
        self.ticket: Ticket | None = None
        self.committed: Committed | None = None
        self.hold = ""  # why it is held on its path; empty while it may move

    @property
    def end(self) -> Moving:
        """Pose at rest, now or after its committed motion."""
        return self.rest if self.committed is None else self.committed.end

    @property
    def here(self) -> Moving:
        """Pose on its committed motion, while it is held there."""
        assert self.committed is not None
        q = self.committed.motion.at(self.done)
        if self._here is None or self._here.body is not self.committed.moving.body or (
                np.abs(q - self._here.motion.end).max() > 0):
            self._here = resting(self.committed.moving.body, q)
        return self._here

    _here: Moving | None = None

    @property
    def way_back(self) -> Moving | None:
        """Way home from that pose."""
        return self.back if self.committed is None else self.committed.back

    def set_rest(self, q: Array, now: float) -> None:
        """Record its pose at rest (dof,) [rad]; a way back from elsewhere is forgotten."""
        if self.rest.body is self.body and np.abs(q - self.rest.motion.end).max() <= SAME_POSE:
            return
        moved = np.abs(q - self.rest.motion.end).max() > SAME_POSE
        self.rest = resting(self.body, q)
        if moved:
            self.rest_since = now
        if self.back is not None and np.abs(q - self.back.motion.start).max() > way_back.CLOSE:
            self.back = None
        elif self.back is not None and self.back.body is not self.body:
            self.back = replace(self.back, body=self.body)

    @property
    def done(self) -> float:
        """How far it is along its committed motion, own time [s]."""
        assert self.committed is not None
        if self.state is None or self.state.goal != self.committed.goal:
            return self.committed.motion.duration if self.committed.seen else 0.0
        return min(max(self.state.path_time, 0.0), self.committed.motion.duration)

    def lag(self, now: float, report: float) -> float:
        """Return by how much it is behind the schedule of its committed motion [s]; reports come every `report` [s]."""
        run, state, done = self.committed, self.state, self.done
        assert run is not None
        if done >= run.motion.duration - 1e-3:
            return 0.0
        if run.schedule.is_starting(done):
            return max(now - run.schedule.time(done), 0.0)
        if state is not None and not (state.held or state.held_by_others):
            done += min(max(now - state.stamp, 0.0), report) * run.schedule.rate
        return now - run.schedule.time(done)

    @property
    def is_home(self) -> bool:
        """Whether it is at rest at home."""
        return self.committed is None and bool(
            np.abs(self.rest.motion.end - self.geometry.home).max() <= way_back.CLOSE)

    @property
    def is_frozen(self) -> bool:
        """Whether a motion in progress stays where it is: others hold the arm, or it is parked."""
        return self.committed is not None and self.state is not None and (
            self.state.held_by_others or bool(self.committed.parked_for))
