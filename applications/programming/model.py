"""A program as data: typed steps in a YAML file, see docs/programs.md. The kinds are in steps.py and handling.py.

    cell: panda
    steps:
      - {step: move, to: home}
      - {step: wait, for: {signal: door_closed}, timeout: 30}

Positions are those of the tool centre point in world [m], joint positions are in the order of the robot [rad, m].
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializeAsAny,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
)
from pydantic import model_validator as after
from pydantic_core import InitErrorDetails, PydanticCustomError

from common.config import Number

if TYPE_CHECKING:
    from applications.programming.building import Builder, Built
    from applications.programming.targets import Cell

Distance = Annotated[float, Field(gt=0, le=2, allow_inf_nan=False, description="[m]")]
Bounded = Annotated[Number, Field(ge=-1000, le=1000)]
Metres3 = tuple[Bounded, Bounded, Bounded]
Share = Annotated[float, Field(gt=0, le=1)]
Timeout = Annotated[float, Field(gt=0, le=86_400)]
Id = Annotated[str, Field(max_length=60, pattern=r"^[\w.-]*$")]
Word = Annotated[str, Field(min_length=1, max_length=80)]
DOWN = (math.pi, 0.0, 0.0)  # roll, pitch, yaw of a tool that points down [rad]
MOST_STEPS = 1000


def _error(kind: str, text: str, choices: Sequence[str], key: str, value: Any) -> InitErrorDetails:
    return {"type": PydanticCustomError(kind, f"{text}; choices: {', '.join(choices)}"),
            "loc": (key,), "input": value}


class Part(BaseModel):
    """Base of everything in a program. A field's unit is in its description, its first value on the page in `examples`.

    Attributes:
        ONE_OF: alternatives by their label on the page: keys of each, of whose first ones exactly one is given; at most
            one if an alternative has none.
    """

    model_config = ConfigDict(frozen=True, allow_inf_nan=False, populate_by_name=True)
    ONE_OF: ClassVar[Mapping[str, tuple[str, ...]]] = {}

    @classmethod
    def keys(cls) -> dict[str, str]:
        """Return the attributes by their keys in the file."""
        return {info.alias or name: name for name, info in cls.model_fields.items()}

    @after(mode="before")
    @classmethod
    def _require_known_keys(cls, value: Any) -> Any:
        if isinstance(value, dict):
            known = cls.keys()
            unknown = [_error("unknown_field", "is not a field", sorted(known), key, given)
                       for key, given in value.items() if key not in known and key not in cls.model_fields]
            if unknown:
                raise ValidationError.from_exception_data(cls.__name__, unknown)
        return value

    @after(mode="after")
    def _require_one(self) -> Self:
        keys = [some[0] for some in self.ONE_OF.values() if some]
        given = [key for key in keys if getattr(self, self.keys()[key]) not in ("", None)]
        if keys and len(given) != 1 and (given or () not in self.ONE_OF.values()):
            raise ValueError(f"a {type(self).__name__.lower()} has exactly one of {', '.join(keys)}"
                             + (f", not {' and '.join(given)}" if given else ""))
        return self


class Target(Part):
    """Where the tool moves: a name, joint positions, a pose in world, or a motion relative to the present pose."""

    ONE_OF: ClassVar = {"named pose": ("name",), "joint positions": ("joints",), "tool pose": ("position", "rpy"),
              "displacement": ("by", "turn", "frame")}

    name: str = Field("", description="pose of the program, of the robot file, or saved on the page")
    joints: list[Bounded] | None = Field(None, min_length=1, max_length=64, description="[rad, m]")
    position: Metres3 | None = Field(None, description="of the tool centre point in world [m]")
    rpy: Metres3 = Field(DOWN, description="roll, pitch, yaw about fixed axes, with position [rad]; default: down")
    by: Metres3 | None = Field(None, description="displacement from the present pose [m]", examples=[[0.0, 0.0, 0.05]])
    turn: Metres3 = Field((0.0, 0.0, 0.0), description="roll, pitch, yaw about the tool's own axes, with by [rad]")
    frame: Literal["world", "tool"] = Field("world", description="whose axes `by` follows")

    @after(mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @model_serializer(mode="wrap")
    def _short(self, write: SerializerFunctionWrapHandler) -> Any:
        return self.name or write(self)

    def __str__(self) -> str:
        if self.joints is not None:
            return "joints " + ", ".join(f"{math.degrees(each):.0f}" for each in self.joints)
        numbers = ", ".join(f"{1e3 * each:.0f}" for each in self.position or self.by or ())
        return self.name or f"{'here + ' if self.by else ''}{numbers} mm"


class Condition(Part):
    """What a program decides by: a signal, whether the gripper holds something, or how the step before ended."""

    ONE_OF: ClassVar = {"signal": ("signal", "value", "above", "below"), "gripper holds": ("holding",),
              "outcome of the step before": ("outcome",)}

    signal: str = ""
    value: bool = True
    above: Number | None = None
    below: Number | None = None
    holding: bool | None = Field(None, examples=[True])
    outcome: str = Field("", max_length=80, description="succeeded, failed, or what a Python function returned",
                         examples=["succeeded"])

    def __str__(self) -> str:
        if not self.signal:
            return f"outcome {self.outcome}" if self.outcome else (
                f"the gripper holds {'something' if self.holding else 'nothing'}")
        limits = [f"{word} {limit:g}" for word, limit in (("above", self.above), ("below", self.below))
                  if limit is not None]
        return f"{self.signal} {' and '.join(limits) or ('on' if self.value else 'off')}"


class BaseStep(Part):
    """A step. Each kind is one subclass, in steps.py or handling.py: files, page, dry run and export derive from it.

    Attributes:
        BODIES: fields that hold further steps.
        UNKNOWN: why a dry run does not know how long it takes.
        ENDS_ANYWHERE: whether the state of the robot after it is not known before it runs; it is not repeated.
        id: unique in a program; a missing one is chosen when the file is read.
    """

    BODIES: ClassVar[tuple[str, ...]] = ()
    UNKNOWN: ClassVar[str] = ""
    ENDS_ANYWHERE: ClassVar[bool] = False

    step: str = ""  # kind
    id: Id = ""
    note: str = Field("", max_length=500)
    on_failure: Literal["stop", "continue"] = Field(
        "stop", description="stop with an error, or continue with the outcome failed")

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Register a kind."""
        if kind := cls.model_fields["step"].default:
            STEPS.setdefault(kind, cls)

    def __str__(self) -> str:
        """What it does in a few words, in millimeters and degrees."""
        return self.step

    def stages(self, at: Builder) -> Built:
        """Return its stages, and what is expected after them; none by default. Raises StepProblem."""
        return at.built([])

    def problems(self, cell: Cell, folder: Path) -> Iterator[tuple[str, str]]:
        """Yield field and problem of what can never run in a cell, besides poses and signals."""
        yield from ()

    def bodies(self) -> Iterator[tuple[str, Sequence[BaseStep]]]:
        """Yield its lists of further steps by their keys."""
        return ((key, getattr(self, name)) for key, name in self.keys().items() if name in self.BODIES)

    def targets(self) -> Iterator[tuple[str, Target]]:
        """Yield its targets by their keys."""
        for key, name in self.keys().items():
            value = getattr(self, name)
            if isinstance(value, Target):
                yield key, value
            elif isinstance(value, list):
                yield from ((f"{key}[{i}]", each) for i, each in enumerate(value) if isinstance(each, Target))

    @model_serializer(mode="wrap")
    def _with_kind(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {"step": self.step, **write(self)}


STEPS: dict[str, type[BaseStep]] = {}  # by kind


def _of_kind(value: Any) -> Any:
    if isinstance(value, BaseStep):
        return value
    kind = value.get("step") if isinstance(value, dict) else value
    if not isinstance(kind, str) or kind not in STEPS:
        raise ValidationError.from_exception_data("step", [_error(
            "unknown_step", "is not a step", list(STEPS), "step", kind)])
    return STEPS[kind].model_validate(value)


Step = Annotated[SerializeAsAny[BaseStep], BeforeValidator(_of_kind)]
Steps = Annotated[list[Step], Field(min_length=1, max_length=MOST_STEPS)]


class Motion(BaseStep):
    """What steps that move the arm have."""

    speed: Share | None = Field(None, description="share of the joints' speed limits; default: of program or cell")
    touch: list[Word] = Field([], max_length=50, description="ids or classes of objects that the gripper may touch")
    requires: dict[Word, bool] = Field({}, description="signals that must have these values during the motion")


class Program(Part):
    """Steps, and the poses that they name."""

    cell: str = Field("", description="cell in which it runs by default: a name, or a path relative to its folder")
    note: str = Field("", max_length=2000)
    speed: Share | None = Field(None, description="of all motions without one of their own")
    poses: dict[Word, Target] = {}
    steps: Steps

    @after(mode="after")
    def _require_fixed_poses(self) -> Program:
        for name, target in self.poses.items():
            if target.name or target.by is not None:
                raise ValueError(f"pose {name} must have joints or a position")
        return self


def walk(steps: Sequence[BaseStep], above: str = "steps") -> Iterator[tuple[str, BaseStep]]:
    """Yield every step with its path in the file, such as `steps[2].then[0]`."""
    for number, step in enumerate(steps):
        path = f"{above}[{number}]"
        yield path, step
        for name, body in step.bodies():
            yield from walk(body, f"{path}.{name}")


def as_data(program: Program) -> dict[str, Any]:
    """Return a program as its file contains it, without default values."""
    return program.model_dump(mode="json", by_alias=True, exclude_defaults=True)
