"""The trajectory controller: accepts goals, returns set-points, checks how well the arm follows. It has no clock.

Life of a goal: rejected at once, or active and then succeeded, aborted or cancelled. One goal at a time. While the
robot is held its goal stays active, at rest on its path; a goal accepted meanwhile waits at its start.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from common.control.acceptance import Acceptance
from common.control.goals import REMEMBERED, Assessment, ForceControl, Goal, GoalReports, Outcome
from common.control.joining import Join, join_goal
from common.control.limiter import Limiter
from common.control.set_point_gaps import SetPointGaps
from common.control.set_points import GoalFollower, SetPointHistory, Standstill
from common.control.trajectory import Tolerances, Trajectory, to_message
from common.errors import Refused
from common.hardware.interface import Limits, Vector
from common.messages import Holder, JointTrajectory, MotionStatus
from common.messages.basics import clean

PERIOD = 0.01  # [s] cell time between cycles, by default


class TrajectoryController:
    """Follows one trajectory at a time, and holds the arm between them.

    Attributes:
        reports: state of the goals, with the holds and the speed scaling.
        history: set-points of the last moments, with the delay of the arm.
        gaps: gaps in the set-points.
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
        self._period = period
        self.gaps = SetPointGaps(self._tolerances, self._standstill, period)
        self._goal: Goal | None = None
        self.reports = GoalReports(name, remember)
        self._acceptance = Acceptance(
            limits, self._tolerances, self._limiter, self._standstill, self.gaps, self.reports, period)
        self._noted = ""  # description of a motion from outside, until it is logged

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
        return bool(self.reports.fault) or (self._limiter.at_rest and not self.gaps.interrupted)

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
            accepted = self._acceptance.goal(
                goal, trajectory, now, measured, assessment, self._goal, force, start_at)
            accepted.plan, accepted.scene_stamp = plan, scene_stamp
        except Refused as error:
            return self.reports.reject(goal, error)
        self._goal = accepted
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

    def takes_long(self, goal: str, trajectory: JointTrajectory) -> bool:
        """Return whether assessing the trajectory of a new goal takes longer than there is time between cycles."""
        return self._goal is None and not self.knows(goal) and self._acceptance.takes_long(trajectory)

    def assess(self, trajectory: JointTrajectory, measured: Vector) -> Assessment:
        """Return whether and how a trajectory can be followed from where the arm is, measured (dof,) [rad].

        It changes nothing: any thread may call it.
        """
        return self._acceptance.assess(trajectory, measured)

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
        if blocked or self.gaps.last is None or self.gaps.locating:
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
        if note := self.gaps.interrupt(reason, now):
            self._noted = note

    def fault(self, message: str) -> None:
        """End the running goal: the hardware does not work. Goals are rejected until the next `update`."""
        self.reports.fault = clean(message)
        self.gaps.end_interruption()
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
            last = self.gaps.last
            since = 0.0 if running.ended is None or last is None else last - running.ended
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
        lost, self.reports.fault = bool(self.reports.fault), ""
        if not self.gaps.locate_arm(now, measured, measured_velocity, lost, bool(self._goal)):
            return None
        elapsed, stalled = self.gaps.advance(now)
        if self.gaps.waiting:
            if not self.gaps.has_come_to_rest(now, measured_velocity):
                return None
            if self._goal is None:
                self._standstill.locate(measured)
            elif outcome := self._follower.rewind(self._goal, now, measured):
                self._finish(outcome)
            return measured, 0.0 * measured
        if stalled:  # the arm had no set-points meanwhile, and is at rest
            if self._goal is None:
                self._limiter.rest()
            elif outcome := self._follower.resume_from_rest(
                    self._goal, now - elapsed, measured, measured_velocity):
                self._finish(outcome)
        if self._goal is not None:
            self._check_goal(self._goal, now, measured, measured_velocity)
        if self._goal is None:
            return self._standstill.set_points(now, elapsed, measured, measured_velocity, self.reports.speed_scaling)
        goal = self._goal
        set_points = self._follower.set_points(
            goal, now, elapsed, self.gaps.longest, self.reports.speed_scaling, bool(self.reports.holds))
        if not goal.stopping:
            self.reports.update_active(goal, self.history.delay)
        return set_points

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
