"""Values against models: the first that does not fit, in one line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError

from common.config.basics import Section
from common.errors import ConfigError

C = TypeVar("C", bound=BaseModel)


def check(model: type[C], values: Mapping[str, Any], prefix: str = "") -> C:
    """The model made of the values.

    Raises:
        ConfigError: names the first field that does not fit, its value and what would.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise _first_error(error, model, prefix) from None


def _first_error(error: ValidationError, model: type[BaseModel], prefix: str) -> ConfigError:
    first = error.errors(include_url=False, include_context=False)[0]
    field = ".".join(part for part in [prefix, *(str(p) for p in first["loc"])] if part)
    message = first["msg"].removeprefix("Value error, ").replace("Input should be", "must be").replace("Input ", "")
    if first["type"] == "extra_forbidden":
        names = _fields_at(model, first["loc"][:-1])
        return ConfigError(field, first["input"], f"is not a parameter; choices: {', '.join(names)}")
    if first["type"] == "missing":
        return ConfigError(field, ..., "is missing")
    if first["type"] == "value_error":
        return ConfigError(field or "cell", ..., message)
    return ConfigError(field, first["input"], message)


def _fields_at(model: type[BaseModel], location: Sequence[int | str]) -> list[str]:
    """Names of the fields of the model that lies at a location within `model`."""
    current, table = model, None
    for part in location:
        # In a mapping of models the name comes between the field and its fields.
        field = current.model_fields.get(str(part))
        annotation = table or (field.annotation if field else None)
        table = get_args(annotation)[-1] if get_origin(annotation) is dict else None
        if table is not None:
            continue
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            break
        current = annotation
    # The sections of the cell that a service reads are no parameters of its own.
    own = current.model_fields.items() if issubclass(current, Section) else (
        (name, field) for name, field in current.model_fields.items() if not is_section(field.annotation)
    )
    return sorted(name for name, _ in own)


def is_section(annotation: object) -> bool:
    """Whether the type of a field is a section of the cell."""
    return isinstance(annotation, type) and issubclass(annotation, Section)
