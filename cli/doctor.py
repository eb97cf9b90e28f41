"""Looks at the machine: what a cell needs, what is in its way, and what to do about it."""

from __future__ import annotations

import json
from dataclasses import asdict

import typer

from cli import options
from common.terminal import echo


def doctor(
    domain: options.Domain = None, connect: options.Connect = None, as_json: options.Json = False
) -> None:
    """Check this machine and say what to do about what is not well; exit 1 if something fails."""
    from common.transport.endpoint import endpoint_of
    from tools.doctor.examination import examine

    endpoint = endpoint_of(domain, connect)
    failed = False
    for finding in examine(endpoint):
        if as_json:
            echo(json.dumps(asdict(finding)))
        else:
            echo(f"{finding.level:<4}  {finding.what}{f': {finding.remedy}' if finding.remedy else ''}")
        failed |= finding.level == "fail"
    if failed:
        raise typer.Exit(1)
