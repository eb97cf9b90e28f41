"""Looks at the machine: what a cell needs, what is in its way, and what to do about it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict

import typer

from cli import options
from cli.doctor.finding import Finding
from common.terminal import echo


def doctor(
    domain: options.Domain = None, connect: options.Connect = None, as_json: options.Json = False
) -> None:
    """Check this machine and say what to do about what is not well; exit 1 if something fails."""
    from common.transport.endpoint import endpoint_of

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


def examine(endpoint: str) -> Iterator[Finding]:
    """All findings, in the order in which they matter."""
    from cli.doctor import certificates, clocks, configuration, leftovers, machine, network, software

    yield software.python()
    yield from software.packages()
    yield software.kernel()
    yield from configuration.robots()
    yield from configuration.cells()
    yield network.router(endpoint)
    yield from network.versions(endpoint)
    yield from clocks.clocks(endpoint)
    yield from certificates.certificates()
    yield network.page()
    yield from leftovers.processes()
    yield machine.shared_memory()
    yield machine.memory()
    yield machine.cores()
    yield machine.disk()
    yield machine.open_files()
    yield machine.clock()
    yield machine.container_engine()
