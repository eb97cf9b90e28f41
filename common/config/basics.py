"""Field types and base classes of the configuration, and validation errors in one line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, TypeVar, Union, get_args, get_origin

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from common.errors import ConfigError, expected_text
from common.remapping import is_key

Number = Annotated[float, Field(allow_inf_nan=False)]
Length = Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)]
Coordinate = Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Rgb = tuple[
    Annotated[float, Field(ge=0, le=1)], Annotated[float, Field(ge=0, le=1)], Annotated[float, Field(ge=0, le=1)]
]


def _key(text: str) -> str:
    if not is_key(text):
        raise ValueError(f"{text!r} is no key, such as camera/image_raw")
    return text


Key = Annotated[str, AfterValidator(_key)]  # of a topic, without the cell and without wildcards


@dataclass(frozen=True)
class AtRunTime:
    """Marks a field that may change while its service runs."""


T = TypeVar("T")
Tunable = Annotated[T, AtRunTime()]  # as in `min_area: Tunable[float] = Field(...)`: read it at each use


class Section(BaseModel):
    """A section of the cell, which any service may declare."""

    # defer_build: see common/messages/basics.py
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)


class Parameters(BaseModel):
    """Base of the `Config` of a service, and of the `Options` of a planner or hardware backend.

    `Tunable` fields, also those of sections, are changed in place between two turns of the service's event loop. No
    other field ever changes.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, defer_build=True)

    ALL_ARMS: ClassVar[bool] = False  # whether a service with a robot may serve all arms of a cell with several

    @model_validator(mode="before")
    @classmethod
    def _keep_what_a_default_sets(cls, values: Any) -> Any:
        """Let a group that has a default, and is given without all that it requires, name only what differs from it."""
        if not isinstance(values, Mapping):
            return values
        merged = dict(values)
        for name, field in cls.model_fields.items():
            default, given = field.default, values.get(name)
            if isinstance(default, BaseModel) and isinstance(given, Mapping) and any(
                    each.is_required() and part not in given for part, each in type(default).model_fields.items()):
                merged[name] = {**default.model_dump(exclude_unset=True), **given}
        return merged

    def require_usable(self) -> None:
        """Check what the values name on this host, such as files; called before any process starts, so it is quick.

        Raises:
            ConfigError: names the field without the service, the value and what is expected.
        """


C = TypeVar("C", bound=BaseModel)


def check(model: type[C], values: Mapping[str, Any], prefix: str = "") -> C:
    """Return the model with these values.

    Raises:
        ConfigError: names the first invalid field, its value and what is expected.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise _first_error(error, model, prefix) from None


def _first_error(error: ValidationError, model: type[BaseModel], prefix: str) -> ConfigError:
    first = error.errors(include_url=False)[0]
    field = ".".join(part for part in [prefix, *(str(p) for p in first["loc"])] if part)
    message = expected_text(first)
    if first["type"] == "extra_forbidden":
        names = _fields_at(model, first["loc"][:-1])
        choices = f"choices: {', '.join(names)}" if names else "there are none here"
        return ConfigError(field, first["input"], f"is not a parameter; {choices}")
    if first["type"] == "missing":
        return ConfigError(field, ..., "is missing")
    if first["type"] == "value_error":
        return ConfigError(field or "cell", ..., message)
    return ConfigError(field, first["input"], message)


def _fields_at(model: type[BaseModel], location: Sequence[int | str]) -> list[str]:
    """Return the field names of the nested model at a location within `model`."""
    current, item = model, None
    for part in location:
        # In a mapping or list of models the location has a key or an index between the field and its fields.
        field = current.model_fields.get(str(part))
        annotation = _required(item or (field.annotation if field else None))
        item = get_args(annotation)[-1] if get_origin(annotation) in (dict, list) else None
        if item is not None:
            continue
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            break
        current = annotation
    return own_fields(current)


def own_fields(model: type[BaseModel]) -> list[str]:
    """Return the fields of a model, sorted; sections of the cell are no parameters of a service."""
    return sorted(name for name, field in model.model_fields.items()
                  if issubclass(model, Section) or not is_section(field.annotation))


def _required(annotation: Any) -> Any:
    """Return X of `X | None`; any other type as it is."""
    options = [each for each in get_args(annotation) if each is not NoneType]
    return options[0] if get_origin(annotation) in (Union, UnionType) and len(options) == 1 else annotation


def is_section(annotation: object) -> bool:
    """Return whether the type of a field is a section of the cell."""
    return isinstance(annotation, type) and issubclass(annotation, Section)
