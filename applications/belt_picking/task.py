"""The task of belt picking: meet one object after the other on a running belt, lift it, and put it into a container."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from statistics import median_low
from typing import Literal

from pydantic import BaseModel, Field

from common import messages as m
from common.config import Tunable
from common.errors import ConfigError
from common.robot.transforms import tool_down
from common.tasks.handling import Handling, HandlingConfig, grasp_directions, top_of
from common.tasks.stages import AwaitImage, Command, Cycle, Grip, Move, Report, Stage, View, place_of
from common.tasks.tracking import Expected, pick_stages, time_grip

SKIPPED_FOR = 0.4  # [s] after a failed plan: the object is elsewhere then
LEAST_LEAD, LONGEST_LEAD = 0.3, 4.0  # [s] on a host that plans quickly or slowly
LATENCIES = 5  # the median of so many newest latencies counts
RESERVE = 1.5  # factor on times that were planned or measured
CLEAR = 0.03  # [m] between the tool and the objects below it, from which it may move to one of them
SAME_SPEED = 0.012  # [m/s] between belt and object: it moves with the belt
STEADY = 0.002  # [m/s] of the belt to its set speed: it neither starts nor brakes


class Config(HandlingConfig):
    """Parameters of picking from a belt; times are cell time."""

    belt: str = Field("", description="name of the conveyor; empty: the only one")
    window: tuple[float, float] = Field(
        (0.3, 0.9), description="objects are met and lifted between these distances from the start of the belt [m]")
    lead_time: Tunable[float] = Field(
        0.5, ge=0.1, le=5, description="from the decision to the start of the arm, in which it is planned, until the "
                                       "time that this needs was measured [s]")
    deviation: Tunable[float] = Field(
        0.006, gt=0, le=0.05, description="the motion ends before the fingers close if the belt puts the object so far "
                                          "from where it was expected [m]")
    settle: Tunable[float] = Field(6.0, ge=0, le=600, description="so long nothing comes before it is DONE; on a belt "
                                                       "with `end: wrap` at least for one turn [s]")

    def require_usable(self) -> None:
        """Check belt, window and container.

        Raises:
            ConfigError: names the field, the value and what is expected.
        """
        super().require_usable()
        belts, (begin, end) = self.world.conveyors, self.window
        if self.belt not in belts and (self.belt or len(belts) != 1):
            choices = ", ".join(belts) or "none"
            raise ConfigError("belt", self.belt or ..., f"is no conveyor of the world; choices: {choices}")
        length = belts[self.belt or next(iter(belts))].dimensions[0]
        if not 0 <= begin < end <= length:
            raise ConfigError("window", [begin, end], f"must increase within the belt, 0 to {length:g}")
        if not self.world.destinations:
            raise ConfigError("world.containers", ..., "is missing: the objects are put into the first container")


@dataclass
class BeltView(View):
    """Also knows the belts."""

    belts: m.ConveyorState | None = None


class Counts(BaseModel):
    """What an image of the container does not tell a restarted task: objects that lie on others are not counted."""

    done: int = 0
    attempts: int = 0


class BeltPicking(Handling):
    """Picks in motion."""

    p: Config
    ONE_DESTINATION = True
    _counts = Counts()

    def __init__(self, config: Config, status: m.TaskStatus, prefix: str, speed: float = 1.0) -> None:
        """Start without an object; the arguments are those of `Task`."""
        super().__init__(config, status, prefix, speed)
        self._name = config.belt or next(iter(config.world.conveyors))
        self._belt = config.world.conveyors[self._name]
        self._expected: Expected | None = None
        self._skipped: dict[str, float] = {}  # until when, by object [s]
        self._attempts = 0
        self._latencies: deque[float] = deque(maxlen=LATENCIES)  # from a decision to the accepted motion [s]
        self._decided = 0.0  # cell time of the last decision [s]
        self._took = 0.0  # planned duration of the last motion with an object [s]

    @property
    def memory(self) -> Counts:
        """Counters, for a restart."""
        now = Counts(done=self.status.done, attempts=self._attempts)
        if now != self._counts:
            self._counts = now
        return self._counts

    def remember(self, memory: BaseModel) -> None:
        """Continue to count."""
        assert isinstance(memory, Counts)
        self._counts, self._attempts = memory, memory.attempts
        self.status.done = self.status.total = memory.done

    # --- decisions -----------------------------------------------------------------------------------------------

    @property
    def _lead(self) -> float:
        """Time from a decision to the start of the arm, by what the last ones needed [s]."""
        if not self._latencies:
            return self.p.lead_time
        return min(max(RESERVE * median_low(self._latencies), LEAST_LEAD), LONGEST_LEAD)

    def decide(self, view: View) -> None:
        """Pick the next object from where the arm is, if one is in reach: it may leave before the arm is at home."""
        if view.holding or self.status.state == "DONE" or not self._in_reach(view):
            super().decide(view)
        elif self._is_low(view):
            self.queue += [self.retreat(view), AwaitImage()]
        elif self.has_fresh_image(view):
            self.choose(view)

    def choose(self, view: View) -> None:
        """Wait for an object in reach that moves evenly, and pick it."""
        assert isinstance(view, BeltView) and view.gripper is not None and view.motion is not None
        if view.gripper.width < self.gripper.max_width - self.p.finger_clearance:
            self.queue.append(Grip("open", self.status.state, width=self.gripper.max_width))
            return
        coming = list(self._coming(view))
        if coming:
            self.wait_timer.reset()
        elif not self._problem_of(view):
            self.finish(view, self._turn_time(view), attempts=self._attempts)
            return
        self.status.message = self._problem_of(view)
        if self.status.message:
            return
        for way, thing in self._in_reach(view)[:1]:
            self._pick(way, thing, view)

    def _turn_time(self, view: BeltView) -> float:
        """Return the time in which an object out of view comes back on a circulating belt [s]."""
        belt = view.belts.find(self._name) if view.belts is not None else None
        if self._belt.end != "wrap" or belt is None or belt.speed == 0.0:
            return 0.0
        return self._belt.dimensions[0] / abs(belt.speed)

    def _in_reach(self, view: View) -> list[tuple[float, m.CollisionObject]]:
        """Return the objects that can be met now, farthest first, with their distance from the start [m]."""
        assert isinstance(view, BeltView)
        return [] if self._problem_of(view) else [
            (way, thing) for way, thing in self._coming(view) if self._is_near(way, thing)
            and self._skipped.get(thing.id, 0.0) <= view.now and self._moves_along(thing, view)]

    def _coming(self, view: View) -> Iterator[tuple[float, m.CollisionObject]]:
        """Yield the objects before the end of the window, farthest first, with their distance from the start [m]."""
        found = []
        for thing in view.objects("target"):
            x, y, z = place_of(thing.pose)
            way = self._belt.along(x, y)[0]
            if self._belt.carries(x, y, z - thing.dimensions[-1] / 2, 0.02) and way < self.p.window[1]:
                found.append((way, thing))
        yield from sorted(found, key=lambda each: -each[0])

    def _problem_of(self, view: BeltView) -> str:
        """Return why no object can be met now."""
        belt = view.belts.find(self._name) if view.belts is not None else None
        if belt is None:
            return "no state of the belt received yet"
        if view.motion is not None and view.motion.speed_scaling < 1.0:
            return f"the arm is at {view.motion.speed_scaling:.0%} of its speed: it cannot follow the belt"
        if abs(belt.speed - (belt.set_speed if belt.running else 0.0)) > STEADY and belt.speed != 0.0:
            return "the belt changes its speed"
        return ""

    def _is_near(self, way: float, thing: m.CollisionObject) -> bool:
        """Return whether an object will be in the window when the arm can be there; it is not met long before."""
        return way + self._speed_of(thing) * 2 * self._lead >= self.p.window[0]

    def _would_miss(self, view: View) -> bool:
        """Return whether the next object is in reach now, but not after the queued motion home and an image there."""
        home = next((stage.seconds for stage in self.queue if isinstance(stage, Move)), 0.0)
        needed = RESERVE * (home + view.now - view.scene_stamp + self._lead + self._took)
        return any(way + self._speed_of(thing) * needed > self.p.window[1] for way, thing in self._in_reach(view)[:1])

    def _is_low(self, view: View) -> bool:
        """Return whether the tool may be between objects on the belt."""
        assert isinstance(view, BeltView)
        return view.tool[2] < max((top_of(thing) for _, thing in self._coming(view)), default=self._belt.top) + CLEAR

    def _speed_of(self, thing: m.CollisionObject) -> float:
        (c, s), v = self._belt.direction, thing.velocity
        return c * v.x + s * v.y

    def _moves_along(self, thing: m.CollisionObject, view: BeltView) -> bool:
        belt = view.belts.find(self._name) if view.belts is not None else None
        return belt is not None and abs(self._speed_of(thing) - belt.speed) < SAME_SPEED

    def _pick(self, way: float, thing: m.CollisionObject, view: BeltView) -> None:
        assert view.scene is not None and view.belts is not None
        belt = view.belts.find(self._name)
        assert belt is not None
        x, y, z = place_of(thing.pose)
        ways = grasp_directions(thing, self.gripper.closing_axis, self.gripper.max_width)
        yaw, width = min(ways, key=self._sideways)
        self._decided = view.now
        stamp, begin = view.scene.header.stamp, round((view.now + self._lead) * 1e9)
        self._expected = Expected(self._name, view.belts.header.stamp * 1e-9, belt.position, belt.speed,
                                  begin * 1e-9)
        self.queue += pick_stages(
            tool_down(x, y, self.p.grasp.height(z), yaw), thing, stamp, begin, self.gripper, Cycle(thing.id),
            width=width or 0.0, opening=view.gripper.width if view.gripper else 0.0,
            approach=self.p.grasp.approach_clearance, travel=self.p.window[1] - way,
            width_tolerance=self.p.width_tolerance)

    def _sideways(self, grip: tuple[float, float | None]) -> float:
        """Return how far the fingers close along the belt, 0 to 1: across it, an object leaves a hand that stops."""
        T = tool_down(0.0, 0.0, 0.0, grip[0])
        axis = T[:2, "xy".index(self.gripper.closing_axis)]
        return abs(float(axis @ self._belt.direction))

    def destination(self, thing: m.CollisionObject, view: View) -> m.Pose | None:
        """Return the pose above the emptiest corner of the first container."""
        return self.room_in(self.p.world.destinations[0], thing, view)

    # --- while it moves --------------------------------------------------------------------------------------------

    def planned(self, move: Move, response: m.PlanResponse) -> None:
        """Let the fingers close when the tool is at the object."""
        grip = next((stage for stage in self.queue if isinstance(stage, Grip)), None)
        if move.name == "track" and response.ok and grip is not None and self._expected is not None:
            self._expected.closes = time_grip(grip, move, response)
            assert response.trajectory is not None
            self._took = response.trajectory.points[-1].time_from_start

    def plan_failed(self, move: Move, response: m.PlanResponse, view: View) -> None:
        """Leave an object that cannot be met for a moment: another one may be."""
        if move.name != "track":
            super().plan_failed(move, response, view)
            return
        self.clear()
        self.status.message = response.message
        if move.cycle is not None:
            self._skipped[move.cycle.subject] = view.now + SKIPPED_FOR

    def may_start(self, stage: Stage, view: View) -> bool:
        """Return whether a stage may start: the belt moves as planned, and the time to start is not over."""
        if stage.name == "track" and isinstance(stage, Move):
            late = view.now - stage.start_at * 1e-9
            if late > 0.0:
                self._latencies.append(view.now - self._decided)
            if late > 0.0 or self._deviates(view):
                self.clear()
                return False
        return super().may_start(stage, view)

    def on_goal(self, answer: Report, view: View) -> None:
        """Measure how long it took from the decision until the motion was accepted, or came too late."""
        one = self.running
        if one is not None and one.stage.name == "track" and one.command.id == answer.id:
            self._latencies.append(view.now - self._decided)
        super().on_goal(answer, view)

    def stop(self, view: View, reason: str, by: Literal["operator", "requester"] = "requester") -> list[Command]:
        """Stop the arm; an object that it has not been near is still where the last image showed it."""
        seen, running = self.images_after, self.running
        commands = super().stop(view, reason, by)
        if by == "requester" and running is not None and running.stage.name == "track" and not self._is_low(view):
            self.images_after = seen
        return commands

    def outdated(self, stage: Stage, view: View) -> str:
        """Return why the object is not where the motion leads, until the fingers begin to close."""
        assert view.motion is not None
        if stage.name != "track" or not isinstance(stage, Move) or self._expected is None:
            return ""
        late = 0.0
        if view.motion.plan == stage.plan:
            late = self._expected.lag(view.motion)
        if view.now >= self._expected.closes + max(late, 0.0):
            return ""
        if view.motion.held or view.motion.speed_scaling < 1.0 or (
                late * abs(self._expected.speed) > self.p.deviation):
            return "the arm is late for the object"
        return self._deviates(view)

    def _deviates(self, view: View) -> str:
        if self._expected is None or not isinstance(view, BeltView):
            return ""
        off = self._expected.deviation(view.belts)
        if abs(off) <= self.p.deviation:
            return ""
        return f"the belt changed its speed: the object is {1e3 * off:+.0f} mm off"

    def obstacles(self, move: Move, view: View) -> list[tuple[float, float]]:
        """(x, y) [m] of objects that lie still: the others are elsewhere in each scene."""
        moving = {place_of(thing.pose)[:2] for thing in view.objects("target") if thing.moves}
        return [] if move.name == "track" else [at for at in super().obstacles(move, view) if at not in moving]

    def succeeded(self, stage: Stage, view: View) -> None:
        """Count attempts, and objects that were put down."""
        super().succeeded(stage, view)
        self._attempts += stage.name == "track"
        if stage.name == "up" and self._would_miss(view):
            self.clear()
        if stage.name == "release":
            self.status.done += 1
            self.status.total = self.status.done
