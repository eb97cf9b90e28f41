"""The fields of a step as an operator enters them: millimeters, degrees and percent, and a choice of alternatives."""

from __future__ import annotations

import math
import re
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from applications.programming.editing import Data, EditRefused, bodies
from applications.programming.files import flow_text
from applications.programming.model import STEPS, BaseStep, Condition, Part, Target
from common.config import parse_yaml
from common.errors import ConfigError

DEGREE = 180 / math.pi
UNITS = {  # by that of the file: displayed per stored value, and the unit that is displayed
    "m": (1e3, "mm"), "m/s": (1e3, "mm/s"), "rad": (DEGREE, "°"), "s": (1.0, "s"), "N": (1.0, "N"), "kg": (1.0, "kg")}
LABELS = {"rpy": "Roll, pitch, yaw", "by": "Displacement", "name": "Pose", "wait": "Wait for", "loop": "Repeat"}
COMMON = ("id", "note", "on_failure", "speed", "touch", "requires")  # rarely changed, listed last
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)e[+-]?\d{1,3}", re.IGNORECASE)  # which is a text in YAML
Path = tuple[str | int, ...]


@dataclass(frozen=True)
class Known:
    """What a form offers.

    Attributes:
        poses, signals, programs: names.
        outputs: names of signals that can be set.
        joints: present joint positions [rad, m]; None: unknown.
        position, rpy: present pose of the tool center point in world [m], [rad].
        scales: displayed values per joint position.
    """

    poses: Sequence[str] = ()
    signals: Sequence[str] = ()
    outputs: Sequence[str] = ()
    programs: Sequence[str] = ()
    joints: Sequence[float] | None = None
    position: Sequence[float] = (0.0, 0.0, 0.0)
    rpy: Sequence[float] = (math.pi, 0.0, 0.0)
    scales: Sequence[float] = ()

    def here(self, *, tool: bool = False) -> Data:
        """Return the present pose as a target: joint positions, or the pose of the tool in world.

        Raises:
            EditRefused: it is unknown.
        """
        if self.joints is None:
            raise EditRefused("the joint positions are unknown: no reading received yet")
        given = {"position": self.position, "rpy": self.rpy} if tool else {"joints": self.joints}
        return {name: [round(float(each), 5) for each in values] for name, values in given.items()}


@dataclass(frozen=True)
class FormField:
    """A field of the form.

    Attributes:
        path: of the value in the data of the step; the complete step for ().
        label: with the unit.
        kind: of the element: check, choice, vector or text.
        shown: displayed value.
        hint: meaning.
        options: of a choice.
        parse: returns the stored value of a displayed one; None: the default. Raises ConfigError.
    """

    path: Path
    label: str
    kind: Literal["check", "choice", "vector", "text"]
    shown: Any
    hint: str
    parse: Callable[[Any], Any]
    options: list[str] = field(default_factory=list)

    @property
    def common(self) -> bool:
        """Whether steps of every kind have it."""
        return bool(self.path) and self.path[0] in COMMON

    def values(self, step: Mapping[str, Any], shown: Any) -> Data:
        """Return the fields of the step to set for a displayed value. Raises ConfigError."""
        stored = self.parse(shown)
        return {str(self.path[0]): _with(step.get(str(self.path[0])), self.path[1:], stored)} if self.path else dict(
            stored)


def _with(data: Any, path: Path, value: Any) -> Any:
    """Return a copy of data with another value at a path; None removes it."""
    if not path:
        return value
    first, *rest = path
    if isinstance(first, int):
        return [_with(each, tuple(rest), value) if number == first else each for number, each in enumerate(data)]
    data = {"name": data} if isinstance(data, str) else data or {}  # a target that is given by its name
    new = _with(data.get(first), tuple(rest), value)
    return {key: each for key, each in {**data, first: new}.items() if each is not None}


