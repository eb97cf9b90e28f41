"""Says what will not work in a cell, before anything moves."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import TYPE_CHECKING

import typer

from cli import options
from common.terminal import echo

if TYPE_CHECKING:
    from common.checking.finding import Finding
    from common.config import Cell

SHOWS = "viewer"  # a page shows whatever there is


def check(
    cell: options.CellArgument, overrides: options.Overrides = None, world: options.WorldName = None,
    seed: options.Seed = None, as_json: options.Json = False,
) -> None:
    """Say what will not work in a cell: places out of reach, cameras that see nothing, keys of nobody; exit 1 if so.

    Nothing is started and nothing moves. Exit 0 without errors, also with warnings.
    """
    from common.config import load_cell

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


def examine(cell: Cell) -> Iterator[Finding]:
    """All findings of a cell, each once; the quick ones first."""
    from common.checking.cell import quick, thorough

    told: set[str] = set()
    for found in (*quick(cell), *thorough(cell), *wiring(cell)):
        if not any(found.what.startswith(what) for what in told):  # a service says what was found here, too
            told.add(found.what)
            yield found


def wiring(cell: Cell) -> Iterator[Finding]:
    """What services refuse, and keys that do not fit together."""
    from common.checking.finding import error, refusal
    from common.checking.wiring import Keys, check_wiring
    from common.errors import ConfigError, ZencellError
    from common.graph.wired import Unwired, wired

    found, complete = [], True
    for entry in cell.services.values():
        try:
            each = wired(cell, entry)
        except ConfigError as told:
            yield refusal(told)
        except Unwired as told:
            yield error(str(told), "correct the service, or its parameters", refused=True)
        except ZencellError as told:
            yield error(f"services.{entry.name}: {told}", "correct it", refused=True)
        else:
            found.append(Keys(each.name, each.reads, each.writes, each.serves, each.calls, entry.kind == SHOWS))
            continue
        complete = False
    for finding in check_wiring(found):
        if complete or finding.severity == "error":  # what a service that is refused would write is not known
            yield finding
