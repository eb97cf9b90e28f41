"""Set-points of the arm: while it follows a goal, and at standstill, when it is held, coasts to rest, or is jogged."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from common.control.goals import Goal, Outcome
from common.control.limiter import Limiter
from common.control.trajectory import Tolerances
from common.errors import Refused
from common.hardware.interface import HardwareFault, Limits, Vector
from common.hardware.pace import RAMP_UP, SHORTEST_STOP

RAMP_SHARE = 0.95  # of the accelerations is for resuming: differences also see the curvature of the path
JERK_SHARE = 0.85  # the same of jerk, also in a stop: where the rate changes, that of the path is added
BEHIND = 1e-3  # [rad] between path and set-point at which the goal's time stops
ARRIVED = 1e-6  # [rad] closer, the set-point is on the path
JITTER = 0.1  # [s] cell time by which the delay of an arm behind its set-points may grow: hosts and networks vary
REWOUND, SAMPLES = 1.5, 1501  # [s] of a path, before the newest set-point, where an interrupted arm may have stopped
LONGEST_BLIND = 0.5  # [s] cell time without a cycle, after which a force motion does not continue
RELOCATION_PERIOD = 1.0  # [s] cell time: an arm moved from outside more often than this does not stay where it is held


class SetPointHistory:
    """The set-points of the last moments, for an arm that follows them with a delay.

    Attributes:
        delay: of the arm behind its set-points [s].
    """

    def __init__(self) -> None:
        """Start empty."""
        self.delay = 0.0
        self._sent: deque[tuple[float, Vector]] = deque()

    def clear(self) -> None:
        """Forget set-points that are not followed any more."""
        self._sent.clear()

    def record(self, now: float, newest: Vector) -> None:
        """Record the newest set-point (dof,) [rad]."""
        if self.delay == 0.0:
            self._sent.clear()
        self._sent.append((now, newest))
        while len(self._sent) > 1 and self._sent[1][0] <= now - self.delay - JITTER:
            self._sent.popleft()

    def expected(self, now: float, measured: Vector) -> tuple[Vector, Vector]:
        """Return where the arm should be now (dof,) [rad], at its delay.

        The second result is the set-point of the last JITTER before that which is closest to the measured position.
        """
        past = [q for sent, q in self._sent if sent <= now - self.delay + 1e-6] or [self._sent[0][1]]
        return past[-1], min(past, key=lambda q: float(np.abs(measured - q).max()))


class Standstill:
    """Holds the arm where its last motion ended, or where it was found.

    An arm that is moved from outside is held where it is found. One that ended a goal off its path is held where it
    comes to rest; if it is off there, too, it keeps that deviation and accepts no goal until it is gone.

    Attributes:
        position: where the arm is held (dof,) [rad]; with a goal, the newest position on its path.
        coasting: whether set-points come to rest from a velocity, on no path.
        jog_velocity: joint velocities of jogging (dof,) [rad/s], or None.
    """

    def __init__(
        self, limits: Limits, start: Vector, tolerances: Tolerances, limiter: Limiter, history: SetPointHistory,
        on_moved: Callable[[str], None],
    ) -> None:
        """Hold at `start` (dof,) [rad]; `on_moved` is called with a description when the arm was moved from outside."""
        self._limits, self._tolerances, self._limiter, self._history = limits, tolerances, limiter, history
        self._on_moved = on_moved
        self.position = start.copy()
        self.coasting = False
        self.jog_velocity: Vector | None = None
        self.full_speed = 0.0  # of the fastest joint in the newest jogging, with the arm's slider at 1 [rad/s]
        self._missed = self._relocated = False  # the last goal ended off its path; the arm was then held where it was
        self._deviation = 0.0 * start  # of an arm that stays off wherever it is held [rad]
        self._moved_at = -math.inf  # cell time at which the arm was last found moved from outside [s]
        self._coasted_at = -math.inf  # cell time at which jogging or coasting last changed the set-point [s]

    def locate(self, measured: Vector, velocity: Vector | None = None) -> None:
        """Start set-points where the arm is (dof,) [rad], at its velocity [rad/s] if it moves."""
        self.position, self._deviation = measured.copy(), 0.0 * measured
        self._history.clear()
        self.jog_velocity = None
        self.coasting = velocity is not None and bool(np.any(np.abs(velocity) > self._tolerances.stopped_velocity))
        self._limiter.rest(measured, velocity if self.coasting else None)

    def jog(self, velocity: Vector | None, slider: float = 1.0) -> None:
        """Jog at a share of joint velocities (dof,) [rad/s] until the next call; None: come to rest."""
        self.coasting = self.coasting or (velocity is None and self.jog_velocity is not None)
        self.jog_velocity = None
        if velocity is not None:
            self.jog_velocity, self.full_speed = slider * velocity, float(np.abs(velocity).max())

    def goal_missed(self) -> None:
        """Record that a goal ended with the arm off its path."""
        self._missed, self._relocated = True, False

    def goal_accepted(self) -> None:
        """Record that a goal takes over from here."""
        self._missed = False

    def is_trailing(self, measured: Vector, velocity: Vector) -> bool:
        """Return whether each joint that is off the newest set-point moves towards it: the arm is late, not moved."""
        behind = self._limiter.position - measured
        near = np.abs(behind) <= self._tolerances.start
        return bool(np.all(near | (np.sign(behind) * velocity > self._tolerances.stopped_velocity)))

    def start_of_motion(self, measured: Vector) -> Vector:
        """Return where a motion starts (dof,) [rad]: at the set-point, unless the arm was moved from outside since."""
        near = np.all(np.abs(self.position - measured) <= self._tolerances.start)
        return self.position if near else measured

    def require_followed(self, measured: Vector) -> None:
        """Return if the arm is where it is held.

        Raises:
            Refused: it is off there, as it was at the end of its last goal.
        """
        if not self._missed and not np.any(np.abs(self._deviation) > self._tolerances.start):
            return
        off = np.abs(measured - self.position)
        j = int(np.argmax(off))
        if off[j] > self._tolerances.start:
            raise Refused("not_followed", f"{self._limits.names[j]} is {off[j]:.4f} rad off where it is held")
        self._deviation = 0.0 * self._deviation

    def set_points(
        self, now: float, step: float, measured: Vector, velocity: Vector, share: float
    ) -> tuple[Vector, Vector]:
        """Return set-points (dof,) [rad], [rad/s] after a step [s], at a share of the velocity limits.

        Raises:
            HardwareFault: the arm does not stay where it is held.
        """
        if self.jog_velocity is not None or self.coasting:
            self._coasted_at = now
        self._history.record(now, self._limiter.position)
        if self.jog_velocity is not None:
            off = np.abs(measured - self._history.expected(now, measured)[1])
            if np.all(off <= self._tolerances.path):
                self.coasting = False
                set_point = self._limiter.go_at(self.jog_velocity, step)
                self.position = set_point[0]
                return set_point
            self.jog_velocity, self.coasting = None, True
            self.goal_missed()
        if self.coasting:
            set_point = self._limiter.brake(step)
            self.coasting, self.position = not self._limiter.at_rest, set_point[0]
            return set_point
        if self._limiter.at_rest and np.array_equal(self._limiter.position, self.position) and (
            self._moved_from_outside(now, measured, velocity)
        ):
            return self.set_points(now, step, measured, velocity, share)
        return self._limiter.step(self.position, 0.0 * self.position, step, share, braking=True)

    def _moved_from_outside(self, now: float, measured: Vector, velocity: Vector) -> bool:
        """Return whether the arm was moved while it is held; it is held where it is then."""
        off = np.abs(measured - self.position - self._deviation)
        moving = bool(np.any(np.abs(velocity) > self._tolerances.stopped_velocity))
        if np.all(off <= self._tolerances.start):
            self._missed = self._missed and moving
            return False
        if self._missed:  # it may still follow; hold it where it comes to rest, but only once
            if not moving:
                if self._relocated:
                    self._deviation = measured - self.position
                else:
                    self.position = measured.copy()
                self._missed, self._relocated = not self._relocated, True
            return False
        if np.all(np.abs(measured - self._history.expected(now, measured)[1]) <= self._tolerances.start):
            return False  # where it was commanded to be at the time of the reading
        if now - self._coasted_at <= self._tolerances.goal_time and self.is_trailing(measured, velocity):
            return False
        j = int(np.argmax(off))
        moved = f"{self._limits.names[j]} was moved from outside by {off[j]:.4f} rad"
        again, self._moved_at = now - self._moved_at < RELOCATION_PERIOD, now
        if again:
            raise HardwareFault(f"{moved} again: the arm does not stay where it is held")
        self._on_moved(f"{moved}: it is held where it is now")
        self.locate(measured, velocity)
        return True


class GoalFollower:
    """Moves the set-points along the path of a goal, and checks that the arm follows them."""

    def __init__(
        self, limits: Limits, tolerances: Tolerances, limiter: Limiter, history: SetPointHistory,
        standstill: Standstill,
    ) -> None:
        """Share limiter, history and the held position with the standstill."""
        self._limits, self._tolerances = limits, tolerances
        self._limiter, self._history, self._standstill = limiter, history, standstill

    def set_points(
        self, goal: Goal, now: float, elapsed: float, longest: float, speed_scaling: float, held: bool
    ) -> tuple[Vector, Vector]:
        """Return set-points (dof,) [rad], [rad/s] after a cycle.

        Args:
            goal: what to follow; its time advances.
            now: cell time [s].
            elapsed: since the newest set-point, cell time [s].
            longest: time by which the goal advances at most in a cycle [s].
            speed_scaling: share of its speed at which it is followed.
            held: whether the arm is to come to rest on its path.
        """
        if goal.force is not None:
            goal.last = now
            found = goal.force.set_points(goal, now, elapsed, self._limiter, speed_scaling, held)
            self._standstill.position = found[0]
            return found
        braking = goal.stopping or held
        share = max(speed_scaling, goal.pace.rate)
        goal.pace.ramp_up = SHORTEST_STOP if speed_scaling * goal.share < goal.pace.rate else RAMP_UP
        catching_up = max(0.0, 1 - goal.behind / BEHIND)
        if speed_scaling == 1.0:
            catching_up *= goal.rate_on_schedule(now)
        step = min(max(now - goal.last, 0.0), longest)
        if goal.time < 0.0 and not braking:  # it waits at rest: late cycles do not delay its start
            goal.time, goal.pace.rate = min(now - step - goal.start_at, 0.0), speed_scaling * goal.share
        goal.time = goal.pace.advance(
            goal.at, goal.time, 0.0 if braking else speed_scaling * goal.share * catching_up, step,
            self._limits.braking if braking else RAMP_SHARE * self._limits.acceleration,
            JERK_SHARE * self._limits.jerks,
        )
        goal.last = now
        position, change = goal.at(goal.time)
        self._standstill.position = position
        set_point, velocity = self._limiter.step(
            position, change * goal.pace.rate, elapsed, min(max(share, goal.pace.rate), 1.0), braking
        )
        goal.behind = float(np.abs(position - set_point).max())
        over = goal.time >= goal.duration or (goal.stopping and goal.pace.rate == 0.0)
        arrived = goal.behind <= ARRIVED or (share == 0.0 and self._limiter.at_rest)
        if over and goal.ended is None and arrived:
            goal.ended = now
        return set_point, velocity

    def rewind(self, goal: Goal, now: float, measured: Vector) -> Outcome | None:
        """Continue from rest at the place of the path where the arm is at rest; end a goal whose arm is not on it.

        Where the path passes there more than once, the first time counts. A force motion ends.
        """
        if goal.force is not None:
            return self._lost_force(measured)
        times = np.linspace(max(goal.time - REWOUND, 0.0), goal.time, SAMPLES)
        off = np.abs(goal.positions_at(times) - measured).max(axis=1)
        nearest = int(np.argmax(off <= off.min() + ARRIVED))
        goal.time = float(times[nearest])
        self._standstill.position = goal.at(goal.time)[0]
        self._limiter.rest(measured)
        self._history.clear()
        goal.behind, goal.last, goal.ended = float(off[nearest]), now, None
        goal.pace.rest()
        return self._check_place(measured, goal.behind)

    def resume_from_rest(self, goal: Goal, now: float, measured: Vector, velocity: Vector) -> Outcome | None:
        """Continue from rest at the newest set-point, or where the arm is; end a goal whose arm was moved too far."""
        if goal.force is not None and now - goal.last > LONGEST_BLIND:
            return self._lost_force(measured)
        off = float(np.abs(measured - self._limiter.position).max())
        if off > self._tolerances.start and not self._standstill.is_trailing(measured, velocity):
            self._limiter.rest(measured)
            self._history.clear()
            goal.behind = off
        else:
            self._limiter.rest()
        goal.last = now
        goal.pace.rest()
        if goal.force is not None:
            goal.force.resume(self._limiter.position)
        return self._check_place(measured, off)

    def _lost_force(self, measured: Vector) -> Outcome:
        self._standstill.position = measured.copy()
        self._limiter.rest(measured)
        self._history.clear()
        return Outcome("aborted", "interrupted", "there were no set-points for a while, and so no reaction to forces")

    def _check_place(self, measured: Vector, off: float) -> Outcome | None:
        if off <= self._tolerances.path:
            return None
        name = self._limits.names[int(np.argmax(np.abs(measured - self._standstill.position)))]
        self._standstill.position = measured.copy()
        return Outcome("aborted", "path_tolerance", f"{name} was moved by {off:.4f} rad while there were no set-points "
                                                   f"(tolerance {self._tolerances.path:g})")

    def off_path(self, now: float, measured: Vector) -> tuple[str, Vector]:
        """Return a message if the arm is off its path, and its distance from the expected set-point (dof,) [rad]."""
        self._history.record(now, self._limiter.position)
        expected, nearest = self._history.expected(now, measured)
        off = np.abs(measured - nearest)
        j = int(np.argmax(off))
        message = ""
        if off[j] > self._tolerances.path:
            message = (f"{self._limits.names[j]} is {off[j]:.4f} rad off its path "
                       f"(tolerance {self._tolerances.path:g})")
        return message, np.abs(measured - expected)

    def outcome(self, goal: Goal, now: float, off: Vector, velocity: Vector) -> Outcome | None:
        """Return how the goal ends when its set-points are at rest and the arm is, or has not settled in time.

        Args:
            goal: the goal that is followed.
            now: cell time [s].
            off: distance of the arm from its set-point, (dof,) [rad].
            velocity: measured, (dof,) [rad/s].
        """
        if goal.ended is None:
            return None
        allowed = self._tolerances
        at_rest = bool(np.all(np.abs(velocity) <= allowed.stopped_velocity))
        timed_out = now - goal.ended > allowed.goal_time
        if goal.force is not None and not goal.stopping and goal.force.end is not None:
            return goal.force.end if at_rest or timed_out else None
        j = int(np.argmax(off))
        if goal.stopping:
            if not at_rest and not timed_out:
                return None
            self._standstill.goal_missed()
            if goal.error:
                return Outcome("aborted", goal.error, goal.reason, goal.source)
            return Outcome("cancelled", "cancelled", goal.reason)
        if at_rest and off[j] <= allowed.goal:
            return Outcome("succeeded")
        if not timed_out:
            return None
        what = f"{off[j]:.4f} rad off its goal (tolerance {allowed.goal:g})" if at_rest else "still moving"
        self._standstill.goal_missed()
        return Outcome("aborted", "goal_tolerance",
                      f"{self._limits.names[j]} is {what} {allowed.goal_time:g} s after the end")
