"""Says what will not work in a cell, before anything moves."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import typer

from cli import options
from common.terminal import echo

if TYPE_CHECKING:
    pass


def check(
    cell: options.CellArgument, overrides: options.Overrides = None, world: options.WorldName = None,
    seed: options.Seed = None, as_json: options.Json = False,
) -> None:
    """Say what will not work in a cell: places out of reach, cameras that see nothing, keys of nobody; exit 1 if so.

    Nothing is started and nothing moves. Exit 0 without errors, also with warnings.
    """
    from common.config import load_cell
    from tools.check.services import examine

    loaded = load_cell(cell, tuple(overrides or ()), world=world, seed=options.whole("--seed", seed, 0))
    errors = warnings = 0
    for found in examine(loaded):
        errors, warnings = errors + (found.severity == "error"), warnings + (found.severity == "warning")
        if as_json:
            echo(json.dumps({"severity": found.severity, "what": found.what, "remedy": found.remedy,
                             "refused": found.refused}))
        else:
            echo(f"{found.severity:<7}  {found.line}")
    if not as_json:
        echo(f"{loaded.name}: {_counted(errors, 'error')}, {_counted(warnings, 'warning')}")
    if errors:
        raise typer.Exit(1)


def _counted(count: int, what: str) -> str:
    return f"{count or 'no'} {what}{'' if count == 1 else 's'}"