def fields_of(step: Data, known: Known, point: int = 0) -> list[FormField]:
    """Return the form of a step; of several points, that with the number `point` is shown."""
    kind = STEPS[step["step"]]
    found, hidden = _alternatives(kind, step, known, ()), {"step", *bodies(step), *_hidden(kind, step)}
    for key, name in sorted(kind.keys().items(), key=lambda each: each[0] in COMMON):
        info, value = kind.model_fields[name], step.get(key)
        part = _part_in(info.annotation)
        if key in hidden:
            continue
        if part is None:
            found.append(_field(info, key, (key,), value, known))
        elif isinstance(value, list):
            number = min(point, len(value) - 1)
            found += _part_fields(part, (key, number), value[number], known)
        elif value is not None or not issubclass(part, Part):
            found += _part_fields(part, (key,), value or {}, known)
    return found


def new_step(kind: str, known: Known) -> Data:
    """Return the data of a new step: its required fields, and the first of its alternatives. Raises EditRefused."""
    model, made = STEPS[kind], {"step": kind}
    keys = [key for key, name in model.keys().items() if model.model_fields[name].is_required()]
    for key in [*keys, *next(iter(model.ONE_OF.values()), ())[:1]]:
        made |= _first(model, key, known)
    return made


def _first(kind: type[Part], key: str, known: Known) -> Data:
    """Return the first value of a field: a name that exists, the present pose, its example, or an empty list."""
    info = kind.model_fields[kind.keys()[key]]
    outputs = issubclass(kind, BaseStep)
    names = {"name": (known.poses, "named poses"), "program": (known.programs, "other programs"),
             "signal": (known.outputs if outputs else known.signals, "outputs" if outputs else "signals")}
    if key in names:
        choices, what = names[key]
        if not choices:
            raise EditRefused(f"this cell has no {what}")
        return {key: choices[0]}
    if kind is Target and key in ("joints", "position"):
        return known.here(tool=key == "position")
    if info.examples:
        return {key: info.examples[0]}
    part = _part_in(info.annotation)
    if part is Target:
        here = known.here(tool=key == "at")
        return {key: [here] if get_origin(info.annotation) is list else here}
    if part is Condition:
        return {key: {"signal": known.signals[0]} if known.signals else {"holding": True}}
    return {key: []}


# --- alternatives: of each exactly one is given ---


def _current(kind: Any, data: Mapping[str, Any]) -> str:
    """Return the label of the alternative that is given; empty for a part without alternatives."""
    some: Mapping[str, tuple[str, ...]] = getattr(kind, "ONE_OF", {})
    return next((label for label, keys in some.items() if keys and keys[0] in data), list(some)[-1] if some else "")


def _hidden(kind: type[Part], data: Mapping[str, Any]) -> list[str]:
    current = _current(kind, data)
    return [key for label, keys in kind.ONE_OF.items() if label != current for key in keys]


def _alternatives(kind: Any, data: Mapping[str, Any], known: Known, path: Path) -> list[FormField]:
    if not (current := _current(kind, data)):
        return []
    some: Mapping[str, tuple[str, ...]] = kind.ONE_OF

    def parse(chosen: str) -> Data:
        new = _first(kind, keys[0], known) if (keys := some.get(chosen, ())) else {}
        return new if path else {name: new.get(name) for fields in some.values() for name in fields}

    label = f"Point {int(path[1]) + 1}" if path[1:] else str(path[0] if path else data["step"])
    return [FormField(path, LABELS.get(label, label.capitalize()), "choice", current, "which of these is given", parse,
                      list(some))]


def _part_fields(kind: type[BaseModel], path: Path, data: Any, known: Known) -> list[FormField]:
    """Return the fields of a target, a condition or another part."""
    data = {"name": data} if isinstance(data, str) else data
    names = kind.ONE_OF[_current(kind, data)] if issubclass(kind, Part) else kind.model_fields
    return [*_alternatives(kind, data, known, path),
            *(_field(kind.model_fields[name], name, (*path, name), data.get(name), known) for name in names)]


# --- single values ---


