"""The trajectory controller: takes goals, gives set-points, judges how well they are followed. No clock of its own.

An action's life: rejected at once, or active and then succeeded, aborted or cancelled. One goal at a time. While the
robot is held its goal stays active, at rest on its path; one that comes meanwhile is accepted and waits at its start.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable

import numpy as np

from common.control.checks import Tolerances, checked_trajectory
from common.control.goals import (
    MOST_SAMPLES,
    REMEMBERED,
    Goal,
    GoalMemory,
    Judged,
    blend_time,
    possible_share,
)
from common.control.limiter import Limiter
from common.errors import Refused
from common.hardware.interface import HardwareFault, Limits, Vector
from common.hardware.pace import Pace
from common.messages import GoalState, Holder, Interlock, JointTrajectory, MotionStatus
from common.messages.basics import clean

PERIOD = 0.01  # cell time between cycles, unless told otherwise [s]
LATE = 2  # periods: a cycle that comes later moves the arm by no more, and
STALLED = 2  # usual cycles: after one that comes later motion goes on from rest, where the arm is
USUAL = 0.2  # of what is usual is how it was the last time
LATER = 0.1  # cell time that an arm behind its set-points may be later than that: hosts and networks are no clocks [s]
RESEATED = 1.0  # cell time between two takings of an arm that was moved from outside: oftener it is not held [s]
RAMP_SHARE = 0.95  # of the accelerations is for going on: the rest is for what differences see of a bend
JERK_SHARE = 0.85  # the same of jerk, also in a stop: where the rate turns, that of the path comes on top
BEHIND = 1e-3  # [rad] between path and set-point, at which the goal's time stands still
ARRIVED = 1e-6  # [rad] nearer, the set-point is on the path
LONG = 3000  # points and samples of a trajectory, which cost a few milliseconds


class TrajectoryController:
    """Follows one trajectory at a time, and holds still between them."""

    def __init__(
        self, limits: Limits, start: Vector, tolerances: Tolerances | None = None, remember: int = REMEMBERED,
        name: str = "controller", period: float = PERIOD,
    ) -> None:
        """Hold at `start` (dof,) [rad] in cycles of `period` [s].

        Remember so many goals by their ids; sign reports with the name.
        """
        self._name = name
        self._limits = limits
        self._tolerances = tolerances or Tolerances()
        self._hold = start.copy()  # where to be; the newest set-point is the limiter's position
        self._limiter = Limiter(limits, start, period)
        self._period = self._usual = period
        self._last: float | None = None  # cell time of the newest set-point
        self._goal: Goal | None = None
        self._memory: GoalMemory[MotionStatus] = GoalMemory(remember)
        self._fault = ""
        self._found: Vector | None = None  # where the arm was read once, which says that it moves
        self._coasting = False  # from where the arm was found in motion, or jogged to, to rest, on no path
        self._jog: Vector | None = None  # velocities at which the arm is jogged (dof,) [rad/s]
        self._missed = self._let_go = False  # a goal ended with the arm off: where it rests is held; it was tried
        self._amiss = 0.0 * start  # of what is measured of an arm that stays off wherever it is held [rad]
        self._reseated = -math.inf  # cell time at which the arm was found moved from outside [s]
        self._moved = ""  # how it was, until it is told
        self._holds: dict[Holder, str] = {}  # the reasons, by who holds the robot
        self._status = MotionStatus()
        self.speed_scaling = 1.0
        self.delay = 0.0  # [s] that the arm is behind its set-points
        self.bridges = 0.0  # [s] between set-points that it fills by itself, as they are sent ahead of time
        self._sent: deque[tuple[float, Vector]] = deque()  # set-points of that time, and one before
        self.interlocks: list[Interlock] = []  # that reports tell of

    @property
    def status(self) -> MotionStatus:
        """What became of the newest goal, and whether and how fast the robot may move."""
        return self._as_of_now(self._status)

    @property
    def said(self) -> tuple[object, ...]:
        """What the status is made of, but for its progress: nothing else of it is new while this is the same."""
        return self._status, *self._holds.items(), self.speed_scaling, self.interlocks, self._fault

    @property
    def progress(self) -> float:
        """That of the status."""
        return self._status.progress

    @property
    def goal(self) -> str:
        """Id of the goal that moves the robot; empty when there is none."""
        return self._goal.id if self._goal else ""

    @property
    def set_point(self) -> Vector:
        """The newest set-point (dof,) [rad]."""
        return self._limiter.position

    @property
    def at_rest(self) -> bool:
        """Whether the set-points rest, or there are none because the hardware does not work."""
        return bool(self._fault) or self._limiter.at_rest

    def _as_of_now(self, status: MotionStatus) -> MotionStatus:
        now: dict[str, object] = {  # of what `said` has too
            "held": bool(self._holds), "held_by": sorted(self._holds), "speed_scaling": self.speed_scaling,
            "interlocks": self.interlocks, "fault": self._fault,
        }
        if status.state != "active" and not status.message:
            if self._fault:
                now["message"] = f"hardware fault: {self._fault}"
            elif self._holds:
                now["message"] = _told("held", self._holds.values())
        return status.model_copy(update=now)

    def accept(
        self, goal: str, trajectory: JointTrajectory, now: float, measured: Vector, objection: Refused | None = None,
        judged: Judged | None = None, plan: str = "", scene_stamp: int = 0,
    ) -> MotionStatus:
        """The state of the goal: active, or rejected with code and message; for a known id what became of it.

        Args:
            goal: id of the goal, minted by the requester. The same id never moves the robot twice.
            trajectory: what to follow.
            now: cell time [s].
            measured: where the robot is, (dof,) [rad].
            objection: what speaks against a new goal from the start.
            judged: what `judge` found out about the trajectory before.
            plan: id of the plan request that it answers, and
            scene_stamp: when the scene was seen that it was planned on [ns]: reports tell of both.
        """
        known = self._memory.get(goal)
        if known is not None:
            return self._as_of_now(known)
        try:
            if objection is not None:
                raise objection
            if self._fault:
                raise Refused("hardware_fault", self._fault)
            if self._goal is not None:
                raise Refused("busy", f"goal {self._goal.id!r} is still being followed")
            if self._last is None:
                self._seat(measured)
            elif self._coasting or self._found is not None or not self._limiter.at_rest:
                raise Refused("busy", "the arm is still coming to rest" if self._jog is None else "the arm is jogged")
            if self._missed or np.any(np.abs(self._amiss) > self._tolerances.start):
                self._require_followed(measured)
            begin = self._begin(measured)
            if judged is None:
                judged = self.judge(trajectory, measured, begin)
            elif np.any(np.abs(begin - judged.begin) > self._tolerances.start):
                raise Refused("busy", "the arm was moved while the trajectory was looked at")
            if judged.trajectory is None:
                assert judged.refusal is not None
                raise judged.refusal
            taken = self._taken(goal, judged, begin, now)
            taken.plan, taken.scene_stamp = plan, scene_stamp
        except Refused as refusal:
            rejected = MotionStatus(
                id=goal, state="rejected", error=refusal.code, message=str(refusal), source=self._name
            )
            return self._as_of_now(self._memory.put(goal, rejected, refused=True))
        if begin is not self._hold:
            self._seat(measured)
        self._goal, self._missed = taken, False
        return self._report("active", message=self._holding(taken))

    def takes_long(self, goal: str, trajectory: JointTrajectory) -> bool:
        """Whether to `judge` the trajectory of a new goal takes longer than there is time for between set-points."""
        points = trajectory.points
        seconds = points[-1].time_from_start if points else 0.0
        samples = len(points) + min(2 * seconds / self._period, MOST_SAMPLES)
        return samples > LONG and self._goal is None and not self.knows(goal)

    def judge(self, trajectory: JointTrajectory, measured: Vector, begin: Vector | None = None) -> Judged:
        """Whether and how a trajectory can be followed from where the arm is, measured (dof,) [rad], and holds now.

        Nothing is changed by it: any thread may ask.
        """
        begin = (self._begin(measured) if begin is None else begin).copy()
        try:
            checked = checked_trajectory(trajectory, self._limits, measured, self._tolerances)
            offset = begin - checked.positions[0]
            blend = blend_time(offset, checked.duration, self._limits)
            like = Goal("", checked, offset, blend, 0.0, Pace(0.0, 0.0 * begin))
            return Judged(begin, checked, possible_share(like, self._limits, self._period))
        except Refused as refusal:
            return Judged(begin, refusal=refusal)

    def _begin(self, measured: Vector) -> Vector:
        """Where a motion begins (dof,) [rad]: at the set-point, unless the arm was moved from outside since."""
        near = np.all(np.abs(self._hold - measured) <= self._tolerances.start)
        return self._hold if near else measured

    def _require_followed(self, measured: Vector) -> None:
        """Return when an arm that was off where it is held is no more."""
        off = np.abs(measured - self._hold)
        j = int(np.argmax(off))
        if off[j] > self._tolerances.start:
            raise Refused("not_followed", f"{self._limits.names[j]} is {off[j]:.4f} rad off where it is held")
        self._amiss = 0.0 * self._amiss

    def _taken(self, goal: str, judged: Judged, begin: Vector, now: float) -> Goal:
        assert judged.trajectory is not None
        offset = begin - judged.trajectory.positions[0]
        blend = blend_time(offset, judged.trajectory.duration, self._limits)
        pace = Pace(0.0, 0.0 * begin)
        if not self._holds:
            pace.rate = self.speed_scaling * judged.share
        return Goal(goal, judged.trajectory, offset, blend, now, pace, judged.share)

    def cancel(self, goal: str, reason: str, now: float) -> MotionStatus:
        """Begin to bring the robot to rest along its path. An empty id means whatever runs.

        The state stays active, with a message, until the robot is at rest, then it is cancelled. A goal that is over
        keeps its state, one that was never heard of has none.
        """
        running = self._goal
        if running is None or goal not in ("", running.id):
            if goal == "":
                return self.status
            unknown = f"no goal {goal!r} is known"
            return self._as_of_now(self._memory.get(goal) or MotionStatus(
                id=goal, error="unknown_goal", message=unknown, source=self._name
            ))
        if not running.stopping:
            running.stopping, running.reason = True, reason
        return self._report("active", message=f"stopping: {running.reason}")

    def hold(self, hold: bool, reason: str, by: Holder = "operator") -> MotionStatus:
        """The status: begin to bring the robot to rest on its path, or let it go on, unless another holds it."""
        if hold:
            self._holds[by] = reason
        else:
            self._holds.pop(by, None)
        if self._goal is not None and not self._goal.stopping:
            return self._report("active", message=self._holding(self._goal))
        return self.status

    def jog(self, velocity: Vector | None) -> None:
        """Go at joint velocities (dof,) [rad/s] until told others; None: come to rest. A goal is not disturbed."""
        if self._goal is not None or self._holds or self._fault or self._last is None or self._found is not None:
            velocity = None
        self._coasting = self._coasting or (velocity is None and self._jog is not None)
        self._jog = velocity

    def knows(self, goal: str) -> bool:
        """Whether a goal was heard of."""
        return self._memory.get(goal) is not None

    @property
    def end(self) -> Vector | None:
        """Where the goal that is followed ends (dof,) [rad]; None without one."""
        goal = self._goal
        return None if goal is None else goal.positions_at(np.array([goal.duration]))[0]

    def arrives_in(self, goal: str) -> float:
        """Until the arm is at the end of a goal, as far as is known now [s]; infinite when it may never be.

        One that comes to its speed yet is there sooner.
        """
        running = self._goal
        if running is None or running.id != goal:
            return 0.0 if self.succeeded(goal) else math.inf
        if running.stopping or self._holds:
            return math.inf
        if running.time >= running.duration:  # the set-points are there, the arm is as much later as it is behind them
            since = 0.0 if running.ended is None or self._last is None else self._last - running.ended
            return max(self.delay - since, 0.0)
        rate = min(running.pace.rate, self.speed_scaling * running.share)
        return (running.duration - running.time) / rate + self.delay if rate > 0.0 else math.inf

    def fails(self, goal: str) -> bool:
        """Whether the arm is not brought to the end of a goal any more."""
        if self._goal is not None and self._goal.id == goal:
            return self._goal.stopping
        return not self.succeeded(goal)

    def succeeded(self, goal: str) -> bool:
        """Whether the newest goal is that one, and the arm was brought to its end."""
        return self._status.id == goal and self._status.state == "succeeded"

    def _holding(self, goal: Goal) -> str:
        """What there is to say of a goal about being held."""
        if not self._holds:
            return ""
        return _told("held" if goal.pace.rate == 0.0 else "coming to rest", self._holds.values())

    def update(self, now: float, measured: Vector, measured_velocity: Vector) -> tuple[Vector, Vector] | None:
        """The set-points (dof,) [rad], [rad/s] for now; none before it is known where the arm is.

        `status` says what became of the goal.

        Args:
            now: cell time [s].
            measured: where the robot is, (dof,) [rad].
            measured_velocity: (dof,) [rad/s].
        """
        if self._fault or (self._last is None and self._goal is None):  # it may have sagged, or begin anywhere
            self._fault, self._last = "", None
            self._seat(measured)
            if np.any(np.abs(measured_velocity) > self._tolerances.stopped_velocity):
                self._found, self._last = measured.copy(), now
                return None  # does it move, or is that how fast it was told to?
        if self._found is not None:
            went = (measured - self._found) / max(now - (self._last or now), 1e-9)
            self._found, self._last = None, None
            self._seat(measured, np.where(went * np.sign(measured_velocity) > np.abs(measured_velocity) / 2,
                                          measured_velocity, 0.0))
        elapsed = self._period if self._last is None else max(now - self._last, 0.0)
        self._last = now
        late = elapsed > max(STALLED * self._usual, self.bridges) + 1e-6
        self._usual = max(self._period, self._usual + USUAL * (elapsed - self._usual))
        if late:  # the arm had no set-points meanwhile, and stands
            elapsed = self._period
            self._stalled(now - elapsed, measured)
        most = max(LATE * self._period, self.bridges)
        elapsed = min(elapsed, most)
        goal = self._goal
        if goal is not None:
            self._judge(goal, now, measured, measured_velocity)
        if goal is None or self._goal is None:
            return self._still(now, elapsed, measured, measured_velocity)
        braking = goal.stopping or bool(self._holds)
        share = max(self.speed_scaling, goal.pace.rate)
        waiting = max(0.0, 1 - goal.behind / BEHIND)
        goal.time = goal.pace.advance(
            goal.at, goal.time, 0.0 if braking else self.speed_scaling * goal.share * waiting,
            min(max(now - goal.last, 0.0), most),
            self._limits.braking if braking else RAMP_SHARE * self._limits.acceleration,
            JERK_SHARE * self._limits.jerks,
        )
        goal.last = now
        self._hold, change = goal.at(goal.time)
        set_point, velocity = self._limiter.step(
            self._hold, change * goal.pace.rate, elapsed, max(share, goal.pace.rate), braking
        )
        goal.behind = float(np.abs(self._hold - set_point).max())
        over = goal.time >= goal.duration or (goal.stopping and goal.pace.rate == 0.0)
        if over and goal.ended is None and goal.behind <= ARRIVED:
            goal.ended = now
        if not goal.stopping:
            message = self._holding(goal)
            if message == self._status.message:
                self._status.progress = goal.progress(self.delay)  # all else of it is as it was
                self._memory.put(goal.id, self._status)
            else:
                self._report("active", message=message)
        return set_point, velocity

    def _seat(self, measured: Vector, velocity: Vector | None = None) -> None:
        """Have set-points begin where the arm is (dof,) [rad]; at the velocity it has [rad/s], if it moves."""
        self._hold, self._amiss = measured.copy(), 0.0 * measured
        self._sent.clear()  # what was sent before is not followed any more
        self._jog = None
        self._coasting = velocity is not None and bool(np.any(np.abs(velocity) > self._tolerances.stopped_velocity))
        self._limiter.rest(measured, velocity if self._coasting else None)

    def _stalled(self, now: float, measured: Vector) -> None:
        """Go on from rest: at the newest set-point, or where the arm is when it is not there."""
        off = float(np.abs(measured - self._limiter.position).max())
        if self._goal is None:
            self._limiter.rest()
            return
        if off > self._tolerances.start:
            self._limiter.rest(measured)
            self._sent.clear()
            self._goal.behind = off
        else:
            self._limiter.rest()
        self._goal.last = now
        self._goal.pace.rest()
        if off > self._tolerances.path:
            name = self._limits.names[int(np.argmax(np.abs(measured - self._hold)))]
            self._hold = measured.copy()
            self._finish("aborted", "path_tolerance", f"{name} was moved by {off:.4f} rad while there were no "
                                                      f"set-points (tolerance {self._tolerances.path:g})")

    def _still(self, now: float, step: float, measured: Vector, velocity: Vector) -> tuple[Vector, Vector]:
        """Set-points (dof,) [rad], [rad/s] while there is no goal: of an arm that is held, or comes to rest.

        Raises:
            HardwareFault: the arm does not stay where it is held.
        """
        if self._jog is not None:
            off = np.abs(measured - self._due(now, measured)[1])
            if np.all(off <= self._tolerances.path):
                self._coasting = False
                set_point = self._limiter.go_at(self._jog, step)
                self._hold = set_point[0]
                return set_point
            self._jog, self._coasting = None, True
            self._missed, self._let_go = True, False
        if self._coasting:
            set_point = self._limiter.brake(step)
            self._coasting, self._hold = not self._limiter.at_rest, set_point[0]
            return set_point
        if self._limiter.at_rest and np.array_equal(self._limiter.position, self._hold):
            off = np.abs(measured - self._hold - self._amiss)
            moving = bool(np.any(np.abs(velocity) > self._tolerances.stopped_velocity))
            if np.all(off <= self._tolerances.start):
                self._missed = self._missed and moving
            elif self._missed:  # it may follow yet; where it rests then it is held, which is tried once
                if not moving:
                    self._amiss = measured - self._hold if self._let_go else self._amiss
                    self._hold = self._hold if self._let_go else measured.copy()
                    self._missed, self._let_go = not self._let_go, True
            else:
                j = int(np.argmax(off))
                told = f"{self._limits.names[j]} was moved from outside by {off[j]:.4f} rad"
                again, self._reseated = now - self._reseated < RESEATED, now
                if again:
                    raise HardwareFault(f"{told} again: the arm does not stay where it is held")
                self._moved = f"{told}: it is held where it is now"
                if self._status.state != "active":
                    self._status = self._status.model_copy(update={"message": self._moved})
                self._seat(measured, velocity)
                return self._still(now, step, measured, velocity)
        return self._limiter.step(self._hold, 0.0 * self._hold, step, self.speed_scaling, braking=True)

    def news(self) -> str:
        """A line when the arm was found moved from outside since the last call; else empty."""
        moved, self._moved = self._moved, ""
        return moved

    def abort(self, error: str, message: str, source: str = "") -> None:
        """Begin to bring the robot to rest along its path; then the goal is aborted, and the robot held where it is."""
        if self._goal is not None and not self._goal.error:
            self._goal.stopping, self._goal.reason, self._goal.error = True, message, error
            self._goal.source = source
            self._report("active", message=f"stopping: {message}")

    def fault(self, message: str) -> None:
        """End the running goal: the hardware does not work. Goals are rejected until `update` is called again."""
        self._fault = clean(message)
        if self._goal is not None:
            self._finish("aborted", "hardware_fault", message, "hardware")

    def _due(self, now: float, measured: Vector) -> tuple[Vector, Vector]:
        """Where the arm is to be now (dof,) [rad]: at the newest set-point, or at an older one if it is behind them.

        And of where it was to be within LATER before, if it is behind them, the nearest to where it is measured.
        """
        newest = self._limiter.position
        if self.delay == 0.0:
            return newest, newest
        self._sent.append((now, newest))
        while len(self._sent) > 1 and self._sent[1][0] <= now - self.delay - LATER:
            self._sent.popleft()
        due = [q for sent, q in self._sent if sent <= now - self.delay + 1e-6] or [self._sent[0][1]]
        return due[-1], min(due, key=lambda q: float(np.abs(measured - q).max()))

    def _judge(self, goal: Goal, now: float, measured: Vector, velocity: Vector) -> None:
        """End the goal when it is reached, or the robot is too far from the newest set-point."""
        allowed = self._tolerances
        due, nearest = self._due(now, measured)
        off = np.abs(measured - nearest)
        j = int(np.argmax(off))
        name = self._limits.names[j]
        if off[j] > allowed.path:
            self.abort("path_tolerance", f"{name} is {off[j]:.4f} rad off its path (tolerance {allowed.path:g})")
        off = np.abs(measured - due)
        j = int(np.argmax(off))
        name = self._limits.names[j]
        if goal.ended is None:
            return
        rest = bool(np.all(np.abs(velocity) <= allowed.stopped_velocity))
        waited = now - goal.ended > allowed.goal_time
        if goal.stopping:
            if rest or waited:
                self._missed, self._let_go = True, False
                if goal.error:
                    self._finish("aborted", goal.error, goal.reason, goal.source)
                else:
                    self._finish("cancelled", "cancelled", goal.reason)
        elif rest and off[j] <= allowed.goal:
            self._finish("succeeded")
        elif waited:
            what = f"{off[j]:.4f} rad off its goal (tolerance {allowed.goal:g})" if rest else "still moving"
            self._missed, self._let_go = True, False
            self._finish("aborted", "goal_tolerance", f"{name} is {what} {allowed.goal_time:g} s after the end")

    def _report(self, state: GoalState, error: str = "", message: str = "", source: str = "") -> MotionStatus:
        assert self._goal is not None
        progress = 1.0 if state == "succeeded" else self._goal.progress(self.delay)
        self._status = MotionStatus(
            id=self._goal.id, state=state, progress=progress, error=error, message=message, source=source or self._name,
            plan=self._goal.plan, scene_stamp=self._goal.scene_stamp,
        )
        return self._as_of_now(self._memory.put(self._goal.id, self._status))

    def _finish(self, state: GoalState, error: str = "", message: str = "", source: str = "") -> None:
        self._report(state, error, message, source)
        self._goal = None


def _told(what: str, reasons: Iterable[str]) -> str:
    return ": ".join([what, *filter(None, ["; ".join(filter(None, reasons))])])
