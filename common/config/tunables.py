"""List the parameters of a running service, and change tunable ones: all of a request or none."""

from __future__ import annotations

import math
import re
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import BaseModel, JsonValue
from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python

from common.config.basics import AtRunTime, Parameters, Section, check, is_section
from common.config.cell import Cell
from common.config.loading import yaml_line
from common.config.world import Surroundings
from common.errors import ConfigError, Refused, UnknownName
from common.messages import Parameter

Kind = Literal["number", "integer", "boolean", "string", "list", "mapping"]

# A unit in brackets in a description, such as "[m]" or "[s, wall time]", but not "[0..255]" or "[x, y, z]".
UNIT = re.compile(r"\[(%|(?![xyz]\b)[A-Za-z][\w/^*]*|1/[a-z]+)(?:, [^\[\]]*)?\]")


@dataclass(frozen=True)
class Leaf:
    """One parameter: the model that holds its value, and its field."""

    path: str
    owner: BaseModel
    name: str
    info: FieldInfo
    default: Any  # `...` if required

    @property
    def value(self) -> Any:
        """Current value."""
        return getattr(self.owner, self.name)

    @property
    def runtime(self) -> bool:
        """Whether it may change while the service runs."""
        return is_tunable(self.info)


@dataclass(frozen=True)
class Change:
    """A parameter and its new value, which `apply` sets."""

    leaf: Leaf
    value: Any

    def __str__(self) -> str:
        return f"{self.leaf.path}: {yaml_line(self.leaf.value)} -> {yaml_line(self.value)}"


def is_tunable(info: FieldInfo) -> bool:
    """Return whether a field may change at run time."""
    return any(isinstance(mark, AtRunTime) for mark in info.metadata)


def tunable_sections(config: type[BaseModel]) -> dict[str, type[Section]]:
    """Return by path the sections of the cell that a service declares and that have tunable fields."""
    found = {}
    for info in config.model_fields.values():
        kind = info.annotation
        if is_section(kind) and any(is_tunable(field) for field in kind.model_fields.values()):  # type: ignore[union-attr]
            found[section_path(kind)] = kind  # type: ignore[arg-type]
    return found  # type: ignore[return-value]


def section_path(kind: type[Section]) -> str:
    """Return the path of a section in cell files and `--set`."""
    if kind is Surroundings:
        return "world"
    return next(name for name, info in Cell.model_fields.items() if info.annotation is kind)


def leaves(config: Parameters, service: str) -> dict[str, Leaf]:
    """Return all parameters of a service by path: its own, nested ones too, and those of tunable sections.

    A field with `repr=False`, such as a password, is left out.
    """
    found = {leaf.path: leaf for leaf in _leaves(config, f"services.{service}", None)}
    sections = tunable_sections(type(config))
    for name, info in type(config).model_fields.items():
        for path, kind in sections.items():
            if info.annotation is kind:
                found |= {leaf.path: leaf for leaf in _leaves(getattr(config, name), path, None)}
    return found


def _leaves(model: BaseModel, prefix: str, defaults: BaseModel | None) -> Iterator[Leaf]:
    for name, info in type(model).model_fields.items():
        if (is_section(info.annotation) and not isinstance(model, Section)) or not info.repr:
            continue  # a secret, such as a password
        default = getattr(defaults, name) if defaults is not None else info.get_default(call_default_factory=True)
        if info.is_required() and defaults is None:
            default = ...
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            yield from _leaves(value, f"{prefix}.{name}", default if isinstance(default, BaseModel) else None)
        else:
            yield Leaf(f"{prefix}.{name}", model, name, info, default)


# --- description ---------------------------------------------------------------------------------------


def values_of(config: Parameters, service: str) -> dict[str, JsonValue]:
    """Return the values of all parameters of a service by path, as JSON values."""
    return {path: to_jsonable_python(leaf.value) for path, leaf in leaves(config, service).items()}


def describe(config: Parameters, service: str, started: Mapping[str, JsonValue] | None = None) -> list[Parameter]:
    """Return every parameter of a service with its current value, in the order of declaration.

    Args:
        config: of the service.
        service: its name.
        started: values by path at the start of the service; by default the current ones.
    """
    return [_described(leaf, started or {}) for leaf in leaves(config, service).values()]


def _described(leaf: Leaf, started: Mapping[str, JsonValue]) -> Parameter:
    value = to_jsonable_python(leaf.value)
    initial = started.get(leaf.path, value)
    description = leaf.info.description or ""
    units = UNIT.findall(description)
    kind = kind_of(leaf.info.annotation)
    minimum, maximum = _limits(leaf.info, whole=kind == "integer")
    return Parameter(
        path=leaf.path, value=value, default=initial if leaf.default is ... else to_jsonable_python(leaf.default),
        type=kind, minimum=minimum, maximum=maximum, choices=choices_of(leaf.info.annotation),
        unit=units[-1] if units else "", description=description, runtime=leaf.runtime, changed=value != initial,
    )


