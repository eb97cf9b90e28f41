"""The task of belt picking: meet one object after the other on a running belt, lift it, and put it into a container."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pydantic import Field

from common import messages as m
from common.config import Tunable
from common.errors import ConfigError
from common.robot.transforms import tool_down
from common.tasks.handling import Handling, HandlingConfig, grasp_directions
from common.tasks.stages import Cycle, Grip, Move, Stage, View, place_of
from common.tasks.tracking import Expected, pick_stages, time_grip

SKIPPED_FOR = 0.4  # [s] after a failed plan: the object is elsewhere then
LONGEST_LEAD = 4.0  # [s] on a host that plans slowly
SAME_SPEED = 0.012  # [m/s] between belt and object: it moves with the belt
STEADY = 0.002  # [m/s] of the belt to its set speed: it neither starts nor brakes


class Config(HandlingConfig):
    """Parameters of picking from a belt; times are cell time."""

    belt: str = Field("", description="name of the conveyor; empty: the only one")
    window: tuple[float, float] = Field(
        (0.3, 0.9), description="objects are met and lifted between these distances from the start of the belt [m]")
    lead_time: Tunable[float] = Field(
        0.5, ge=0.1, le=5, description="from the decision to the start of the arm, in which it is planned [s]")
    deviation: Tunable[float] = Field(
        0.006, gt=0, le=0.05, description="the motion ends before the fingers close if the belt puts the object so far "
                                          "from where it was expected [m]")
    settle: Tunable[float] = Field(6.0, ge=0, le=600, description="so long nothing comes before it is DONE [s]")

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


class BeltPicking(Handling):
    """Picks in motion."""

    p: Config

    def __init__(self, config: Config, status: m.TaskStatus, prefix: str, speed: float = 1.0) -> None:
        """Start without an object; the arguments are those of `Task`."""
        super().__init__(config, status, prefix, speed)
        self._name = config.belt or next(iter(config.world.conveyors))
        self._belt = config.world.conveyors[self._name]
        self._expected: Expected | None = None
        self._skipped: dict[str, float] = {}  # until when, by object [s]
        self._attempts = 0
        self._lead = config.lead_time  # [s] more while plans come too late

    # --- decisions -----------------------------------------------------------------------------------------------

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
            self.finish(view, attempts=self._attempts)
            return
        self.status.message = self._problem_of(view)
        if self.status.message:
            return
        for way, thing in coming:
            waits = self._skipped.get(thing.id, 0.0) > view.now
            if not waits and self._is_near(way, thing) and self._moves_along(thing, view):
                self._pick(way, thing, view)
                return

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
                self._lead = min(self._lead + late + self.p.lead_time, LONGEST_LEAD)
            if late > 0.0 or self._deviates(view):
                self.clear()
                return False
        return super().may_start(stage, view)

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
        if stage.name == "release":
            self.status.done += 1
            self.status.total = self.status.done
