"""The kinds of steps that move the arm, use I/O, or decide what follows; handling.py has the others."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field, JsonValue
from pydantic import model_validator as after

from applications.programming.building import RUNNING, Builder, Built
from applications.programming.functions import find_function
from applications.programming.model import (
    MOST_STEPS,
    BaseStep,
    Condition,
    Distance,
    Metres3,
    Motion,
    Step,
    Steps,
    Target,
    Timeout,
    Word,
)
from applications.programming.targets import Cell, StepProblem, backed, pose_goal
from common import messages as m
from common.config import Number
from common.errors import ConfigError, ZencellError
from common.tasks import stages as engine
from common.tasks.force import ForceMove, MoveUntil
from common.tasks.force import Insert as InsertMove
from common.tasks.signals import Output as OutputStage
from common.tasks.signals import WaitFor

Width = Annotated[float, Field(ge=0, le=0.2)]
SEQUENCE = "sequence"  # planner of motions through several targets
INSERT_ROOM = 0.02  # [m] above the hole, where an insertion starts at most


class Move(Motion):
    """Move to a target."""

    step: Literal["move"] = "move"
    to: Target
    straight: bool = Field(False, description="move the tool in a straight line")

    def __str__(self) -> str:
        return f"move {'straight ' if self.straight else ''}to {self.to}"

    def stages(self, at: Builder) -> Built:
        """Return its stages."""
        goal, T = at.resolve(self.to)
        if self.straight:
            goal = pose_goal(T)
        return at.built([at.motion(self, self.id, goal, straight=self.straight)], T)


class Through(Motion):
    """Move through several targets, in one motion with rounded corners, or with a stop at each."""

    step: Literal["through"] = "through"
    points: list[Target] = Field(min_length=1, max_length=200)
    blend: float = Field(0.0, ge=0, le=1, description="radius of the corners [m]; 0: stop at each")
    straight: bool = False

    def __str__(self) -> str:
        return f"move through {len(self.points)} points"

    def stages(self, at: Builder) -> Built:
        """Return its stages."""
        T, items = at.before.T_world_tcp, list[m.SequenceItem]()
        for target in self.points:
            goal, T = at.resolve(target, T)
            items.append(m.SequenceItem(goal=pose_goal(T) if self.straight else goal, straight=self.straight,
                                        blend_radius=self.blend))
        if not self.blend:
            return at.built([at.motion(self, f"{self.id} {number} of {len(items)}", item.goal, straight=self.straight)
                             for number, item in enumerate(items, 1)], T)
        items[-1] = items[-1].model_copy(update={"blend_radius": 0.0})
        motion = at.motion(self, self.id, m.SequenceGoal(items=items))
        motion.planner = SEQUENCE
        return at.built([motion], T)


class Approach(Motion):
    """Move in front of a target, then straight to it."""

    step: Literal["approach"] = "approach"
    to: Target
    distance: Distance = 0.1
    axis: Literal["tool", "world"] = Field("tool", description="from behind along the tool's z axis, or from above")

    def __str__(self) -> str:
        return f"approach to {self.to}"

    def stages(self, at: Builder) -> Built:
        """Return its stages."""
        T = at.resolve(self.to)[1]
        return at.built([at.motion(self, f"{self.id} before", pose_goal(backed(T, self.distance, self.axis))),
                         at.motion(self, self.id, pose_goal(T), straight=True)], T)


class Retreat(Motion):
    """Move straight back from where the tool is."""

    step: Literal["retreat"] = "retreat"
    distance: Distance = 0.1
    axis: Literal["tool", "world"] = Field("tool", description="back along the tool's z axis, or up")

    def __str__(self) -> str:
        return f"retreat {1e3 * self.distance:g} mm"

    def stages(self, at: Builder) -> Built:
        """Return its stages."""
        start = at.before.T_world_tcp
        if start is None:
            raise StepProblem("the pose of the tool is not known")
        T = backed(start, self.distance, self.axis)
        motion = at.motion(self, self.id, pose_goal(T), straight=True)
        motion.touches = [*motion.touches, *at.fingers_on(at.near(start))]
        return at.built([motion], T)


class Grip(BaseStep):
    """Move the fingers."""

    step: Literal["grip"] = "grip"
    width: Width | Literal["open", "close"] = Field(description="[m]", examples=["open"])
    force: float = Field(0.0, ge=0, le=1e4, description="[N]; 0: the gripper's default")
    holds: bool | None = Field(None, description="whether something must be held at the end")
    expected_width: Width | None = Field(None, description="of what is held [m]")
    width_tolerance: float = Field(0.005, gt=0, le=0.2, description="of expected_width [m]")
    mass: float = Field(0.0, ge=0, le=1000, description="of what is held [kg]; 0: unknown")

    def __str__(self) -> str:
        return f"{self.width} gripper" if isinstance(self.width, str) else f"grip {1e3 * self.width:g} mm"

    def _width(self, cell: Cell) -> float:
        gripper = cell.require_gripper()
        width = {"open": gripper.max_width, "close": 0.0}.get(str(self.width), self.width)
        assert isinstance(width, float)
        if width > gripper.max_width:
            raise StepProblem(f"width: {width:g} m is more than the {gripper.max_width:g} m of the open gripper")
        return width

    def problems(self, cell: Cell, folder: Path) -> Iterator[tuple[str, str]]:
        """Yield what can never run."""
        try:
            self._width(cell)
        except ZencellError as error:
            yield "width", str(error)

    def stages(self, at: Builder) -> Built:
        """Return its stages."""
        width = self._width(at.cell)
        stage = engine.Grip(self.id, RUNNING, at.cycle, width=width, effort=self.force, mass=self.mass,
                            holds=self.holds, expected_width=self.expected_width, width_tolerance=self.width_tolerance)
        free = not at.before.holding and self.holds is not True and width >= (at.before.width or 0.0)
        return Built([stage], replace(at.before, width=width), known=free)


class Output(BaseStep):
    """Set an output."""

    step: Literal["output"] = "output"
    signal: Word
    value: bool | Number = True

    def __str__(self) -> str:
        value = f"{self.value:g}" if not isinstance(self.value, bool) else "on" if self.value else "off"
        return f"set {self.signal} {value}"

    def stages(self, at: Builder) -> Built:
        """Return its stages."""
        return at.built([OutputStage(self.signal, self.value, name=self.id, state=RUNNING, cycle=at.cycle)])


class Wait(BaseStep):
    """Wait for a time [s], or for a signal."""

    ONE_OF: ClassVar = {"a time": ("seconds",), "a signal": ("for", "timeout")}

    step: Literal["wait"] = "wait"
    seconds: Annotated[float, Field(ge=0, le=86_400)] | None = Field(None, description="[s]", examples=[1.0])
    until: Condition | None = Field(None, alias="for")
    timeout: Timeout = Field(10.0, description="for the signal [s]")

    @after(mode="after")
    def _require_signal(self) -> Wait:
        if self.until is not None and not self.until.signal:
            raise ValueError("a wait is for a signal")
        return self

    def __str__(self) -> str:
        return f"wait for {self.until}" if self.until is not None else f"wait {self.seconds:g} s"

    def stages(self, at: Builder) -> Built:
        """Return its stages."""
        until = self.until
        return at.built([] if until is None else [WaitFor(
            until.signal, until.value, self.timeout, above=until.above, below=until.below, name=self.id, state=RUNNING,
            cycle=at.cycle)])


class Loop(BaseStep):
    """Repeat steps a number of times, or while a condition holds, or without end."""

    BODIES: ClassVar[tuple[str, ...]] = ("steps",)
    ONE_OF: ClassVar = {"a number of times": ("count",), "while a condition holds": ("while",), "without end": ()}

    step: Literal["loop"] = "loop"
    count: Annotated[int, Field(ge=0, le=10**9)] | None = Field(None, examples=[2])
    condition: Condition | None = Field(None, alias="while", examples=[{"holding": True}])
    steps: Steps

    def __str__(self) -> str:
        if self.condition is not None:
            return f"repeat while {self.condition}"
        return "repeat" if self.count is None else f"repeat {self.count} times"


class If(BaseStep):
    """Do one of two lists of steps."""

    BODIES: ClassVar[tuple[str, ...]] = ("then", "otherwise")

    step: Literal["if"] = "if"
    condition: Condition = Field(alias="when")
    then: Steps
    otherwise: list[Step] = Field([], max_length=MOST_STEPS, alias="else")

    def __str__(self) -> str:
        return f"if {self.condition}"


class Call(BaseStep):
    """Do the steps of another program of the same folder."""

    step: Literal["call"] = "call"
    program: str = Field(min_length=1, max_length=80, pattern=r"^[\w-]+$")

    def __str__(self) -> str:
        return f"call {self.program}"


def _require_length(direction: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(direction):
        raise ValueError("must not be 0 along all axes")
    return direction


class Force(BaseStep):
    """What steps have whose end the force at the tool decides."""

    UNKNOWN = "the force decides where it ends"
    ENDS_ANYWHERE = True

    direction: Annotated[Metres3, AfterValidator(_require_length)] = (0.0, 0.0, -1.0)
    frame: Literal["base", "tool", "world"] = Field("world", description="whose axes the direction follows")
    touch: list[Word] = Field([], max_length=50, description="ids or classes of objects that may be touched, also by "
                                                             "what is held")

    def by_force(self, at: Builder, kind: type[ForceMove], **fields: Any) -> Built:
        """Return the stage of a force motion."""
        held, things = at.before.object, at.objects(self.touch)
        return Built([kind(
            self.id, RUNNING, at.cycle, direction=self.direction, frame=self.frame, carries=at.before.holding,
            attach=held, attach_pose=at.before.pose, **fields,
            touches=at.fingers_on(things) + [(held, thing.id) for thing in things if held])],
            replace(at.before, T_world_tcp=None), known=False)


class Until(Force):
    """Move the tool straight until it presses with a force."""

    step: Literal["until"] = "until"
    force: float = Field(gt=0, le=1000, description="[N]", examples=[5.0])
    max_distance: Distance = Field(0.05, description="without contact until there it fails [m]")
    tool_speed: float = Field(0.01, gt=0, le=0.25, description="[m/s]")

    def stages(self, at: Builder) -> Built:
        """Return its stages."""
        return self.by_force(at, MoveUntil, force=self.force, max_distance=self.max_distance,
                             fields={"speed": self.tool_speed})


class Insert(Force):
    """Press the held part, search its hole on a spiral, and push it in."""

    step: Literal["insert"] = "insert"
    depth: Distance = Field(description="below the first contact [m]", examples=[0.02])
    force: float = Field(12.0, gt=0, le=1000, description="[N]")
    max_distance: Distance | None = Field(None, description="from the start [m]; default: the depth and 20 mm")

    def stages(self, at: Builder) -> Built:
        """Return its stages."""
        return self.by_force(at, InsertMove, force=self.force, fields={"depth": self.depth},
                             max_distance=self.max_distance or self.depth + INSERT_ROOM)


class Python(BaseStep):
    """Call a function of the user, `module:function`; what it returns is the outcome."""

    UNKNOWN = "the time that the function takes"

    step: Literal["python"] = "python"
    function: str = Field(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$", max_length=200, examples=["module:function"])
    arguments: dict[str, JsonValue] = Field({})
    timeout: Timeout = Field(10.0, description="[s]")

    def __str__(self) -> str:
        return f"python {self.function}"

    def problems(self, cell: Cell, folder: Path) -> Iterator[tuple[str, str]]:
        """Yield what can never run."""
        try:
            find_function(self.function, folder)
        except ConfigError as error:
            yield "function", f"{error.value!r} {error.expected}"

    def stages(self, at: Builder) -> Built:
        """Return its stages."""
        return Built([], at.before, known=False)