def kind_of(annotation: Any) -> Kind:
    """Return the JSON type of a Python type."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return kind_of(arguments[0])
    if origin in (typing.Union, types.UnionType):
        kinds = [kind_of(argument) for argument in arguments if argument is not types.NoneType]
        return kinds[0] if len(set(kinds)) == 1 else "string"  # a string can be read as any of them
    if origin is typing.Literal:
        return kind_of(type(arguments[0]))
    simple: dict[Any, Kind] = {bool: "boolean", int: "integer", float: "number", dict: "mapping", Mapping: "mapping"}
    for kind in (tuple, list, set, frozenset):
        simple[kind] = "list"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "mapping"
    return simple.get(origin or annotation, "string")


def choices_of(annotation: Any) -> list[str]:
    """Return the values of a Literal; empty for other types."""
    return [str(value) for value in typing.get_args(annotation)] if typing.get_origin(annotation) is Literal else []


def bounds_of(info: FieldInfo) -> str:
    """Return the bounds of a field, such as "> 0, <= 1"; empty without bounds."""
    parts = []
    for names in (("ge", "gt"), ("le", "lt")):
        signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
        parts += [f"{signs[n]} {getattr(mark, n):g}" for mark in info.metadata for n in names if hasattr(mark, n)][:1]
    return ", ".join(parts)


def _limits(info: FieldInfo, *, whole: bool) -> tuple[float | None, float | None]:
    """Return least and largest value of a bounded field; open bounds count as closed unless it is an integer."""
    low = high = None
    for mark in info.metadata:
        low = getattr(mark, "ge", low)
        high = getattr(mark, "le", high)
        if hasattr(mark, "gt"):
            low = mark.gt + whole
        if hasattr(mark, "lt"):
            high = mark.lt - whole
    return low, high


# --- change ------------------------------------------------------------------------------------------------


def checked(config: Parameters, service: str, values: Mapping[str, Any]) -> list[Change]:
    """Return the changes for new values by path, validated together by the models; `apply` makes them.

    Raises:
        Refused: no value is changed: `unknown_parameter`, `needs_restart` or `bad_value`, with one line that names the
            path, the value, and bounds or choices.
    """
    known = leaves(config, service)
    for path, value in values.items():
        if path not in known:
            raise Refused("unknown_parameter", str(UnknownName(f"parameter of {service}", path, known)))
        if not known[path].runtime:
            raise Refused("needs_restart", f"{path}: needs a restart: zencell up CELL --set {path}={yaml_line(value)}")
    try:
        candidate = _candidate(config, service, values)
    except ConfigError as error:
        raise Refused("bad_value", _with_bounds(error, known)) from None
    changes = [Change(known[path], leaf.value) for path, leaf in candidate.items() if path in values]
    for change in changes:
        # Models also accept text as a number, for cell files, and true as 1: here both are errors.
        number = kind_of(change.leaf.info.annotation) in ("number", "integer")
        if number and isinstance(given := values[change.leaf.path], bool | str):
            raise Refused("bad_value", _with_bounds(ConfigError(change.leaf.path, given, "must be a number"), known))
        if not _is_finite(change.value):
            raise Refused("bad_value", str(ConfigError(change.leaf.path, change.value, "must be finite")))
    return [change for change in changes if change.value != change.leaf.value]


def _candidate(config: Parameters, service: str, values: Mapping[str, Any]) -> dict[str, Leaf]:
    """Return the parameters with new values.

    Raises:
        ConfigError: they are invalid.
    """
    given = _updated(config, f"services.{service}", values)
    sections = tunable_sections(type(config))
    for name, info in type(config).model_fields.items():
        for path, kind in sections.items():
            if info.annotation is kind:
                given[name] = check(kind, _updated(getattr(config, name), path, values), path)
    return leaves(check(type(config), given, f"services.{service}"), service)


def _updated(model: BaseModel, prefix: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a model with new values by path."""
    given = {}
    for name in type(model).model_fields:
        path, value = f"{prefix}.{name}", getattr(model, name)
        if isinstance(value, BaseModel) and any(other.startswith(f"{path}.") for other in values):
            given[name] = _updated(value, path, values)
        else:
            given[name] = values.get(path, value)
    return given


def _with_bounds(error: ConfigError, known: Mapping[str, Leaf]) -> str:
    leaf = known.get(error.field)
    bounds = bounds_of(leaf.info) if leaf else ""
    return f"{error} ({kind_of(leaf.info.annotation)}, {bounds})" if leaf and bounds else str(error)


def _is_finite(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return all(_is_finite(item) for item in value)
    return not isinstance(value, float) or math.isfinite(value)


def apply(changes: list[Change]) -> None:
    """Set the new values in place; readers on any thread see all changes of a model at once."""
    for owner in {id(change.leaf.owner): change.leaf.owner for change in changes}.values():
        mine = {change.leaf.name: change.value for change in changes if change.leaf.owner is owner}
        vars(owner).update(mine)  # sections are frozen otherwise
        owner.model_fields_set.update(mine)
