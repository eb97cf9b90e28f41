"""Keeps the arms within the band of their schedules: holds the one that is ahead, and proves new schedules.

The proof of a pair covers all states in which the schedules differ by at most the band. From each of them both motions
can end: the arm ahead waits until the other one has caught up, then both go on. So a hold ends by itself. Where the
rest of the motions is free with other schedules, too, no arm waits.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

from common.planning.arms.arm import Arm
from common.planning.arms.band import AFTER_RELEASE
from common.planning.arms.coordinator import PAST, Coordinator, Retreat
from common.planning.arms.timed_pairs import NOT_AT_REST, Schedule

RETRY = 0.1  # [s] between attempts to prove new schedules
LEAST_RATE = 0.05


@dataclass(frozen=True)
class Cancel:
    """End a motion that could not continue for too long."""

    arm: str
    goal: str
    why: str


class ScheduleKeeper:
    """Call `step` often; it sets `hold` of every arm."""

    def __init__(self, coordinator: Coordinator) -> None:
        """Keep the schedules of its arms."""
        self._all = coordinator
        self._tried = -1e9  # cell time of the last attempt to prove new schedules [s]
        self._obstructed: dict[str, float] = {}  # goals that an arm at rest obstructs, since when [s]

    def step(self, now: float) -> list[Retreat | Cancel]:
        """Set which arms to hold; return what else must be requested; cell time [s]."""
        self._all.proofs.effort.left = self._all.options.effort
        running = [arm for arm in self._all.arms.values() if arm.committed is not None]
        holds = self._pairs(running, now)
        drift = self._all.options.delays.drift
        off = any(abs(self._lag(arm, now)) > drift for arm in running if not arm.is_frozen)
        if (holds or off) and now - self._tried >= RETRY:
            self._tried = now
            if self._reschedule(running, now):
                holds = self._pairs(running, now)
        for arm in running:
            if arm.committed is not None and arm.committed.parked_for:
                holds.setdefault(arm.name, f"{' and '.join(sorted(arm.committed.parked_for))} passes first")
        actions = self._obstructions(running, holds, now)
        for arm in self._all.arms.values():
            arm.hold = holds.get(arm.name, "")
        return actions

    def _lag(self, arm: Arm, now: float) -> float:
        return arm.lag(now, self._all.options.delays.report)

    def _pairs(self, running: list[Arm], now: float) -> dict[str, str]:
        """Return which arms must wait for one that is behind, and why."""
        drift, holds = self._all.options.delays.drift, {}
        for one, other in combinations(running, 2):
            late, ahead = sorted((one, other), key=lambda arm: -self._lag(arm, now))
            assert late.committed is not None
            assert ahead.committed is not None
            gap = self._lag(late, now) - self._lag(ahead, now)
            if ahead.name in late.committed.parked_for or late.name in ahead.committed.parked_for:
                continue
            if gap <= (drift / 2 if ahead.hold else drift) or ahead.done >= ahead.committed.motion.duration - 1e-3:
                continue
            if late.is_frozen and self._park(late, ahead):
                continue
            holds[ahead.name] = f"{late.name} is behind its schedule"
        return holds

    def _park(self, late: Arm, ahead: Arm) -> bool:
        """Let an arm pass one that others hold, if that is free, and so is the rest of the held one afterwards."""
        assert late.committed is not None
        assert ahead.committed is not None
        if ahead.is_frozen or late.name in ahead.committed.parked_for:
            return False
        run, other, prove = late.committed, ahead.committed, self._all.proofs
        there = (late.done - PAST, late.done + run.braking + self._all.options.delays.report)
        rest = (ahead.done - PAST, other.motion.duration)
        if prove.anywhere(run.moving, other.moving, there, rest) or prove.anywhere(
                run.moving, ahead.end, (late.done - PAST, run.motion.duration)):
            return False
        run.parked_for.add(ahead.name)
        return True

    def _reschedule(self, running: list[Arm], now: float) -> bool:
        """Give all arms schedules from where they are, if those are proved; return whether they are."""
        free = [arm for arm in running if not arm.is_frozen]
        moved = {arm.name: self._from_here(arm, now) for arm in free}
        for one, other in combinations(free, 2):
            assert one.committed is not None
            assert other.committed is not None
            band = self._all.options.delays.band(one.committed.braking, other.committed.braking)
            if self._all.proofs.in_time(
                    one.committed.moving, moved[one.name], other.committed.moving, moved[other.name], band):
                return False
        for arm in free:
            assert arm.committed is not None
            arm.committed.schedule = moved[arm.name]
        return bool(free)

    def _from_here(self, arm: Arm, now: float) -> Schedule:
        assert arm.committed is not None
        rate = max(arm.state.scaling, LEAST_RATE) if arm.state is not None else 1.0
        starts = bool(arm.hold) or arm.done <= 0.0
        delay = AFTER_RELEASE * rate + self._all.options.delays.message if starts else 0.0
        done = arm.done
        if not starts and arm.state is not None:
            done += min(max(now - arm.state.stamp, 0.0), self._all.options.delays.report) * rate
        return Schedule(now + delay - done / rate, rate, arm.done - PAST, done if starts else NOT_AT_REST)

    def _obstructions(
        self, running: list[Arm], holds: dict[str, str], now: float
    ) -> list[Retreat | Cancel]:
        """Hold arms whose way an arm obstructs that came to rest elsewhere than committed; request that it moves."""
        actions: list[Retreat | Cancel] = []
        obstructed: dict[str, float] = {}
        for arm in running:
            run = arm.committed
            assert run is not None
            rest = (arm.done - PAST, run.motion.duration)
            for other in self._all.arms.values():
                if other is arm or other.committed is not None or rest[0] >= rest[1]:
                    continue
                if self._all.proofs.anywhere(run.moving, other.rest, rest) is None:
                    continue
                since = obstructed[run.goal] = self._obstructed.get(run.goal, now)
                holds[arm.name] = f"{other.name} obstructs it at rest"
                if now - since > self._all.options.longest_wait:
                    actions.append(Cancel(arm.name, run.goal, holds[arm.name]))
                elif not self._would_clash(other, arm):
                    found = self._all.move_back(other, arm, since, now)
                    actions += [] if isinstance(found, str) else found
        self._obstructed = obstructed
        return actions

    def _would_clash(self, resting: Arm, held: Arm) -> bool:
        """Return whether the way back of an arm at rest is not free while another one is held on its path."""
        if resting.back is None:
            return True
        return self._all.proofs.anywhere(resting.back, held.here) is not None
