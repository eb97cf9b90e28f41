"""A program as data: typed steps in a YAML file. docs/programs.md describes them.

    cell: panda
    steps:
      - {step: move, to: home}
      - {step: wait, for: {signal: door_closed}, timeout: 30}

Positions are those of the tool centre point in world [m], joint positions are in the order of the robot [rad, m].
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue, SerializerFunctionWrapHandler, model_serializer
from pydantic import model_validator as after

from common.config import Number
from common.tasks.palletizing import Pattern

Distance = Annotated[float, Field(gt=0, le=2, allow_inf_nan=False)]  # [m]
Bounded = Annotated[Number, Field(ge=-1000, le=1000)]
Metres3 = tuple[Bounded, Bounded, Bounded]
Share = Annotated[float, Field(gt=0, le=1)]
Timeout = Annotated[float, Field(gt=0, le=86_400)]
Id = Annotated[str, Field(max_length=60, pattern=r"^[\w.-]*$")]
Word = Annotated[str, Field(min_length=1, max_length=80)]
DOWN = (math.pi, 0.0, 0.0)  # roll, pitch, yaw of a tool that points down [rad]
MOST_STEPS = 1000


class Part(BaseModel):
    """Base of everything in a program."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True)


class Target(Part):
    """Where the tool moves: a name, joint positions, a pose in world, or a motion relative to the present pose."""

    name: str = Field("", description="pose of the program, of the robot file, or saved on the page")
    joints: list[Bounded] | None = Field(None, min_length=1, max_length=64, description="[rad, m]")
    position: Metres3 | None = Field(None, description="of the tool centre point in world [m]")
    rpy: Metres3 = Field(DOWN, description="roll, pitch, yaw about fixed axes, with position [rad]; default: down")
    by: Metres3 | None = Field(None, description="displacement from the present pose [m]")
    turn: Metres3 = Field((0.0, 0.0, 0.0), description="roll, pitch, yaw about the tool's own axes, with by [rad]")
    frame: Literal["world", "tool"] = Field("world", description="whose axes `by` follows")

    @after(mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @after(mode="after")
    def _require_one(self) -> Target:
        given = [name for name in ("name", "joints", "position", "by") if getattr(self, name) not in ("", None)]
        if len(given) != 1:
            raise ValueError("a target has exactly one of name, joints, position, by"
                             + (f", not {' and '.join(given)}" if given else ""))
        return self

    @model_serializer(mode="wrap")
    def _short(self, write: SerializerFunctionWrapHandler) -> Any:
        return self.name or write(self)


class Condition(Part):
    """What a program decides by: a signal, whether the gripper holds something, or how the step before ended."""

    signal: str = ""
    value: bool = True
    above: Number | None = None
    below: Number | None = None
    holding: bool | None = None
    outcome: str = Field("", max_length=80, description="succeeded, failed, or what a Python function returned")

    @after(mode="after")
    def _require_one(self) -> Condition:
        given = [name for name in ("signal", "holding", "outcome") if getattr(self, name) not in ("", None)]
        if len(given) != 1:
            raise ValueError("a condition has exactly one of signal, holding, outcome"
                             + (f", not {' and '.join(given)}" if given else ""))
        return self


class BaseStep(Part):
    """What every step has. `id` is unique in a program; a missing one is chosen when the file is read."""

    BODIES: ClassVar[tuple[str, ...]] = ()  # fields that hold further steps

    id: Id = ""
    note: str = Field("", max_length=500)
    on_failure: Literal["stop", "continue"] = Field(
        "stop", description="stop with an error, or continue with the outcome failed")

    def bodies(self) -> Iterator[tuple[str, Sequence[BaseStep]]]:
        """Yield its lists of further steps, by field as in the file."""
        for name in self.BODIES:
            field = type(self).model_fields[name]
            yield field.alias or name, getattr(self, name)


class Motion(BaseStep):
    """What steps that move the arm have."""

    speed: Share | None = Field(None, description="share of the joints' speed limits; default: of program or cell")
    touch: list[Word] = Field([], max_length=50, description="ids or classes of objects that the gripper may touch")
    requires: dict[Word, bool] = Field({}, description="signals that must have these values during the motion")


class Move(Motion):
    """Move to a target."""

    step: Literal["move"] = "move"
    to: Target
    straight: bool = Field(False, description="move the tool in a straight line")


class Through(Motion):
    """Move through several targets, in one motion with rounded corners, or with a stop at each."""

    step: Literal["through"] = "through"
    points: list[Target] = Field(min_length=1, max_length=200)
    blend: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="radius of the corners [m]; 0: stop at each")
    straight: bool = False