def _field(info: FieldInfo, name: str, path: Path, value: Any, known: Known) -> FormField:
    default = None if info.is_required() else info.get_default(call_default_factory=True)
    described = re.search(r"\[([^]]*)\]", info.description or "")
    scale, unit = (100.0, "%") if name == "speed" else UNITS.get(described[1] if described else "", (1.0, ""))
    label = " ".join([LABELS.get(name, name.replace("_", " ").capitalize()), *([f"[{unit}]"] if unit else [])])
    hint = re.sub(r" *\[[^]]*\]", "", info.description or "").lstrip("; ")  # the unit of the file
    choices = {"name": known.poses, "signal": known.outputs if path == ("signal",) else known.signals,
               "program": known.programs}.get(name)
    if get_origin(info.annotation) is Literal:
        choices = get_args(info.annotation)
    given = default if value is None else value
    if choices and given in choices:
        return FormField(path, label, "choice", given, hint, str, list(choices))
    if info.annotation is bool:
        return FormField(path, label, "check", bool(given), hint, bool)
    size = next((len(get_args(each)) for each in _types(info.annotation) if get_origin(each) is tuple), 0)
    if size == 3:
        vector = tuple(round(scale * each, 3) for each in (given or (0.0, 0.0, 0.0)))
        return FormField(path, label, "vector", vector, hint, lambda entered: [each / scale for each in entered])
    if size or name == "joints":
        values, scales = list(given or ()), [scale] * size
        if name == "joints":
            label = "Joints [°, mm]"
            scales = list(known.scales) if len(known.scales) == len(values) else [DEGREE] * len(values)
        shown = ", ".join(f"{round(scale * each, 3):g}" for scale, each in zip(scales, values, strict=bool(values)))
        return FormField(path, label, "text", shown, hint, partial(_numbers, name, scales))
    brackets = {list: "[]", dict: "{}"}.get(get_origin(info.annotation) or str, "")
    shown = "" if given in (None, [], {}) else _text(given, scale)
    if not info.is_required() and default not in (None, "", [], {}):
        hint += f"{'; ' if hint else ''}empty: {_text(default, scale)}"
    return FormField(path, label, "text", shown, hint, lambda entered: entered.strip() or None) if (
        info.annotation is str) else FormField(path, label, "text", shown, hint, partial(_value, name, scale, brackets))


def _text(value: Any, scale: float) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, float | int):
        return f"{round(scale * value, 6):g}" if abs(scale * value) < 1e6 else str(value)
    if isinstance(value, str):
        return value
    written = flow_text(value)
    return written[1:-1] if isinstance(value, dict | list) else written


def _value(name: str, scale: float, brackets: str, entered: str) -> Any:
    """Return the value of a text: a number, true, false, a word, or for a list or map its items."""
    entered = entered.strip()
    if not entered:
        return None
    entered = f"{brackets[:1]}{entered}{brackets[1:]}"
    try:
        value = float(entered) if _NUMBER.fullmatch(entered) else parse_yaml(entered)
    except (yaml.YAMLError, ValueError):
        raise ConfigError(name, entered[:40], "cannot be read") from None
    if isinstance(value, float | int) and not isinstance(value, bool) and scale != 1.0:
        return value / scale
    return value


def _numbers(name: str, scales: Sequence[float], entered: str) -> list[float] | None:
    if not entered.strip():
        return None
    try:
        values = [float(each) for each in entered.replace(";", ",").split(",")]
    except ValueError:
        raise ConfigError(name, entered[:40], "must be numbers, separated by commas") from None
    if len(values) != len(scales):
        raise ConfigError(name, entered[:40], f"must be {len(scales)} numbers, not {len(values)}")
    return [int(value) if scale == 1.0 and value.is_integer() else value / scale
            for value, scale in zip(values, scales, strict=True)]


def _types(annotation: Any) -> Iterator[Any]:
    yield annotation
    if get_origin(annotation) in (list, Union, types.UnionType, Annotated):
        for each in get_args(annotation):
            yield from _types(each)


def _part_in(annotation: Any) -> type[BaseModel] | None:
    """Return the model of a field, or of the items of a list."""
    return next((each for each in _types(annotation) if isinstance(each, type) and issubclass(each, BaseModel)), None)
