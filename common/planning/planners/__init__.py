"""Planners, one module each with `Options` and `plan(problem, options, cancel) -> Result`, found by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from common.config import Parameters, check
from common.errors import ConfigError
from common.planning.problem import Cancel, Problem, Result
from common.plugins import find_plugin, plugin_names

Plan = Callable[[Problem, Any, Cancel], Result]


def planner_names() -> list[str]:
    """Return the planners of the project."""
    return plugin_names("zencell.planners")


def load_planner(name: str, options: Mapping[str, Any]) -> tuple[Plan, Parameters]:
    """Return the `plan` function and the checked options of a planner.

    Args:
        name: a module of this package, or a dotted module of the user.
        options: values for its `Options`.

    Raises:
        UnknownName: with the choices.
        ConfigError: the module is no planner, or an option is invalid.
    """
    module = find_plugin("zencell.planners", name, field="pipeline.planners", noun="planner")
    plan, model = getattr(module, "plan", None), getattr(module, "Options", None)
    if not callable(plan) or not (isinstance(model, type) and issubclass(model, Parameters)):
        raise ConfigError("pipeline.planners", name, "must have plan() and Options(Parameters)")
    return plan, check(model, options, f"pipeline.planners.{name}")
