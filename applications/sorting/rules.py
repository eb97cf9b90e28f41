"""The rule that names the container of an object: by its color, size or shape, or by a function of the user."""

from __future__ import annotations

import importlib
import inspect
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from applications.sorting.topics import SeenObject
from common.errors import ConfigError
from common.plugins import extend_path

OTHERS = "*"  # key of all values that `where` does not list
COLORS = ("red", "orange", "yellow", "green", "blue", "purple", "white", "grey", "black")
SIZES = ("small", "large")
SHAPES = ("round", "long", "flat", "ring", "box", "other")
VALUES = {"color": COLORS, "size": SIZES, "shape": SHAPES}
FIRST = {"color": ("red", "orange", "yellow", "white"), "size": ("small",), "shape": ("round", "ring", "box")}
MOST_SHOWN = 120  # characters of an error of the user's function
LONGEST_CALL = 0.5  # [s] wall time of the user's function: the task cannot react meanwhile

Property = Callable[[SeenObject], str]


class NoDestination(Exception):
    """Why the rule names no container for an object."""


class Rule:
    """Maps an object to the id of a container.

    Attributes:
        where: container by value; empty for a function.
    """

    def __init__(
        self, by: str, where: Mapping[str, str], containers: Sequence[str], large: float = 0.06, field: str = "",
    ) -> None:
        """Check the rule.

        Args:
            by: color, size, shape, or "module:function" of the user.
            where: container by value; what it leaves out gets a default, or the container of `*`.
            containers: ids of all destinations; the first one gets the first half of the values by default.
            large: length from which an object is large [m].
            field: prefix of parameters in errors.

        Raises:
            ConfigError: an unknown property, value or container, or no such function; one line with the choices.
        """
        if not containers:
            raise ConfigError("world.containers", ..., "has no container besides the tray: nowhere to put objects")
        self._containers, self._large, self._by = tuple(containers), large, by
        self._function: Callable[[SeenObject], Any] | None = None
        self._call: threading.Thread | None = None  # of the user's function that did not return in time
        if ":" in by:
            self._function = _imported(by, f"{field}by")
            if where:
                raise ConfigError(f"{field}where", dict(where), f"has no effect: {by} names the container itself")
            self.where: dict[str, str] = {}
            return
        if by not in VALUES:
            raise ConfigError(f"{field}by", by, f"is no rule; choices: {', '.join(VALUES)}, or module:function")
        for value, container in where.items():
            if value not in VALUES[by] and value != OTHERS:
                raise ConfigError(f"{field}where", value, f"is no {by}; choices: {', '.join(VALUES[by])}, or '*'")
            if container not in self._containers:
                raise ConfigError(f"{field}where.{value}", container,
                                  f"is no destination; choices: {', '.join(self._containers)}")
        first, last = self._containers[0], self._containers[-1]
        default = {value: first if value in FIRST[by] else last for value in VALUES[by]}
        if OTHERS in where:
            default = dict.fromkeys(VALUES[by], where[OTHERS])
        self.where = {**default, OTHERS: where.get(OTHERS, last), **where}

    def value(self, thing: SeenObject) -> str:
        """Return the property that decides, such as "red"; empty for a function of the user."""
        if self._by == "size":
            return SIZES[max(thing.size.x, thing.size.y, thing.size.z) >= self._large]
        return {"color": thing.color_name, "shape": thing.shape}.get(self._by, "")

    def destination(self, thing: SeenObject) -> str:
        """Return the id of the container of an object.

        Raises:
            NoDestination: the user's function fails or names no container; the text is one line.
        """
        if self._function is None:
            return self.where.get(self.value(thing), self.where[OTHERS])
        found = self._called(self._function, thing)
        if not isinstance(found, str) or found not in self._containers:
            shown = " ".join(repr(found).split())[:60]
            raise NoDestination(f"{self._by} returns {shown}, which is no destination; choices: "
                                f"{', '.join(self._containers)}")
        return found

    def _called(self, function: Callable[[SeenObject], Any], thing: SeenObject) -> Any:
        """Return what the user's function returns.

        Raises:
            NoDestination: it fails, or takes too long; until a late call ends, there is no other one.
        """
        results: list[Any] = []
        errors: list[BaseException] = []

        def call() -> None:
            try:
                results.append(function(thing.model_copy(deep=True)))
            except BaseException as error:  # code of the user, which may also call sys.exit
                errors.append(error)

        if self._call is None or not self._call.is_alive():
            self._call = threading.Thread(target=call, name="rule", daemon=True)
            self._call.start()
            self._call.join(LONGEST_CALL)
        if errors:
            message = " ".join(f"{type(errors[0]).__name__}: {errors[0]}".split())[:MOST_SHOWN]
            raise NoDestination(f"{self._by} fails: {message}")
        if not results:
            raise NoDestination(f"{self._by} takes longer than {LONGEST_CALL:g} s")
        return results[0]


def _imported(reference: str, field: str) -> Callable[[SeenObject], Any]:
    """Return a function "module:function" of the user, also from the working directory.

    Raises:
        ConfigError: there is none.
    """
    module, _, name = reference.partition(":")
    if not module or not name.isidentifier():
        raise ConfigError(field, reference, "must be color, size, shape, or module:function")
    extend_path(str(Path.cwd()))
    try:
        found = getattr(importlib.import_module(module), name, None)
    except (Exception, SystemExit) as error:  # code of the user
        text = " ".join(f"{type(error).__name__}: {error}".split())[:MOST_SHOWN]
        raise ConfigError(field, reference, f"cannot be imported: {text}") from None
    if not callable(found):
        raise ConfigError(field, reference, f"is no function: {module} has no function {name}")
    if inspect.iscoroutinefunction(found):
        raise ConfigError(field, reference, "is a coroutine function; needs a plain function")
    try:
        inspect.signature(found).bind(None)
    except TypeError:
        raise ConfigError(field, reference, "must take one argument, the SeenObject") from None
    except ValueError:  # a function without a known signature
        pass
    return found  # type: ignore[no-any-return]