class Approach(Motion):
    """Move in front of a target, then straight to it."""

    step: Literal["approach"] = "approach"
    to: Target
    distance: Distance = 0.1
    axis: Literal["tool", "world"] = Field("tool", description="from behind along the tool's z axis, or from above")


class Retreat(Motion):
    """Move straight back from where the tool is."""

    step: Literal["retreat"] = "retreat"
    distance: Distance = 0.1
    axis: Literal["tool", "world"] = Field("tool", description="back along the tool's z axis, or up")


class Grip(BaseStep):
    """Move the fingers."""

    step: Literal["grip"] = "grip"
    width: Annotated[float, Field(ge=0, le=0.2)] | Literal["open", "close"] = Field(description="[m]")
    force: Annotated[float, Field(ge=0, le=1e4)] = Field(0.0, description="[N]; 0: the gripper's default")
    holds: bool | None = Field(None, description="whether something must be held at the end")
    expected_width: Annotated[float, Field(ge=0, le=0.2)] | None = Field(None, description="of what is held [m]")
    width_tolerance: Annotated[float, Field(gt=0, le=0.2)] = Field(0.005, description="of expected_width [m]")
    mass: Annotated[float, Field(ge=0, le=1000)] = Field(0.0, description="of what is held [kg]; 0: unknown")


class Output(BaseStep):
    """Set an output."""

    step: Literal["output"] = "output"
    signal: Word
    value: bool | Number = True


class Wait(BaseStep):
    """Wait for a time [s], or for a signal."""

    step: Literal["wait"] = "wait"
    seconds: Annotated[float, Field(ge=0, le=86_400)] | None = None
    until: Condition | None = Field(None, alias="for")
    timeout: Timeout = Field(10.0, description="for the signal [s]")

    @after(mode="after")
    def _require_one(self) -> Wait:
        if (self.seconds is None) == (self.until is None):
            raise ValueError("a wait has either seconds or for")
        if self.until is not None and not self.until.signal:
            raise ValueError("a wait is for a signal")
        return self


class Loop(BaseStep):
    """Repeat steps a number of times, or while a condition holds, or without end."""

    BODIES: ClassVar[tuple[str, ...]] = ("steps",)

    step: Literal["loop"] = "loop"
    count: Annotated[int, Field(ge=0, le=10**9)] | None = None
    condition: Condition | None = Field(None, alias="while")
    steps: list[Step] = Field(min_length=1, max_length=MOST_STEPS)

    @after(mode="after")
    def _require_one(self) -> Loop:
        if self.count is not None and self.condition is not None:
            raise ValueError("a loop has either count or while")
        return self


class If(BaseStep):
    """Do one of two lists of steps."""

    BODIES: ClassVar[tuple[str, ...]] = ("then", "otherwise")

    step: Literal["if"] = "if"
    condition: Condition = Field(alias="when")
    then: list[Step] = Field(min_length=1, max_length=MOST_STEPS)
    otherwise: list[Step] = Field([], max_length=MOST_STEPS, alias="else")


class Call(BaseStep):
    """Do the steps of another program of the same folder."""

    step: Literal["call"] = "call"
    program: Annotated[str, Field(min_length=1, max_length=80, pattern=r"^[\w-]+$")]


class Pick(BaseStep):
    """Grasp an object of the planning scene from above: the nearest one that fits."""

    step: Literal["pick"] = "pick"
    kind: str = Field("", max_length=80, description="class of the object as its detector names it; default: any")
    role: Literal["target", "contained"] = Field("target", description="free, or in a container")
    object: str = Field("", max_length=80, description="id of the object; default: any")
    force: Annotated[float, Field(ge=0, le=1e4)] = Field(0.0, description="[N]; 0: that of the object or gripper")
    timeout: Timeout = Field(5.0, description="until such an object is seen [s]")
    speed: Share | None = None


