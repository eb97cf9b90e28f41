"""What a task monitors: the services that it depends on, and the stages that it has started.

A task needs joint states, a planner and an executor. While one is missing the arm is held on its path and resumes the
same path later. Without joint states its position is unknown; without a planner no retreat is possible. A hold loses
nothing and repeats nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from common import messages as m
from common.tasks.decisions import V
from common.tasks.signals import SignalStages
from common.tasks.stages import MISSES, Command, Grip, Move, Report, Stage
from common.time_source import WatchdogClock

LOOK_PERIOD = 0.05  # [s] longest period between two updates of a task that runs on time
USUAL_GAPS = 4  # joint states are missing after this many of their usual periods
SLOWEST_GAP = 2.0  # [s] a longer gap is an outage, not a rate
REMEMBERED = 2.0  # [s] for which an own delay counts: other processes were probably delayed as well
HOPS = 2  # processes between robot and task, each assumed as late as this one
BLOCKED_BY = "scene_monitor"  # source of the hold while an obstacle blocks the path
OPENED_BY = 0.5  # progress of a motion at which fingers that open during it must have opened


class LivenessWatchdog:
    """Checks on the process uptime clock whether the needed services are there. Times are wall time [s]."""

    def __init__(self, received: Callable[[], int], timeout: Callable[[], float]) -> None:
        """Start without any joint state, which is no fault yet.

        Args:
            received: number of joint states so far.
            timeout: time without joint states after which the arm is held [s].
        """
        self.trouble = ""  # why the arm must not move now
        self._received, self._timeout = received, timeout
        self._awake = WatchdogClock(2 * LOOK_PERIOD)
        self._count: int | None = None
        self._last_joints = 0.0  # process uptime
        self._gap = 0.0  # usual period of joint states
        self._late = self._late_at = 0.0
        self._seen: set[str] = set()
        self._holding: bool | None = None  # unknown until the first motion status

    def update(
        self, now: float, serving: dict[str, bool], motion: m.MotionStatus | None, blocked: str = ""
    ) -> list[m.HoldRequest]:
        """Return the hold requests to send; `trouble` names what is missing.

        Args:
            now: monotonic clock [s].
            serving: by service name, whether it answers requests.
            motion: newest motion status.
            blocked: why the running motion must not continue, from its task; empty if it may.
        """
        self._seen |= {name for name, there in serving.items() if there}
        gone = [name for name, there in serving.items() if not there and name in self._seen]
        silent = self._joints_are_missing(self._awake.advance(now))
        self.trouble = f"{' and '.join(gone)} {'is' if len(gone) == 1 else 'are'} gone" if gone else silent or blocked
        if motion is None:
            return []
        if self._holding is None:  # set by the task process before this one
            self._holding = "watchdog" in motion.held_by
        if self.trouble and motion.state == "active" and not self._holding:
            self._holding = True
            return [_hold(True, self.trouble)]
        if not self.trouble and self._holding:
            self._holding = False
            return [_hold(False, "what was missing is back")]
        return []

    def _joints_are_missing(self, awake: float) -> str:
        if self._awake.late >= self._late or awake - self._late_at > REMEMBERED:
            self._late, self._late_at = self._awake.late, awake
        new = self._received() - (self._count or 0)
        if new > 0:
            gap = (awake - self._last_joints) / new
            if self._count is not None and gap <= SLOWEST_GAP:
                self._gap += (0.1 if self._gap else 1.0) * (gap - self._gap)
            self._count, self._last_joints = self._received(), awake
        if self._count is None:
            return ""
        limit = max(self._timeout(), USUAL_GAPS * self._gap) + HOPS * self._late
        return f"no joint states for {1e3 * self._timeout():.0f} ms" if awake - self._last_joints > limit else ""


def _hold(hold: bool, reason: str) -> m.HoldRequest:
    return m.HoldRequest(hold=hold, reason=reason, by="watchdog")


class ExecutionMonitor(SignalStages[V]):
    """Follows the started stages by the reports of the controllers, and calls the hooks of the task."""

    def _watch(self, view: V) -> list[Command]:
        """Monitor the running stage: its end, its failure, and the loss of a held object."""
        if self.running is None:
            self._watch_early(view)
            return self._watch_opening(view)
        assert view.motion is not None and view.gripper is not None
        running, stage = self.running, self.running.stage
        running.count(view.now, view.motion)
        if self._early is not None:  # waiting does not count against its time limit
            self._early.counted = view.now
        outcome = running.outcome(view.motion, view.gripper)
        limit = self.time_limit(stage)
        if running.has_released(view.gripper):  # the arm may leave while the fingers continue to open
            self.running, self._opening = None, running
            self.status.moving_seconds += running.moving
            self.succeeded(stage, view)
        elif outcome == "ended":
            self.running = None
            self.status.moving_seconds += running.moving
            self._ended(stage, running.report(view.motion, view.gripper), view)
        elif outcome == "forgotten":
            self.running = None
            if self._early is not None and isinstance(self._early.stage, Grip):  # the release position is unknown now
                self._early = replace(self._early, stage=replace(self._early.stage, holds=None))
            self.forgotten(stage, view)
        elif running.moves_arm and stage.carries and not view.holding and not (self._early and self._early.started):
            stop = self.stop(view, "what it held fell")
            slipped = f": {view.gripper.message}" if view.gripper.outcome == "slipping" else ""
            self.fail(f"what the hand held fell during {stage.name}{slipped}", view, go_home=False)
            return stop
        elif running.spent > limit:
            stop = self.stop(view, "it takes too long")
            self.fail(f"{stage.name} took longer than {round(limit, 2):g} s", view)
            return stop
        elif running.moves_arm and (why := self.outdated(stage, view)):
            stop = self.stop(view, why)
            self.status.message = f"{stage.name}: {why}"
            return stop
        elif blocked := self._blocked(view):
            stop = self.stop(view, blocked)
            self.obstructed(stage, view, f"{stage.name}: {blocked}")
            return stop
        elif (
            stage.carries and view.gripper.outcome == "slipping"  # the object may still arrive
            and not self.status.message.startswith(f"{stage.name}: ")  # once: the width changes with every reading
        ):
            self.status.message = f"{stage.name}: {view.gripper.message}"
        return self._watch_opening(view)

    def _watch_early(self, view: V) -> None:
        """Monitor a gripper command whose motion ended without success: a release counts, a grasp is decided again."""
        if (early := self._early) is None:
            return
        assert view.motion is not None and view.gripper is not None
        early.count(view.now, view.motion)
        if view.motion.state == "active":  # until it is at standstill
            return
        if view.motion.id == getattr(early.command, "after", ""):
            early.motion_ended(view.motion, view.gripper)
        outcome = early.outcome(view.motion, view.gripper)
        if outcome == "running" and early.spent <= self.time_limit(early.stage):
            return
        self._early, self.images_after = None, view.now
        stage, reported = early.stage, early.report(view.motion, view.gripper)
        if outcome != "ended" or not isinstance(stage, Grip):
            return
        if stage.holds is False and reported.state == "succeeded" and not view.holding:
            self.succeeded(stage, view)
        elif stage.holds and isinstance(reported, m.GripperState) and reported.outcome in MISSES:
            self._shut = True
        elif reported.error == "hardware_fault":
            self.fail(f"{stage.name} {reported.state}: {reported.message}", view)

    def _watch_opening(self, view: V) -> list[Command]:
        """Monitor fingers that open while the arm already leaves; stop the arm if they do not open in time."""
        opening, running = self._opening, self.running
        if opening is None:
            return []
        assert view.motion is not None and view.gripper is not None
        state = view.gripper.state if view.gripper.id == opening.command.id else "cancelled"
        if state == "active":
            ours = running is not None and running.moves_arm and view.motion.id == running.command.id
            if not ours or view.motion.progress < OPENED_BY:
                return []
            why = "the fingers have not opened yet"
        else:
            self._opening, why = None, f"the fingers did not open: {view.gripper.message}"
        if state in ("succeeded", "cancelled"):  # handled by the later command
            return []
        stop = self.stop(view, why)
        self._opening = None
        if state == "active" and self.running is None:  # continue as an open stage with its full time limit
            assert isinstance(opening.stage, Grip)
            self.running = replace(opening, stage=Grip("open", opening.stage.state, width=opening.stage.width))
            self.status.message = why
        else:
            self.fail(why, view)
        return stop

    def _blocked(self, view: V) -> str:
        """Return what blocks the running motion for longer than `obstacle_patience`; empty for nothing."""
        assert view.motion is not None and self.running is not None
        ours = view.motion.id == self.running.command.id and view.motion.state == "active"
        held = [one.reason for one in view.motion.interlocks if one.by == BLOCKED_BY and one.kind == "held"]
        if not held or not ours or view.trouble or view.motion.paused or self.status.paused:
            self._obstructed.reset()
            return ""
        return held[0] if self._obstructed.elapsed("blocked", view.now) >= self.p.obstacle_patience else ""

    def _decide_again(self, message: str, view: V) -> None:
        self.clear()
        self.images_after = view.now
        self.status.message = message

    def _ended(self, stage: Stage, reported: Report, view: V) -> None:
        holds = stage.holds if isinstance(stage, Grip) else None
        if reported.state == "cancelled" and isinstance(stage, Move):
            self.clear()
            if view.motion is not None and view.motion.stopped:  # the operator's stop was not addressed to this task
                self.status.started = False
                return
            self.status.paused = True
            self.status.message = f"{stage.name} was stopped from outside ({reported.message}); resume to go on"
        elif reported.state == "cancelled":  # another client commanded the gripper: no failure
            self._decide_again(f"{stage.name} was cancelled: {reported.message}", view)
        elif isinstance(stage, Grip) and holds and isinstance(reported, m.GripperState) and reported.outcome in MISSES:
            stage.problem = reported.message
            self.missed(stage, view)
        elif reported.error in ("hardware_fault", m.CLOSED_BEFORE) and isinstance(stage, Move):  # not its fault
            self._held_up = reported.error == m.CLOSED_BEFORE
            self._decide_again(f"{stage.name} {reported.state}: {reported.message}", view)
        elif reported.state != "succeeded":
            self.fail(f"{stage.name} {reported.state}: {reported.message}", view)
        elif isinstance(stage, Grip) and holds and not view.holding:
            self.missed(stage, view)
        elif holds is False and view.holding:
            self.fail("the fingers opened and still hold something", view)
        else:
            self._held_up = self._held_up and not holds
            self.succeeded(stage, view)
            if self._early is not None and view.motion is not None and view.gripper is not None:
                self.running, self._early = self._early, None
                self.running.motion_ended(view.motion, view.gripper)
                self.running.started = True
                self._report_stage(self.running.stage)

    def _report_stage(self, stage: Stage) -> None:
        self.status.state, self.status.stage = stage.state, stage.name
        self.status.subject = stage.cycle.subject if stage.cycle else ""
