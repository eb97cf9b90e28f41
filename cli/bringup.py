"""Bring a cell up: `run` to the end of its task, `up` until Ctrl-C."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cli import hosts, options, securing, verbs, viewing
from cli.operation import Operation

Speed = Annotated[str, typer.Option("--speed", metavar="X", help="cell time per wall time, 0.1 to 10")]
NoViewer = Annotated[bool, typer.Option("--no-viewer", help="without the operator's page")]
SummaryFile = Annotated[str | None, typer.Option("--summary", metavar="FILE.json", help="write the figures there")]
LogJson = Annotated[bool, typer.Option("--log-json", help="log lines as JSON objects")]
Record = Annotated[str | None, typer.Option("--record", metavar="FILE.mcap", help="record all of it there")]
ChaosSeed = Annotated[
    str | None, typer.Option("--chaos", metavar="SEED", help="faults on purpose: the same seed plans the same ones")
]
ChaosRate = Annotated[
    str | None, typer.Option("--chaos-rate", metavar="N", help="faults per minute of wall time, on average [30]")
]


def run(
    cell: options.CellArgument,
    overrides: options.Overrides = None,
    world: options.WorldName = None,
    seed: options.Seed = None,
    speed: Speed = "1",
    domain: options.Domain = None,
    connect: options.Connect = None,
    listen: options.Listen = None,
    link: options.Link = None,
    only: options.Only = None,
    without: options.Without = None,
    secure: options.Secure = None,
    no_viewer: NoViewer = False,
    viewer_host: viewing.Host = None,
    viewer_port: viewing.Port = None,
    summary: SummaryFile = None,
    log_json: LogJson = False,
    record: Record = None,
    chaos: ChaosSeed = None,
    chaos_rate: ChaosRate = None,
    **of_applications: Any,
) -> None:
    """Bring a cell up, run its task to the end, print a summary and shut down; exit 0 only if the task is DONE."""
    securing.choose(secure)
    before = verbs.before_run(cell, overrides, world, of_applications)
    operation = Operation(cell, before.overrides, world, seed, speed, domain, connect, no_viewer, summary, log_json,
                          hosts.Share(listen, link, only, without))
    operation.serve_page(viewer_host, viewer_port)
    operation.record_to(record)
    operation.disturb(chaos, chaos_rate, until_ended=True)
    operation.first = before.first
    raise typer.Exit(operation.run_to_end())


def up(
    cell: options.CellArgument,
    overrides: options.Overrides = None,
    world: options.WorldName = None,
    seed: options.Seed = None,
    speed: Speed = "1",
    domain: options.Domain = None,
    connect: options.Connect = None,
    listen: options.Listen = None,
    link: options.Link = None,
    only: options.Only = None,
    without: options.Without = None,
    secure: options.Secure = None,
    no_viewer: NoViewer = False,
    viewer_host: viewing.Host = None,
    viewer_port: viewing.Port = None,
    summary: SummaryFile = None,
    log_json: LogJson = False,
    record: Record = None,
    chaos: ChaosSeed = None,
    chaos_rate: ChaosRate = None,
) -> None:
    """Bring a cell up and stay until Ctrl-C; the task starts by itself unless the cell says `autostart: false`."""
    securing.choose(secure)
    operation = Operation(cell, overrides, world, seed, speed, domain, connect, no_viewer, summary, log_json,
                          hosts.Share(listen, link, only, without))
    operation.serve_page(viewer_host, viewer_port)
    operation.record_to(record)
    operation.disturb(chaos, chaos_rate, until_ended=False)
    raise typer.Exit(operation.stay())
