"""Decides which of several arms may move when: pure, without clock, network and files.

Requests have tickets, in the order of their arrival. A motion is committed only if it is proved against the committed
motions and the resting poses of all other arms, and together with a way back to the home pose of its arm; see
docs/two_arms.md for why no two requests can wait for each other for ever.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from common.planning.arms import way_back
from common.planning.arms.arm import Arm, Committed, Observed, Options, Ticket
from common.planning.arms.band import AFTER_RELEASE, braking_time
from common.planning.arms.pair_world import ArmBody, ArmGeometry
from common.planning.arms.proofs import Moving, Proofs
from common.planning.arms.timed_pairs import ArmMotion, Clash, Schedule
from common.planning.arms.touching import Touch, touch_of
from common.planning.trajectory import TimedPath

Array = NDArray[np.float64]
Line = Callable[[str, Array, Array], bool]  # arm, from, to (dof,) [rad]: whether the scene of the arm is free between

RETREAT = "retreat-"  # first part of the ids of motions that the coordinator requests
REPEATED = 2.0  # [s] a request that was not repeated for longer is withdrawn
UNFINISHED = "the proof is not finished"
PAST = 0.02  # [s] of a path that are proved again behind an arm: reports are rounded


Kind = Literal["granted", "wait", "refused"]


@dataclass(frozen=True)
class Decision:
    """Answer to a request."""

    state: Kind
    error: str = ""
    message: str = ""
    waits_for: tuple[str, ...] = ()
    waited: float = 0.0


@dataclass(frozen=True)
class Retreat:
    """Request that an arm follows its way back."""

    arm: str
    goal: str
    path: TimedPath
    why: str
    may_touch: tuple[str, ...] = ()


class Coordinator:
    """Grants motions to arms. Call `observe`, `request` and `step`; `Arm.hold` says which arms to hold."""

    def __init__(self, arms: Iterable[ArmGeometry], options: Options | None = None, line: Line | None = None) -> None:
        """Coordinate these arms.

        Raises:
            ValueError: two arms are closer than the clearance at home.
        """
        self.options = options or Options()
        self.arms = {geometry.name: Arm(geometry) for geometry in arms}
        self.proofs = Proofs(self.options.clearance)
        self._line = line
        self._tickets, self._retreats = 0, 0
        self.alone: tuple[str, str, float] | None = None  # arm and goal that move alone, and when it was asked last [s]
        self.outcomes: dict[str, Decision] = {}  # refusals by goal
        names = list(self.arms)
        for i, a in enumerate(names):
            for b in names[i + 1:]:
                if clash := self.proofs.anywhere(self.arms[a].home, self.arms[b].home):
                    raise ValueError(f"are closer than {self.options.clearance:g} m at home: "
                                     f"{clash.pair[0]} and {clash.pair[1]}")

    # --- what is observed and requested ---------------------------------------------------------------------------

    def observe(self, arm: str, state: Observed) -> None:
        """Record the newest state of an arm."""
        self.arms[arm].state = state

    def carry(self, arm: str, body: ArmBody) -> None:
        """Record what an arm carries now; a waiting motion is proved again with it."""
        own = self.arms[arm]
        own.body = body
        if own.ticket is not None and own.ticket.moving is not None:
            own.ticket = replace(own.ticket, moving=replace(own.ticket.moving, body=body), possible=False, ways=None)

    def request(
        self, arm: str, goal: str, path: TimedPath | None, now: float, body: ArmBody | None = None,
        may_touch: Sequence[str] = (),
    ) -> Decision:
        """Answer a request, which is repeated until it is granted or refused; cell time [s]."""
        own = self.arms[arm]
        if goal in self.outcomes:
            return self.outcomes[goal]
        if own.committed is not None and own.committed.goal == goal:
            return Decision("granted")
        if path is None and self.alone is not None and self.alone[:2] == (arm, goal):
            self.alone = arm, goal, now
            return Decision("granted")
        ticket = own.ticket
        if ticket is None or ticket.goal != goal:
            self._tickets += 1
            number = -1 if goal.startswith(RETREAT) else self._tickets
            offset = None if own.state is None or path is None else path.positions[0] - own.state.q
            moving = None if path is None else Moving(body or own.body, ArmMotion(path, offset))
            ticket = own.ticket = Ticket(number, goal, moving, now, now)
            if moving is not None and path is not None:
                try:
                    ticket.moving = replace(moving, touch=self._touch(own, path, may_touch))
                except ValueError as error:
                    return self.refuse(own, "may_touch", str(error))
            if problem := self._impossible(own, ticket):
                return self.refuse(own, "blocked", problem)
        ticket.last = now
        return Decision("wait", message=ticket.reason or "its turn has not come",
                        waits_for=tuple(sorted(ticket.waits_for)), waited=now - ticket.first)

    def refuse(self, arm: Arm, error: str, message: str) -> Decision:
        """Refuse the waiting request of an arm."""
        assert arm.ticket is not None
        decision = self.outcomes[arm.ticket.goal] = Decision("refused", error, message)
        arm.ticket = None
        while len(self.outcomes) > 500:
            del self.outcomes[next(iter(self.outcomes))]
        return decision

    def _impossible(self, own: Arm, ticket: Ticket) -> str:
        """Return why a motion could not run even if all other arms were at home; empty if that is not known."""
        for other in self._others(own):
            if ticket.moving is not None and (clash := self.proofs.anywhere(ticket.moving, other.home)):
                return "" if self.proofs.exhausted else (
                    f"it would come closer than {self.options.clearance:g} m to {other.name} at home: "
                    + _named(clash))
        ticket.possible = True
        return ""

    def _others(self, own: Arm) -> list[Arm]:
        return [arm for arm in self.arms.values() if arm is not own]

    # --- tickets --------------------------------------------------------------------------------------------------

    def step(self, now: float) -> list[Retreat]:
        """Commit what may start, and return requests for arms that must move back; cell time [s]."""
        for arm in self.arms.values():
            self._follow_up(arm, now)
        if self.alone is not None and now - self.alone[2] > REPEATED / 2:
            self.alone = None
        waiting = sorted((arm for arm in self.arms.values() if arm.ticket is not None),
                         key=lambda arm: arm.ticket.number if arm.ticket else 0)
        for arm in waiting:
            self._try(arm, waiting, now)
        return self._retreats_for(waiting, now)

    def _follow_up(self, arm: Arm, now: float) -> None:
        """Note the end of a committed motion, and the pose of an arm at rest."""
        state, run = arm.state, arm.committed
        if arm.ticket is not None and now - arm.ticket.last > REPEATED:
            arm.ticket = None
        if state is None:
            return
        if run is not None:
            run.seen = run.seen or state.goal == run.goal
            run.schedule = replace(run.schedule, done=arm.done - PAST)
            if state.goal == run.goal or (not run.seen and now - run.since < 1.0):
                return
            self._end(arm, run, state, now)
        if state.at_rest:
            arm.set_rest(state.q, now)
            if arm.back is None:
                arm.back = self._line_home(arm, arm.rest)

    def _end(self, arm: Arm, run: Committed, state: Observed, now: float) -> None:
        """Record the way back of an arm whose motion is over, complete or not."""
        arm.rest, arm.rest_since = arm.end, now  # whose proofs are known
        arm.committed, arm.hold = None, ""
        arm.set_rest(state.q, now)
        if np.abs(state.q - run.motion.end).max() <= way_back.CLOSE:
            arm.back = run.back
        else:
            cut = way_back.reversed_path(run.motion.path, state.path_time)
            back = None if run.before is None else way_back.behind(way_back.reversed_path(cut), run.before)
            arm.back = None if back is None else self._touching(arm, arm.body, back, run.moving.touch)
        if arm.back is not None and np.abs(state.q - arm.back.motion.start).max() > way_back.CLOSE:
            arm.back = None
        for other in self._others(arm):
            if other.committed is not None:
                other.committed.parked_for.discard(arm.name)

    def _touch(self, arm: Arm, path: TimedPath, names: Sequence[str]) -> Touch | None:
        carried = {name: other.body.place(name, other.end.motion.end)
                   for other in self._others(arm) for name in other.body.carried}
        return touch_of(arm.geometry.robot, carried, path, names)

    def _touching(self, arm: Arm, body: ArmBody, path: TimedPath, touch: Touch | None) -> Moving:
        """Return a way back of an arm whose gripper may touch what it touched on its way there."""
        try:
            touch = touch and self._touch(arm, path, [touch.object])
        except ValueError:  # that is not there any more
            touch = None
        return Moving(body, ArmMotion(path), touch)

    def _line_home(self, arm: Arm, at: Moving) -> Moving | None:
        """Return the straight way home, if the scene of the arm is known to be free there."""
        line = _line(arm, at)
        return line if self._is_free(arm, line) else None

    def _is_free(self, arm: Arm, line: Moving) -> bool:
        q, home = line.motion.start, line.motion.end
        return bool(np.abs(q - home).max() <= way_back.CLOSE) or (
            self._line is not None and self._line(arm.name, q, home))

    def _try(self, arm: Arm, waiting: list[Arm], now: float) -> None:
        """Commit the waiting motion of an arm if that is proved; else set what it waits for."""
        ticket = arm.ticket
        assert ticket is not None
        ticket.waits_for.clear()
        ticket.reason = ""
        if arm.committed is None and arm.state and arm.state.goal == ticket.goal and arm.state.path_time > PAST:
            self.refuse(arm, "restarted", "the coordinator that held it on its path was restarted")
            return
        if not ticket.possible and (problem := self._impossible(arm, ticket)):
            self.refuse(arm, "blocked", problem)
            return
        if not ticket.possible:
            ticket.reason = UNFINISHED
            return
        if now - ticket.first > self.options.longest_wait:
            self.refuse(arm, "blocked_too_long", f"it waited {self.options.longest_wait:g} s")
            return
        if self.alone is not None and self.alone[0] != arm.name:
            ticket.waits_for.add(self.alone[0])
            ticket.reason = f"{self.alone[0]} moves alone"
            return
        if arm.committed is not None:
            ticket.reason = "its own motion is not over yet"
            return
        if arm.state is None or arm.state.held_by_others:
            ticket.reason = "the arm is held" if arm.state else "no state of the arm was received yet"
            return
        if self.options.turns and (moving := [each.name for each in self._others(arm) if each.committed is not None]):
            ticket.waits_for, ticket.reason = set(moving), f"one arm moves at a time, {moving[0]} now"
            return
        older = [each for each in waiting if each.ticket is not None and each.ticket.number < ticket.number]
        if ticket.moving is None:
            ticket.waits_for |= {each.name for each in self._others(arm) if each.committed is not None or each in older}
            ticket.reason = "the other arms must be at rest" if ticket.waits_for else ""
            if not ticket.waits_for:
                self.alone, arm.ticket = (arm.name, ticket.goal, now), None
            return
        for each in older:
            if not self._may_overtake(arm, ticket.end, each, now):
                ticket.waits_for.add(each.name)
                ticket.reason = f"the older request of {each.name} is first"
        if not ticket.waits_for:
            self._commit(arm, ticket, ticket.moving, now)

    def _may_overtake(self, arm: Arm, end: Moving, older: Arm, now: float) -> bool:
        """Return whether the older request can start as soon as an arm is at its end."""
        ticket = older.ticket
        assert ticket is not None
        if ticket.moving is None or now - ticket.first > self.options.overtaken:
            return False
        if arm.name not in ticket.waits_for:
            return True  # it waits for others only; with two arms this does not occur
        return self.proofs.anywhere(ticket.moving, end) is None

    def _commit(self, arm: Arm, ticket: Ticket, moving: Moving, now: float) -> None:
        delays, state = self.options.delays, arm.state
        rate = 1.0 if state is None else max(state.scaling, 0.05)
        schedule = Schedule(now + delays.message + AFTER_RELEASE * rate, rate)
        before = arm.back.motion.path if arm.back is not None else None
        braking = braking_time(moving.motion.path, arm.limits)
        for other in self._others(arm):
            if reason := self._conflict(moving, schedule, ticket.end, braking, other, now):
                ticket.waits_for.add(other.name)
                ticket.reason = reason
        if ticket.waits_for:
            return
        back = self._way_back(arm, ticket, moving, before)
        if back is None and self.proofs.exhausted:
            ticket.reason = UNFINISHED
            return
        if back is None:
            blockers = [other.name for other in self._others(arm) if not other.is_home]
            if not blockers:
                self.refuse(arm, "no_way_back", "no way back from its end to the home pose is proved")
            else:
                ticket.waits_for |= set(blockers)
                ticket.reason = f"no way back from its end is proved while {' and '.join(blockers)} is there"
            return
        frozen = {other.name for other in self._others(arm) if other.is_frozen or other.hold}
        arm.committed = Committed(ticket.goal, moving, schedule, ticket.end, back, before, now, braking)
        arm.ticket, arm.hold = None, ""
        for name in frozen:
            if (run := self.arms[name].committed) is not None:
                run.parked_for.add(arm.name)

    def _conflict(
        self, moving: Moving, schedule: Schedule, end: Moving, braking: float, other: Arm, now: float
    ) -> str:
        """Return why a motion may not start now because of another arm; empty if it may."""
        run, prove = other.committed, self.proofs
        if run is None:
            if clash := prove.anywhere(moving, other.rest):
                return f"{other.name} obstructs it at rest: " + _named(clash)
        elif other.is_frozen or other.hold:
            if self._passes(moving, (0.0, moving.motion.duration), end, other) is not None:
                return f"{other.name} is held on its path"
        else:
            if abs(other.lag(now, self.options.delays.report)) > self.options.delays.drift:
                return f"{other.name} is not on its schedule"
            band = self.options.delays.band(braking, run.braking)
            if clash := prove.in_time(moving, schedule, run.moving, run.schedule, band):
                return f"{other.name} moves there: " + _named(clash)
        if other.way_back is not None and not moving.enters and (clash := prove.anywhere(other.way_back, end)):
            return f"its end is on the way back of {other.name}: " + _named(clash)
        return ""

    def _passes(self, moving: Moving, rest_of: tuple[float, float], end: Moving, other: Arm) -> Clash | None:
        """Return where a motion clashes with a held arm, or the rest of that arm's motion with its end; None: free."""
        assert other.committed is not None
        run, done = other.committed, other.done
        reach = done + run.braking + self.options.delays.report
        return self.proofs.anywhere(moving, run.moving, rest_of, (done - PAST, reach)) or self.proofs.anywhere(
            end, run.moving, None, (done - PAST, run.motion.duration))

    def _way_back(self, arm: Arm, ticket: Ticket, moving: Moving, before: TimedPath | None) -> Moving | None:
        """Return a way back from the end of a motion that is free while the other arms are at their ends or home."""
        if ticket.ways is None or ticket.ways[0] is not before:
            path = way_back.behind(moving.motion.path, before)
            ticket.ways = before, _line(arm, ticket.end), None if path is None else self._touching(
                arm, moving.body, path, moving.touch)
        line, behind = ticket.ways[1:]
        for back in (line if self._is_free(arm, line) else None, behind):
            if back is not None and not any(
                    self.proofs.anywhere(back, other.end) or self.proofs.anywhere(back, other.home)
                    for other in self._others(arm)):
                return back
        return None

    # --- obstructing arms ------------------------------------------------------------------------------------------

    def _retreats_for(self, waiting: list[Arm], now: float) -> list[Retreat]:
        """Return requests for arms at rest that obstruct the oldest request."""
        oldest = next((arm for arm in waiting if arm.ticket is not None), None)
        if oldest is None or oldest.ticket is None:
            return []
        found = []
        for name in sorted(oldest.ticket.waits_for):
            other = self.arms[name]
            if other.committed is None and not (self.alone and self.alone[0] == name):
                done = self.move_back(other, oldest, oldest.ticket.first, now)
                if isinstance(done, str):
                    self.refuse(oldest, "blocked", f"{name} obstructs it and {done}")
                    return []
                found += done
        return found

    def move_back(self, arm: Arm, for_arm: Arm, since: float, now: float) -> list[Retreat] | str:
        """Return the request that an arm moves home, none yet, or why it cannot; it obstructs `since` [s]."""
        state = arm.state
        if state is None or state.grips or now - max(arm.rest_since, since) < self.options.patience or (
                arm.ticket is not None and arm.ticket.goal.startswith(RETREAT)):
            return []
        if arm.is_home:
            return "is at home"
        carried = [name for other in self._others(arm) for name in other.body.carried]
        if arm.back is None or (arm.back.touch is not None and arm.back.touch.object not in carried):
            return "has no proved way back"
        for other in self._others(arm):
            clash = None if other.committed is not None else self.proofs.anywhere(arm.rest, other.rest)
            if clash is not None and clash.certain:  # in a handover
                if arm.body.carried and other.body.carried:
                    return f"holds what {other.name} holds, too: open one of the grippers"
                if arm.back.touch is None and other.back is not None and other.back.touch is not None:
                    return self.move_back(other, arm, since, now)
        if not state.movable:
            return "must not be moved: it is stopped, has a fault, or an operator controls it"
        if arm.ticket is not None:
            self.refuse(arm, "retreats", f"it moves back, out of the way of {for_arm.name}")
        self._retreats += 1
        arm.rest_since = now  # another attempt follows after the patience
        return [Retreat(arm.name, f"{RETREAT}{self._retreats}", arm.back.motion.path,
                        f"out of the way of {for_arm.name}", () if arm.back.touch is None else (
                            arm.back.touch.object,))]


def _line(arm: Arm, at: Moving) -> Moving:
    return Moving(at.body, ArmMotion(way_back.straight(at.motion.end, arm.geometry.home, arm.limits)))


def _named(clash: Clash) -> str:
    return f"{clash.pair[0]} and {clash.pair[1]}"
