"""A policy that is a Python function: `def policy(observation)` or `async def policy(observation)`."""

from __future__ import annotations

import copy
import importlib.util
import inspect
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from applications.policy.interface import Chunk, Observation, PolicyFailed
from applications.policy.sources.actions import chunk_of, numbers, one_line
from applications.policy.sources.computing import Computation
from applications.policy.sources.settings import PolicyCell, SourceConfig
from common.errors import ConfigError
from common.plugins import import_from_working_directory, where_searched

FIELD = "source.callable"


class FunctionPolicy:
    """Calls a function with each observation; an ordinary function runs in a thread.

    It returns a `Chunk`, an array of actions, or an array and widths (n,) [m] of the gripper. The observation is a copy
    of its own, which it may change.
    """

    def __init__(self, config: SourceConfig, cell: PolicyCell) -> None:
        """Import the function.

        Raises:
            ConfigError: there is no such module or function.
        """
        self._function = load_function(config.callable)
        self._name, self._form, self._cell = config.callable, config.actions, cell
        self._computation = Computation(f"policy {config.callable}", config.timeout)

    async def infer(self, observation: Observation) -> Chunk:
        """Return the next actions; see `PolicySource`."""
        own = copy.deepcopy(observation)
        try:
            result = await self._computation.call(self._function, own)
        except PolicyFailed:
            raise
        except Exception as error:
            raise PolicyFailed(f"policy {self._name} failed{_place(error)}: {one_line(error)}") from error
        return self._chunk(result, observation)

    def _chunk(self, result: object, observation: Observation) -> Chunk:
        if isinstance(result, Chunk):
            return result
        if isinstance(result, tuple) and len(result) == 2:
            actions, widths = result
            chunk = chunk_of(actions, observation, self._form, self._cell)
            return replace(chunk, gripper=None if widths is None else numbers(widths, "(n,) of widths"))
        return chunk_of(result, observation, self._form, self._cell)

    async def close(self) -> None:
        """Do nothing: a function that still computes is abandoned."""


def load_function(name: str) -> Callable[..., Any]:
    """Return the function `dotted.module:name`.

    Raises:
        ConfigError: the module or the name does not exist, or it is no function.
    """
    module, attribute = _parts(name)
    try:
        found = importlib.import_module(module)
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}.")
        raise ConfigError(FIELD, name, where_searched(module) if missing else f"cannot be imported: {error}") from None
    function = getattr(found, attribute, None)
    if not callable(function):
        names = [each for each, value in vars(found).items() if not each.startswith("_") and inspect.isfunction(value)
                 and value.__module__ == module]
        raise ConfigError(FIELD, name, f"{module} has no function {attribute}; choices: {', '.join(names) or 'none'}")
    return function  # type: ignore[no-any-return]


def require_module(name: str) -> None:
    """Return if the module of `dotted.module:name` can be found; packages around it are imported.

    Raises:
        ConfigError: it cannot, or the name is none.
    """
    module, _ = _parts(name)
    try:
        found = importlib.util.find_spec(module) is not None
    except ImportError:
        found = False
    except Exception:  # a package of the user; the service reports it, with file and line
        return
    if not found:
        raise ConfigError(FIELD, name, where_searched(module))


def _parts(name: str) -> tuple[str, str]:
    """Return module and name of a function; the module is searched in the working directory, too."""
    module, _, attribute = name.partition(":")
    if not all(part.isidentifier() for part in [*module.split("."), attribute]):
        raise ConfigError(FIELD, name, "must be dotted.module:name")
    import_from_working_directory(module)
    return module, attribute


def _place(error: BaseException) -> str:
    """Return the file and line that raised an error."""
    frames = traceback.extract_tb(error.__traceback__)
    return f" at {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
