"""Values of a cell that are given beside its file: `PATH=VALUE`, and `@FILE` for a YAML file in the shape of a cell."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic_core import to_jsonable_python

from common.config.files import parse_yaml, read_yaml
from common.errors import ConfigError


def parse_override(text: str, given_as: str = "--set") -> tuple[list[str], Any]:
    """The dotted path and the value (as YAML) of `PATH=VALUE`, which an error names by how it was given."""
    path, found, value = text.partition("=")
    if not found or not path.strip():
        raise ConfigError(given_as, text, "must be PATH=VALUE, for example world.count=5, or @FILE.yaml")
    try:
        return path.strip().split("."), parse_yaml(value)
    except (yaml.YAMLError, ValueError):  # a date that there is not
        raise ConfigError(f"{given_as} {path}", value, "is not a YAML value") from None


def expanded(overrides: Sequence[str]) -> list[str]:
    """The overrides, with `PATH=VALUE` for every value of a file in the place of `@FILE`.

    Raises:
        ConfigError: a file cannot be read, or holds no mapping.
    """
    found = []
    for text in overrides:
        if text.startswith("@"):
            tree = read_yaml(Path(text[1:]).expanduser())
            found += [f"{'.'.join(path)}={yaml_line(value)}" for path, value in _values(tree)]
        else:
            found.append(text)
    return found


def _values(tree: Mapping[Any, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every value of a tree with its path; what is empty says nothing."""
    for key, value in tree.items():
        name = str(key).rpartition(".")[2] if above == ("services",) else str(key)  # a module goes by its last part
        if isinstance(value, Mapping):
            yield from _values(value, (*above, name))
        elif value is not None:
            yield (*above, name), value


def yaml_line(value: Any) -> str:
    """A value as YAML writes it on one line: what `PATH=VALUE` takes."""
    plain = to_jsonable_python(value)
    text = _flow(plain)
    # A text with line breaks, of which Unicode has several, is spread over lines unless it is quoted and escaped.
    return text if len(text.splitlines()) <= 1 else _flow(plain, quoted=True)


def _flow(value: Any, *, quoted: bool = False) -> str:
    text: str = yaml.safe_dump(
        value, default_flow_style=True, default_style='"' if quoted else None, allow_unicode=not quoted, width=math.inf,
        sort_keys=False,
    )
    return text.removesuffix("\n").removesuffix("\n...")
