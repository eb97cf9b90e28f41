"""`check` and `doctor`: what will not work in a cell, and what is wrong with this machine."""

from __future__ import annotations

import json
from dataclasses import asdict

import typer

from cli import options
from common.terminal import echo


def check(
    cell: options.CellArgument, overrides: options.Overrides = None, world: options.WorldName = None,
    seed: options.Seed = None, as_json: options.Json = False,
) -> None:
    """Report what will not work in a cell: unreachable positions, blind cameras, keys without writer; exit 1 if any.

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


def doctor(
    domain: options.Domain = None, connect: options.Connect = None, as_json: options.Json = False
) -> None:
    """Check this machine and say how to fix each problem; exit 1 if a check fails."""
    from common.transport.endpoint import endpoint_of
    from tools.doctor.examination import examine

    failed = False
    for finding in examine(endpoint_of(domain, connect)):
        if as_json:
            echo(json.dumps(asdict(finding)))
        else:
            echo(f"{finding.level:<4}  {finding.what}{f': {finding.remedy}' if finding.remedy else ''}")
        failed |= finding.level == "fail"
    if failed:
        raise typer.Exit(1)
