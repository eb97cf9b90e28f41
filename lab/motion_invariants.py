"""What must hold for the arm and its goals at every step of a simulated cell."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common import topics
from common.arms import of_arm
from common.config import Cell
from common.hardware.interface import Limits, Vector
from common.messages import (
    ExecuteRequest,
    GripperCommand,
    GripperState,
    HoldRequest,
    Message,
    MotionStatus,
    OwnRequest,
    ParameterRequest,
    StopRequest,
    TaskCommand,
)
from lab.loop import Incarnation, current_incarnation

GOALS = (ExecuteRequest, GripperCommand)
ENDED = ("succeeded", "aborted", "cancelled")
STOPS = ("stop", "pause", "hold")
OPERATOR = "operator"  # name of the operator model's sessions
EXECUTOR, RATE = "trajectory_executor", 100.0  # [Hz] control rate if the cell sets none
MOST_BROKEN = 5  # violations that are reported
OLDEST = 2.3  # [s] from the first request of a motion to its start, clock errors included; later ones are refused
JUMP = 2.0  # [rad/s] times a period: from the measured position to the first set-point of another process
AT_REST = 2.0  # [s] of cell time after which a held arm is at standstill
STILL = 1e-9  # [rad]
UNREPORTED = 3  # set-points that may precede the report of a goal or of a release
CYCLES = 2.5  # longest punctual control cycle in periods; a later cycle moves no further
STALL = 0.3  # [s] of cell time after which a trajectory resumes where it was

TWO = "one goal at a time"
ONCE = "a goal id acts once"
LIMITS = "every set-point is within limits"
FRESH = "no outdated goal starts"
GOAL = "the arm moves only for a goal"
HELD = "a held arm is at standstill"
SLOW = "the operator's speed limit holds"
NEVER = "a goal stopped before its start never moves"
UNREQUESTED = "no unrequested motion after a stop"


class Checks:
    """Counts checks in `checked` and lists violations in `broken`; `now` returns the virtual time [s]."""

    def __init__(self, now: Callable[[], float]) -> None:
        self.broken: list[str] = []
        self.checked: Counter[str] = Counter()
        self.now = now

    def fails(self, holds: object, invariant: str) -> bool:
        """Count a check; return whether it failed."""
        self.checked[invariant] += 1
        return not holds

    def add_violation(self, invariant: str, detail: str) -> None:
        """Record a violation of an invariant."""
        if len(self.broken) < MOST_BROKEN:
            self.broken.append(f"{self.now():.3f} s: {invariant}: {detail}")


@dataclass
class _Goals:
    """Goals that one controller reported."""

    active: str = ""
    instance: str = ""  # of the process


class MotionInvariants:
    """Checks goals, set-points, stops and speed limits."""

    def __init__(self, checks: Checks, cell: Cell, arm: str = "") -> None:
        self.jogging = False  # whether the arm is jogged
        self.last_command = ""  # newest command of an operator to the task, or "stop" to the executor
        self._checks = checks
        self._cycle = CYCLES / control_rate(cell)  # [s] of cell time
        self._motion = f"{cell.name}/{of_arm(topics.MOTION_STATUS, arm).key}"
        self._gripper = f"{cell.name}/{of_arm(topics.GRIPPER_STATE, arm).key}"
        self._goals: dict[str, _Goals] = {}
        self._ended: dict[tuple[str, str], str] = {}  # end state by key and goal
        self._requested_at: dict[str, float] = {}  # virtual time of the first request by goal [s]
        self._accepted: dict[tuple[str, str], bool] = {}  # by controller's process and goal
        self._replaces: dict[str, str] = {}  # goal that joined another one while that was followed
        self._never: set[str] = set()  # goals stopped before any report that they move
        self._of_operators: set[str] = set()  # goals
        self._last: tuple[Vector, Vector, float] | None = None  # newest set-points and their cell time
        self._moving: Incarnation | None = None  # process whose set-points these are
        self._without_goal = 0  # consecutive set-points that moved without a goal
        self._while_held = 0  # consecutive set-points that moved a held arm
        self._unrequested = 0  # consecutive set-points that moved after a stop
        self._held_since: float | None = None  # cell time [s]
        self._braking_until = 0.0  # cell time until which an arm that left its path may come to rest [s]
        self._stopped = False  # whether the newest command of an operator was a stop or hold
        self._stopped_at: float | None = None  # cell time of the first set-point since [s]
        self._stopped_by: Incarnation | None = None  # process that served the stop, which brakes first
        self._cap = 1.0  # share of the velocity that an operator allows
        self._cap_at: float | None = None  # cell time of the first set-point since [s]

    @property
    def stopped_by_operator(self) -> bool:
        """Whether the newest command of an operator was to stop, pause or hold."""
        return self.last_command in STOPS

    def on_clock(self, step: float) -> None:
        """Shift all cell times: the cell was started again and its clock is ahead by `step` [s]."""
        if self._held_since is not None:
            self._held_since += step
        self._braking_until += step
        if self._stopped_at is not None:
            self._stopped_at += step
        if self._cap_at is not None:
            self._cap_at += step

    # --- reports ------------------------------------------------------------------------------------------------------

    def on_motion(self, instance: str, status: MotionStatus) -> None:
        """Check a motion status of the executor's process `instance`."""
        self._on_goal(self._motion, instance, status.id, status.state)
        held = status.held and status.state == "active"
        self._held_since = None if not held else self._held_since or status.header.stamp * 1e-9
        if status.state == "aborted":
            self._braking_until = status.header.stamp * 1e-9 + AT_REST

    def on_gripper(self, instance: str, state: GripperState) -> None:
        """Check a gripper state."""
        self._on_goal(self._gripper, instance, state.id, state.state)

    def _on_goal(self, key: str, instance: str, goal: str, state: str) -> None:
        checks, known = self._checks, self._goals.setdefault(key, _Goals())
        if instance != known.instance:  # another process, which does not know earlier goals
            known.instance, known.active = instance, ""
        before = self._ended.get((key, goal), "")
        if checks.fails(not before or state == before, ONCE):
            checks.add_violation(ONCE, f"{key}: {goal} is {state} after it was {before}")
        if state in ENDED:
            self._ended[key, goal] = state
            if goal == known.active:
                known.active = ""
        elif state == "active":
            # A newer gripper goal ends the older one, and a goal that joins another one replaces it.
            replaced = key == self._gripper or self._joined(goal, known.active)
            if checks.fails(not known.active or goal == known.active or replaced, TWO):
                checks.add_violation(TWO, f"{key}: {goal} is active while {known.active} is")
            if goal != known.active and checks.fails(goal not in self._never, NEVER):
                checks.add_violation(NEVER, goal)
            if goal != known.active and goal in self._requested_at:
                age = checks.now() - self._requested_at[goal]
                if checks.fails(age <= OLDEST, FRESH):
                    checks.add_violation(FRESH, f"{goal} starts {age:.2f} s after its first request")
            known.active = goal

    def _joined(self, goal: str, before: str) -> bool:
        """Return whether a goal joined another one, or one that joined that one."""
        while goal := self._replaces.get(goal, ""):
            if goal == before:
                return True
        return False

    # --- set-points ---------------------------------------------------------------------------------------------------

    def on_set_point(self, limits: Limits, measured: Vector, q: Vector, dq: Vector, now: float) -> None:
        """Check one set-point.

        Args:
            limits: of the joints.
            measured: (dof,) measured positions [rad].
            q: (dof,) commanded positions [rad].
            dq: (dof,) commanded velocities [rad/s].
            now: cell time [s].
        """
        checks, fastest = self._checks, 1.03 * limits.velocity
        fits = (q >= limits.lower - 2e-3) & (q <= limits.upper + 2e-3) & (np.abs(dq) <= fastest)
        if checks.fails(fits.all(), LIMITS):  # NaN fails too
            checks.add_violation(LIMITS, f"q {np.round(q, 4).tolist()}, dq {np.round(dq, 3).tolist()}")
        last, self._last = self._last, (q.copy(), dq.copy(), now)
        if last is None:
            return
        passed, step = now - last[2], np.abs(q - last[0])
        before, self._moving = self._moving, current_incarnation()
        if passed <= 0 or passed > STALL or before is not self._moving:  # another process, or one that stalled
            if checks.fails((step <= JUMP * self._cycle / CYCLES).all(), LIMITS):
                checks.add_violation(LIMITS, f"a jump of {step.max():.3f} rad after {passed:.3f} s")
            return
        self._check_step(limits, fastest, last, passed, step, dq)
        if self._cap_at is None:
            self._cap_at = now
        if self._stopped and self._stopped_at is None:
            self._stopped_at = now
        if step.max() > STILL and passed <= 2 * self._cycle:
            self._check_permission(fastest, float(step.max()), dq, now)

    def _check_step(
        self, limits: Limits, fastest: Vector, last: tuple[Vector, Vector, float], passed: float, step: Vector,
        dq: Vector,
    ) -> None:
        """Check the change of position and velocity against the set-point before."""
        checks = self._checks
        if checks.fails((step <= fastest * min(passed, self._cycle) + 1e-3).all(), LIMITS):
            checks.add_violation(LIMITS, f"a step of {step.max():.4f} rad in {passed * 1e3:.1f} ms")
        velocity = 0.0 * last[1] if passed > self._cycle else last[1]  # after a late cycle: from standstill
        change = np.abs(dq - velocity)
        if checks.fails((change <= 1.1 * limits.braking * max(passed, self._cycle / CYCLES) + 1e-3).all(), LIMITS):
            checks.add_violation(LIMITS, f"velocity changes by {change.max():.3f} rad/s in {passed * 1e3:.1f} ms")

    def _check_permission(self, fastest: Vector, step: float, dq: Vector, now: float) -> None:
        """Check that the arm may move, and as fast as it does."""
        checks, goals = self._checks, self._goals.get(self._motion)
        active = goals.active if goals is not None else ""
        free = self.jogging or active or now < self._braking_until
        self._without_goal = 0 if free else self._without_goal + 1
        if checks.fails(self._without_goal <= UNREPORTED, GOAL):
            checks.add_violation(GOAL, f"{step:.4f} rad without one")
        resting = self._held_since is not None and now - self._held_since >= AT_REST
        self._while_held = self._while_held + 1 if resting else 0
        if checks.fails(self._while_held <= UNREPORTED, HELD):
            checks.add_violation(HELD, f"it moves {step:.4f} rad")
        if self._cap < 1 and self._cap_at is not None and now - self._cap_at >= AT_REST:
            too_fast = np.abs(dq) > fastest * self._cap + 1e-3
            if checks.fails(not too_fast.any(), SLOW):
                checks.add_violation(SLOW, f"dq {np.round(dq, 3).tolist()} at {self._cap:.0%}")
        brakes = (current_incarnation() is self._stopped_by and self._stopped_at is not None
                  and now - self._stopped_at < AT_REST)
        requested = self.jogging or (goals is not None and active in self._of_operators)
        unrequested = self._stopped and not brakes and not requested
        self._unrequested = self._unrequested + 1 if unrequested else 0
        if checks.fails(self._unrequested <= UNREPORTED, UNREQUESTED):
            checks.add_violation(UNREQUESTED, f"it moves {step:.4f} rad for {active or 'no goal'}")

    # --- requests -----------------------------------------------------------------------------------------------------

    def on_request(self, service: str, request: Message) -> None:
        """Note what an operator commands, and when a goal is requested first."""
        if isinstance(request, TaskCommand):
            self.last_command = request.command
        elif isinstance(request, ParameterRequest):  # counts before the answer; a lower speed counts from the answer on
            self._cap = max([self._cap, *_speeds(request)])
        elif isinstance(request, StopRequest) and request.owner:  # a stop by the task itself has no owner
            self.last_command = "stop"
        elif isinstance(request, OwnRequest) and request.over:
            self.last_command = "stop"  # of the task
        elif isinstance(request, HoldRequest) and request.hold and service == OPERATOR:
            self.last_command = "hold"
        if not self.stopped_by_operator:
            self._stopped, self._stopped_at = False, None
        if isinstance(request, ExecuteRequest):
            if request.owner:
                self._of_operators.add(request.id)
            if request.joins:
                self._replaces[request.id] = request.joins
            self._requested_at.setdefault(request.id, self._checks.now())

    def on_serve(self, instance: str, request: Message, answer: Message) -> None:
        """Check the answer of a process `instance`: a repeated goal gets the same decision."""
        checks = self._checks
        if isinstance(request, StopRequest) and request.id:
            unknown = getattr(answer, "error", "") == "unknown_goal"
            if unknown and (self._motion, request.id) not in self._ended:
                self._never.add(request.id)
        if isinstance(request, ParameterRequest):
            for speed in _speeds(request):
                self._cap, self._cap_at = speed, None
        stop = isinstance(request, StopRequest) or (isinstance(request, HoldRequest) and request.hold)
        if stop and getattr(request, "by", "") == "operator" and self.stopped_by_operator:
            self._stopped, self._stopped_at, self._stopped_by = True, None, current_incarnation()
        if isinstance(request, GOALS) and isinstance(answer, MotionStatus | GripperState):
            accepted = answer.state != "rejected"
            before = self._accepted.setdefault((instance, request.id), accepted)
            if checks.fails(before == accepted, ONCE):
                decision = "accepted" if before else "rejected"
                checks.add_violation(ONCE, f"{request.id} was {decision}, then requested again and {answer.state}: "
                                    f"{answer.message}")

    def on_answer(self, service: str, request: Message, answer: Message) -> None:
        """Check that a requested hold took effect, unless it is for a goal that is over."""
        if not (isinstance(request, HoldRequest) and request.hold and isinstance(answer, MotionStatus)):
            return
        if request.goal and (answer.id != request.goal or answer.state != "active"):
            return
        if self._checks.fails(answer.held, HELD):
            self._checks.add_violation(HELD, f"it is not held when {service} requests it")


def control_rate(cell: Cell) -> float:
    """Return the control cycles of the executor per second of cell time [Hz]."""
    entries = [entry for entry in cell.services.values() if entry.kind == EXECUTOR]
    return next((float(entry.parameters["joint_state_rate"]) for entry in entries
                 if "joint_state_rate" in entry.parameters), RATE)


def _speeds(request: ParameterRequest) -> list[float]:
    """Return the speed that a request sets, as share of the full speed; empty if it sets none."""
    values = [value for path, value in request.set.items() if path.endswith(".speed_scaling")]
    return [value for value in values if isinstance(value, float)]
