"""Call functions of the user from a program: `module:function`, asynchronous ones included."""

from __future__ import annotations

import asyncio
import importlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from common.errors import ConfigError
from common.plugins import extend_path, where_searched

if TYPE_CHECKING:
    from applications.programming.steps import Python


def find_function(reference: str, folder: Path) -> Callable[..., Any]:
    """Return a function; modules are also searched in the folder of the program, the one above, and the working folder.

    Raises:
        ConfigError: there is none.
    """
    extend_path(str(folder), str(folder.parent), str(Path.cwd()))
    module, _, name = reference.partition(":")
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ModuleNotFoundError as error:
        known = error.name is not None and f"{module}.".startswith(f"{error.name}.")
        raise ConfigError("function", reference, where_searched(module) if known and "." in module else (
            f"cannot be imported: {error}")) from None
    except (Exception, SystemExit) as error:
        raise ConfigError("function", reference, f"cannot be imported: {type(error).__name__}: {error}") from None
    if not callable(found):
        choices = [key for key, value in vars(importlib.import_module(module)).items() if inspect.isfunction(value)]
        raise ConfigError("function", reference, f"does not exist; choices: {', '.join(choices) or 'none'}")
    return found  # type: ignore[no-any-return]


async def call_function(step: Python, folder: Path) -> tuple[str, str]:
    """Return the outcome of a function, or the problem: it raised an error, or took too long.

    A function that is not asynchronous runs in a thread, which cannot be ended: after its time limit it continues
    there, and its result is ignored.
    """
    try:
        function = find_function(step.function, folder)
        async with asyncio.timeout(step.timeout):
            result = function(**step.arguments) if inspect.iscoroutinefunction(function) else await asyncio.to_thread(
                function, **step.arguments)
            if inspect.isawaitable(result):
                result = await result
    except TimeoutError:
        return "", f"{step.function} took longer than {step.timeout:g} s"
    except ConfigError as error:
        return "", str(error)
    except (Exception, SystemExit) as error:
        return "", f"{step.function} raised {type(error).__name__}: {error}"
    if isinstance(result, bool):
        return "succeeded" if result else "failed", ""
    return "" if result is None else str(result)[:80], ""
