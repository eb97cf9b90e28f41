"""The trajectory controller: accepts goals, returns set-points, checks how well the arm follows. It has no clock.

Life of a goal: rejected at once, or active and then succeeded, aborted or cancelled. One goal at a time. While the
robot is held its goal stays active, at rest on its path; a goal accepted meanwhile waits at its start.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from common.control.goals import (
    MAX_SAMPLES,
    REMEMBERED,
    Assessment,
    ForceControl,
    Goal,
    GoalReports,
    Outcome,
    time_at,
)
from common.control.joining import Join, join_goal
from common.control.limiter import Limiter
from common.control.set_points import GoalFollower, SetPointHistory, Standstill
from common.control.trajectory import Tolerances, Trajectory, checked_trajectory, to_message
from common.errors import Refused
from common.hardware.interface import HardwareFault, Limits, Vector
from common.messages import Holder, JointTrajectory, MotionStatus
from common.messages.basics import clean

PERIOD = 0.01  # [s] cell time between cycles, by default
LATE = 2  # periods: a later cycle moves the arm by no more, and
STALLED = 2  # usual cycles: after a later one the motion resumes from rest, where the arm is
USUAL_SHARE = 0.2  # weight of the newest cycle in the mean duration of cycles
FROZEN, RECENT = 0.15, 0.5  # [s] cell time between cycles after which an interruption ends a motion, if it was recent
REST_TIMEOUT = 5.0  # [s] for an interrupted arm to come to rest: a low slider makes it slow
LONG = 3000  # points and samples of a trajectory, which cost a few milliseconds


class TrajectoryController:
    """Follows one trajectory at a time, and holds the arm between them.

    Attributes:
        reports: state of the goals, with the holds and the speed scaling.
        history: set-points of the last moments, with the delay of the arm.
        bridges: time between set-points that the arm bridges by itself, as they are sent ahead of time [s].
        resumed: number of interruptions after which the motion continued.
    """

    def __init__(
        self, limits: Limits, start: Vector, tolerances: Tolerances | None = None, remember: int = REMEMBERED,
        name: str = "controller", period: float = PERIOD,
    ) -> None:
        """Hold at `start` (dof,) [rad] in cycles of `period` [s]; `name` is the source of the status."""
        self._limits = limits
        self._tolerances = tolerances or Tolerances()
        self._limiter = Limiter(limits, start, period)
        self.history = SetPointHistory()
        self._standstill = Standstill(
            limits, start, self._tolerances, self._limiter, self.history, self.note)
        self._follower = GoalFollower(limits, self._tolerances, self._limiter, self.history, self._standstill)
        self._period = self._usual = period
        self._last: float | None = None  # cell time of the newest set-point
        self._goal: Goal | None = None
        self.reports = GoalReports(name, remember)
        self._found: Vector | None = None  # first reading of an arm that moves
        self._noted = ""  # description of a motion from outside, until it is logged
        self.bridges = 0.0
        self.resumed = 0
        self._frozen_at = -math.inf  # cell time at which a cycle last came later than FROZEN [s]
        self._interrupted_at: float | None = None  # cell time since which set-points are not accepted [s],
        self._reason, self._waiting = "", False  # why, and whether the controller waits until the arm is at rest

    # --- state ----------------------------------------------------------------------------------------------------

    @property
    def status(self) -> MotionStatus:
        """State of the newest goal, and whether and how fast the robot may move."""
        return self.reports.current

    @property
    def goal(self) -> str:
        """Id of the goal that moves the robot; empty without one."""
        return self._goal.id if self._goal else ""

    @property
    def force(self) -> ForceControl | None:
        """What follows the force motion in progress; None without one."""
        return self._goal.force if self._goal else None

    @property
    def set_point(self) -> Vector:
        """The newest set-point (dof,) [rad]."""
        return self._limiter.position

    @property
    def at_rest(self) -> bool:
        """Whether the set-points are at rest, or there are none because the hardware does not work."""
        return bool(self.reports.fault) or (self._limiter.at_rest and self._interrupted_at is None)

    def share_of_speed(self, velocity: Vector, speed_scaling: float) -> float:
        """Return the share, 0 to 1, of the speed with the arm's slider at 1 at which the newest set-point moves it."""
        if self._goal is not None:
            return min(self._goal.pace.rate / (self._goal.share * speed_scaling), 1.0)
        return min(float(np.abs(velocity).max()) / max(self._standstill.full_speed, 1e-9), 1.0)

    def pop_log_line(self) -> str:
        """Return the line for the log that was noted since the last call; else ""."""
        noted, self._noted = self._noted, ""
        return noted

    def note(self, message: str) -> None:
        """Log a message, and report it unless a goal is active."""
        self._noted = message
        self.reports.set_message(message)

    # --- goals ----------------------------------------------------------------------------------------------------

    def accept(
        self, goal: str, trajectory: JointTrajectory, now: float, measured: Vector, refusal: Refused | None = None,
        assessment: Assessment | None = None, plan: str = "", scene_stamp: int = 0, join: Join | None = None,
        force: Callable[[Trajectory, Vector], ForceControl] | None = None, start_at: float = 0.0,
    ) -> MotionStatus:
        """Return the state of the goal: active, or rejected with code and message; of a known id its present state.

        Args:
            goal: id of the goal, created by the requester. The same id never moves the robot twice.
            trajectory: what to follow.
            now: cell time [s].
            measured: where the robot is, (dof,) [rad].
            refusal: reason to reject a new goal.
            assessment: of the trajectory, if `assess` was called before.
            plan: id of the plan request behind the goal, reported with it.
            scene_stamp: stamp of the planning scene of that plan [ns], reported with it.
            join: where the trajectory continues the goal that is followed, and replaces the rest of it.
            force: prepares a force motion along the trajectory from a position (dof,) [rad]; it may raise Refused.
            start_at: cell time at which it starts [s]; 0: at once.
        """
        known = self.reports.get(goal)
        if known is not None:
            return known
        try:
            if refusal is not None:
                raise refusal
            if join is not None:
                return self._join(goal, trajectory, join, plan, scene_stamp)
            start = self._require_ready(measured)
            if assessment is None:
                assessment = self.assess(trajectory, measured, start)
            elif np.any(np.abs(start - assessment.start) > self._tolerances.start):
                raise Refused("busy", "the arm was moved while the trajectory was checked")
            if assessment.trajectory is None:
                assert assessment.refusal is not None
                raise assessment.refusal
            rate = 0.0 if self.reports.holds else self.reports.speed_scaling * assessment.share
            accepted = assessment.goal(goal, start, now, rate, self._limits)
            accepted.plan, accepted.scene_stamp = plan, scene_stamp
            accepted.force = None if force is None else force(assessment.trajectory, start)
            accepted.time = time_at(now, start_at) if start_at else 0.0
        except Refused as error:
            return self.reports.reject(goal, error)
        if start is not self._standstill.position:
            self._standstill.locate(measured)
        self._goal = accepted
        self._standstill.goal_accepted()
        return self._report_active(accepted, self.reports.hold_message(accepted))

    def _join(self, goal: str, trajectory: JointTrajectory, join: Join, plan: str, scene_stamp: int) -> MotionStatus:
        """Replace the rest of the goal that is followed; return the state of the new one.

        Raises:
            Refused: that goal is not followed, or cannot be continued so.
        """
        running = self._goal
        if running is None or running.id != join.goal or running.force is not None:
            raise Refused("unknown_goal", f"goal {join.goal!r} is not followed now")
        joined = join_goal(running, goal, trajectory, join.time, self._limits, self._tolerances, self._period)
        joined.plan, joined.scene_stamp = plan, scene_stamp
        self.reports.report(running, self.history.delay, Outcome("cancelled", "replaced", f"replaced by {goal!r}"))
        self._goal = joined
        return self._report_active(joined, self.reports.hold_message(joined))

    def _require_ready(self, measured: Vector) -> Vector:
        """Return where a new motion starts (dof,) [rad].

        Raises:
            Refused: no motion can start now.
        """
        still = self._standstill
        if self.reports.fault:
            raise Refused("hardware_fault", self.reports.fault)
        if self._goal is not None:
            raise Refused("busy", f"goal {self._goal.id!r} is still being followed")
        if self._last is None:
            still.locate(measured)
        elif still.coasting or self._found is not None or not self._limiter.at_rest:
            raise Refused("busy", "the arm is still coming to rest" if still.jog_velocity is None
                          else "the arm is jogged")
        still.require_followed(measured)
        return still.start_of_motion(measured)

    def takes_long(self, goal: str, trajectory: JointTrajectory) -> bool:
        """Return whether assessing the trajectory of a new goal takes longer than there is time between cycles."""
        points = trajectory.points
        seconds = points[-1].time_from_start if points else 0.0
        samples = len(points) + min(2 * seconds / self._period, MAX_SAMPLES)
        return samples > LONG and self._goal is None and not self.knows(goal)

    def assess(self, trajectory: JointTrajectory, measured: Vector, start: Vector | None = None) -> Assessment:
        """Return whether and how a trajectory can be followed from where the arm is, measured (dof,) [rad].

        It changes nothing: any thread may call it.
        """
        start = (self._standstill.start_of_motion(measured) if start is None else start).copy()
        try:
            checked = checked_trajectory(trajectory, self._limits, measured, self._tolerances)
            return Assessment.of(checked, start, self._limits, self._period)
        except Refused as refusal:
            return Assessment(start, refusal=refusal)

    def cancel(self, goal: str, reason: str, now: float) -> MotionStatus:
        """Bring the robot to rest along its path. An empty id means the running goal.

        The state stays active, with a message, until the robot is at rest, then it is cancelled. A goal that is over
        keeps its state, an unknown one has none.
        """
        running = self._goal
        if running is None or goal not in ("", running.id):
            if goal == "":
                return self.status
            return self.reports.get(goal) or self.reports.unknown(goal)
        if not running.stopping:
            running.stopping, running.reason = True, reason
        return self._report_active(running, f"stopping: {running.reason}")

    def hold(self, hold: bool, reason: str, by: Holder = "operator") -> MotionStatus:
        """Bring the robot to rest on its path, or let it continue unless another holder remains; return the status."""
        if hold:
            self.reports.holds[by] = reason
        else:
            self.reports.holds.pop(by, None)
        if self._goal is not None and not self._goal.stopping:
            return self._report_active(self._goal, self.reports.hold_message(self._goal))
        return self.status

    def jog(self, velocity: Vector | None, slider: float = 1.0) -> None:
        """Jog at a share of velocities (dof,) [rad/s] until the next call; None: come to rest. A goal has priority."""
        blocked = self._goal is not None or self.reports.holds or self.reports.fault
        if blocked or self._last is None or self._found is not None:
            velocity = None
        self._standstill.jog(velocity, slider)

    def abort(self, error: str, message: str, source: str = "") -> None:
        """Bring the robot to rest along its path; then the goal is aborted, and the robot held where it is."""
        if self._goal is not None and not self._goal.error:
            self._goal.stopping, self._goal.reason, self._goal.error = True, message, error
            self._goal.source = source
            self._report_active(self._goal, f"stopping: {message}")

    def interrupt(self, reason: str, now: float) -> None:
        """Wait until the arm is at rest, where it was interrupted; then continue from there.

        Raises:
            HardwareFault: this controller was held up too long itself.
        """
        if now - self._frozen_at < RECENT:
            raise HardwareFault(reason)
        if self._interrupted_at is None:
            self._interrupted_at, self._reason = now, reason
            self.resumed += 1
            self._noted = f"{reason}: the motion continues once the arm is at rest"
        self._waiting = True

    def fault(self, message: str) -> None:
        """End the running goal: the hardware does not work. Goals are rejected until the next `update`."""
        self.reports.fault, self._interrupted_at, self._waiting = clean(message), None, False
        if self._goal is not None:
            self._finish(Outcome("aborted", "hardware_fault", message, "hardware"))

    def knows(self, goal: str) -> bool:
        """Return whether a goal is known."""
        return self.reports.get(goal) is not None

    @property
    def path(self) -> JointTrajectory:
        """What is followed, with the part of it from before the newest join; its duration is that of the progress."""
        assert self._goal is not None
        return to_message(self._goal.trajectory, self._limits.names)

    @property
    def end(self) -> Vector | None:
        """End of the goal that is followed (dof,) [rad]; None without one."""
        goal = self._goal
        return None if goal is None else goal.positions_at(np.array([goal.duration]))[0]

    def time_to_end(self, goal: str) -> float:
        """Return the time until the arm is at the end of a goal [s]; infinite if it may never arrive.

        A goal that is still speeding up arrives earlier.
        """
        running = self._goal
        if running is None or running.id != goal:
            return 0.0 if self.succeeded(goal) else math.inf
        if running.stopping or self.reports.holds:
            return math.inf
        if running.time >= running.duration:  # the set-points are there; the arm follows after its delay
            since = 0.0 if running.ended is None or self._last is None else self._last - running.ended
            return max(self.history.delay - since, 0.0)
        rate = min(running.pace.rate, self.reports.speed_scaling * running.share)
        return (running.duration - running.time) / rate + self.history.delay if rate > 0.0 else math.inf

    def fails(self, goal: str) -> bool:
        """Return whether the arm will not reach the end of a goal any more."""
        if self._goal is not None and self._goal.id == goal:
            return self._goal.stopping
        return not self.succeeded(goal)

    def succeeded(self, goal: str) -> bool:
        """Return whether that goal is the newest, and the arm has reached its end."""
        return self.reports.newest.id == goal and self.reports.newest.state == "succeeded"

    # --- set-points -----------------------------------------------------------------------------------------------

    def update(self, now: float, measured: Vector, measured_velocity: Vector) -> tuple[Vector, Vector] | None:
        """Return the set-points (dof,) [rad], [rad/s] for now; None until the position of the arm is known.

        Args:
            now: cell time [s].
            measured: where the robot is, (dof,) [rad].
            measured_velocity: (dof,) [rad/s].

        Raises:
            HardwareFault: the arm does not stay where it is held.
        """
        if not self._locate_arm(now, measured, measured_velocity):
            return None
        elapsed = self._period if self._last is None else max(now - self._last, 0.0)
        self._last = now
        if elapsed > FROZEN:
            self._frozen_at = now
        if self._waiting:
            return self._continue_at_rest(now, measured, measured_velocity)
        self._interrupted_at = None
        stalled = elapsed > max(STALLED * self._usual, self.bridges) + 1e-6
        self._usual = max(self._period, self._usual + USUAL_SHARE * (elapsed - self._usual))
        if stalled:  # the arm had no set-points meanwhile, and is at rest
            elapsed = self._period
            if self._goal is None:
                self._limiter.rest()
            elif outcome := self._follower.resume_from_rest(
                    self._goal, now - elapsed, measured, measured_velocity):
                self._finish(outcome)
        longest = max(LATE * self._period, self.bridges)
        elapsed = min(elapsed, longest)
        if self._goal is not None:
            self._check_goal(self._goal, now, measured, measured_velocity)
        if self._goal is None:
            return self._standstill.set_points(now, elapsed, measured, measured_velocity, self.reports.speed_scaling)
        goal = self._goal
        set_points = self._follower.set_points(
            goal, now, elapsed, longest, self.reports.speed_scaling, bool(self.reports.holds))
        if not goal.stopping:
            self.reports.update_active(goal, self.history.delay)
        return set_points

    def _continue_at_rest(self, now: float, measured: Vector, velocity: Vector) -> tuple[Vector, Vector] | None:
        """Return a set-point where the interrupted arm is (dof,) [rad], [rad/s]; None until it has come to rest.

        Raises:
            HardwareFault: it does not come to rest.
        """
        assert self._interrupted_at is not None
        if now - self._interrupted_at > REST_TIMEOUT:
            raise HardwareFault(f"{self._reason}; the arm was not at rest within {REST_TIMEOUT:g} s")
        if np.any(np.abs(velocity) > self._tolerances.stopped_velocity):
            return None
        self._waiting = False  # unless this set-point is not accepted, either
        if self._goal is None:
            self._standstill.locate(measured)
        elif outcome := self._follower.rewind(self._goal, now, measured):
            self._finish(outcome)
        return measured, 0.0 * measured

    def _locate_arm(self, now: float, measured: Vector, velocity: Vector) -> bool:
        """Start set-points where the arm is after a start or a fault; return whether they may start.

        One reading does not show whether an arm moves, or reports the velocity that it was commanded: two do.
        """
        if self.reports.fault or (self._last is None and self._goal is None):  # it may have sagged, or start anywhere
            self.reports.fault, self._last = "", None
            self._standstill.locate(measured)
            if np.any(np.abs(velocity) > self._tolerances.stopped_velocity):
                self._found, self._last = measured.copy(), now
                return False
        if self._found is not None:
            mean = (measured - self._found) / max(now - (self._last or now), 1e-9)
            self._found, self._last = None, None
            moves = mean * np.sign(velocity) > np.abs(velocity) / 2
            self._standstill.locate(measured, np.where(moves, velocity, 0.0))
        return True

    def _check_goal(self, goal: Goal, now: float, measured: Vector, velocity: Vector) -> None:
        message, off = self._follower.off_path(now, measured)
        if message:
            self.abort("path_tolerance", message)
        if outcome := self._follower.outcome(goal, now, off, velocity):
            self._finish(outcome)

    def _report_active(self, goal: Goal, message: str) -> MotionStatus:
        return self.reports.report(goal, self.history.delay, Outcome("active", message=message))

    def _finish(self, outcome: Outcome) -> None:
        assert self._goal is not None
        self.reports.report(self._goal, self.history.delay, outcome)
        self._goal = None