class Place(BaseStep):
    """Move above a target, straight to it, open the fingers, and move back."""

    step: Literal["place"] = "place"
    at: Target = Field(description="of the tool centre point at the release")
    distance: Distance = 0.1
    speed: Share | None = None


class Palletize(BaseStep):
    """For each place of a pattern on a pallet: do `steps`, which bring an item into the gripper, and place it there."""

    BODIES: ClassVar[tuple[str, ...]] = ("steps",)

    step: Literal["palletize"] = "palletize"
    pattern: Pattern
    height: Number = Field(0.0, description="of the tool centre point above the centre of an item at the release; not "
                                            "for an item that was picked by sight [m]")
    distance: Distance = 0.1
    speed: Share | None = None
    steps: list[Step] = Field(min_length=1, max_length=MOST_STEPS)


class Force(BaseStep):
    """What steps have whose end the force at the tool decides. They are not repeated after a failure."""

    direction: Metres3 = (0.0, 0.0, -1.0)
    frame: Literal["base", "tool", "world"] = Field("world", description="whose axes the direction follows")
    touch: list[Word] = Field([], max_length=50, description="ids or classes of objects that may be touched, also by "
                                                             "what is held")


class Until(Force):
    """Move the tool straight until it presses with a force."""

    step: Literal["until"] = "until"
    force: Annotated[float, Field(gt=0, le=1000)] = Field(description="[N]")
    max_distance: Distance = Field(0.05, description="without contact until there it fails [m]")
    tool_speed: Annotated[float, Field(gt=0, le=0.25)] = Field(0.01, description="[m/s]")


class Insert(Force):
    """Press the held part, search its hole on a spiral, and push it in."""

    step: Literal["insert"] = "insert"
    depth: Distance = Field(description="below the first contact [m]")
    force: Annotated[float, Field(gt=0, le=1000)] = Field(12.0, description="[N]")
    max_distance: Distance | None = Field(None, description="from the start [m]; default: the depth and 20 mm")


class Python(BaseStep):
    """Call a function of the user, `module:function`; what it returns is the outcome."""

    step: Literal["python"] = "python"
    function: Annotated[str, Field(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$", max_length=200)]
    arguments: dict[str, JsonValue] = {}
    timeout: Timeout = Field(10.0, description="[s]")


Step = Annotated[
    Move | Through | Approach | Retreat | Grip | Output | Wait | Loop | If | Call | Pick | Place | Palletize | Until
    | Insert | Python,
    Field(discriminator="step")]
STEPS: dict[str, type[BaseStep]] = {
    kind.model_fields["step"].default: kind
    for kind in (Move, Through, Approach, Retreat, Grip, Output, Wait, Loop, If, Call, Pick, Place, Palletize, Until,
                 Insert, Python)}


class Program(Part):
    """Steps, and the poses that they name."""

    cell: str = Field("", description="cell in which it runs by default: a name, or a path relative to its folder")
    note: str = Field("", max_length=2000)
    speed: Share | None = Field(None, description="of all motions without one of their own")
    poses: dict[Word, Target] = {}
    steps: list[Step] = Field(min_length=1, max_length=MOST_STEPS)

    @after(mode="after")
    def _require_fixed_poses(self) -> Program:
        for name, target in self.poses.items():
            if target.name or target.by is not None:
                raise ValueError(f"pose {name} must have joints or a position")
        return self


for _model in (Loop, If, Palletize, Program):
    _model.model_rebuild()


def walk(steps: Sequence[BaseStep], above: str = "steps") -> Iterator[tuple[str, BaseStep]]:
    """Yield every step with its path in the file, such as `steps[2].then[0]`."""
    for number, step in enumerate(steps):
        path = f"{above}[{number}]"
        yield path, step
        for name, body in step.bodies():
            yield from walk(body, f"{path}.{name}")


def as_data(program: Program) -> dict[str, Any]:
    """Return a program as its file contains it, without default values."""
    data: dict[str, Any] = program.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    data["steps"] = [_step_data(step) for step in program.steps]
    return data


def _step_data(step: BaseStep) -> dict[str, Any]:
    fields = step.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    for name, body in step.bodies():
        if body:
            fields[name] = [_step_data(each) for each in body]
    return {"step": type(step).model_fields["step"].default, **fields}
