"""What a person decided about motion: stops, holds, goals that must never move, and the speed. No clock, no file.

Those of persons are part of a record, which outlives this process; what the watchdog and the controller hold is not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from common.errors import Refused
from common.messages import UNKNOWN_OPERATOR, HoldRequest, Interlock, StopRequest
from common.messages.basics import either_name
from common.messages.execution import NOT_PERSISTED
from common.sources import wall_ns

OTHERS = "others"  # share one entry when there are too many
MOST = 16  # entries of persons
MOST_REASON = 300  # characters
MOST_GOALS = 200  # ids of goals that were stopped
SLOWEST = 0.05  # share of the speed when nobody knows what it was set to
STOPPED = "stopped"
LATEST = 7 * 10**18  # [ns since the Unix epoch], in the year 2191: a later `since` leaves no room for those after it


def _not_late(interlock: Interlock) -> Interlock:
    if interlock.since > LATEST:
        raise ValueError(f"since {interlock.since} is later than {LATEST}")
    return interlock


class Speed(BaseModel):
    """The share of their speed at which trajectories are followed, as it was set while the cell ran."""

    model_config = ConfigDict(extra="forbid")

    scaling: float = Field(ge=0, le=1)
    configured: float | None = Field(None, ge=0, le=1)  # that it was set instead of


class Record(BaseModel):
    """What outlives the process."""

    model_config = ConfigDict(extra="forbid")

    version: Literal[1] = 1
    interlocks: list[Annotated[Interlock, AfterValidator(_not_late)]] = Field(
        [], max_length=2 * MOST - 8, validation_alias=either_name("interlocks"))  # and our own
    goals: list[str] = Field([], max_length=MOST_GOALS)
    speed: Speed | None = None
    newest: int = Field(0, ge=0, le=LATEST)  # `since` of the newest interlock there ever was
    arm_stopped: bool = False  # the arm's own controller had stopped it for safety, and nobody has had it recover yet


class Interlocks:
    """Says whether the robot may move, and remembers who said that it may not."""

    def __init__(self, record: Record | None = None, now: Callable[[], int] = wall_ns) -> None:
        """Begin with what was recorded; `now` is the time since the Unix epoch [ns]."""
        record = record or Record()
        self._persons = {(interlock.kind, interlock.by): interlock for interlock in record.interlocks}
        self._own: dict[str, Interlock] = {}  # watchdog and controller
        self._goals = dict.fromkeys(record.goals)
        self._newest = record.newest
        self._now = now
        self._problem, self._kept = "", record.interlocks
        self.speed, self.arm_stopped = record.speed, record.arm_stopped

    @property
    def record(self) -> Record:
        """What has to outlive the process."""
        return Record(interlocks=[*self._persons.values()], goals=[*self._goals], speed=self.speed, newest=self._newest,
                      arm_stopped=self.arm_stopped)

    @property
    def all(self) -> list[Interlock]:
        """All that keeps the robot from moving."""
        return [*map(self._as_kept, self._persons.values()), *self._own.values()]

    def note_kept(self, record: Record, problem: str = "") -> None:
        """Take note of what outlives the process, and of why the rest does not: `all` says so from now on."""
        self._problem, self._kept = problem, record.interlocks

    @property
    def holds(self) -> list[Interlock]:
        """What persons hold."""
        return [interlock for interlock in self._persons.values() if interlock.kind == "held"]

    @property
    def stops(self) -> list[Interlock]:
        """What persons stopped."""
        return [interlock for interlock in self._persons.values() if interlock.kind == "stopped"]

    def stop(self, request: StopRequest) -> None:
        """Take note that a person stopped the robot."""
        self._put("stopped", request.owner, request.reason)

    def hold(self, request: HoldRequest) -> list[Interlock]:
        """Take note that somebody holds the robot, or what that request lets go of: of none that is another's."""
        if request.by != "operator":
            self.hold_ourselves(request.by, request.hold, request.reason)
            return []
        if request.hold:
            self._put("held", request.owner, request.reason)
            return []
        let_go = [interlock for interlock in self._persons.values() if _lets_go(request, interlock)]
        for interlock in let_go:
            del self._persons[interlock.kind, interlock.by]
            if request.into_stop and ("stopped", interlock.by) not in self._persons:
                self._persons["stopped", interlock.by] = interlock.model_copy(update={"kind": "stopped"})
        return let_go

    def hold_ourselves(self, holder: str, hold: bool, reason: str) -> None:
        """Take note that watchdog or controller holds the robot or lets it go."""
        if hold:
            self._own[holder] = self._made("held", holder, reason)
        else:
            self._own.pop(holder, None)

    def never(self, goals: Iterable[str]) -> None:
        """Remember goals that must not move the robot any more, should they come, or come again."""
        for goal in goals:
            self._goals.pop(goal, None)
            self._goals[goal] = None
        while len(self._goals) > MOST_GOALS:
            del self._goals[next(iter(self._goals))]

    def objection(self, goal: str, owner: str = "", acknowledged: int | None = None) -> Refused | None:
        """What speaks against a motion of arm or fingers, or None.

        Args:
            goal: its id.
            owner: the person who asks for it. The stops of this person, and of nobody else, do not speak against it
                when they were heard of before it was asked for.
            heard: `since` of the newest interlock that this person had heard of.
        """
        if goal in self._goals:
            return Refused(STOPPED, f"goal {goal!r} was stopped before")
        passes = (owner, UNKNOWN_OPERATOR) if owner and acknowledged is not None else ()
        stops = [stop for stop in self.stops if stop.by not in passes or stop.since > (acknowledged or 0)]
        return Refused(STOPPED, "; ".join(stop.description for stop in stops)) if stops else None

    def _as_kept(self, interlock: Interlock) -> Interlock:
        if not self._problem or interlock in self._kept:
            return interlock
        reason = f"{NOT_PERSISTED} ({self._problem}), lost if the executor ends"
        reason += interlock.reason and f"; {interlock.reason}"
        return interlock.model_copy(update={"reason": reason[:MOST_REASON]})

    def _put(self, kind: Literal["stopped", "held"], owner: str, reason: str) -> None:
        by = owner or UNKNOWN_OPERATOR
        if (kind, by) not in self._persons and len(self._persons) >= MOST:
            by = OTHERS
        self._persons[kind, by] = self._made(kind, by, reason)

    def _made(self, kind: Literal["stopped", "held"], by: str, reason: str) -> Interlock:
        self._newest = max(self._newest + 1, self._now())
        return Interlock(kind=kind, by=by, reason=reason[:MOST_REASON], since=self._newest)


def _lets_go(request: HoldRequest, interlock: Interlock) -> bool:
    if request.acknowledged is not None and interlock.since > request.acknowledged:
        return False  # was said after that request was decided
    if request.override:
        return True
    if interlock.kind == "stopped":
        return request.stops
    return interlock.by in (request.owner, UNKNOWN_OPERATOR)


def speed_of(kept: Speed | None, configured: float) -> float:
    """The share at which trajectories are followed: the kept one, unless another one was configured since.

    Then it is the slower of the two.
    """
    if kept is None:
        return configured
    return kept.scaling if kept.configured == configured else min(kept.scaling, configured)


def damaged(why: str) -> Record:
    """A record in the place of one that cannot be read: stopped, and slow."""
    reason = f"what persons decided cannot be read: {why}. Look at the cell before you start it"
    stop = Interlock(kind="stopped", by="trajectory_executor", reason=reason[:MOST_REASON], since=wall_ns())
    return Record(interlocks=[stop], speed=Speed(scaling=SLOWEST), newest=stop.since, arm_stopped=True)
