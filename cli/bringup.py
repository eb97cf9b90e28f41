"""Bring a cell up: `run` to the end of its task, `up` until Ctrl-C."""

from __future__ import annotations

import inspect
from typing import Annotated, Any

import typer

from cli import options, verbs
from cli.session.session import CellSession
from common.supervision.multi_host import HostOptions

Speed = Annotated[str, typer.Option("--speed", metavar="X", help="cell time per wall time, 0.1 to 10")]
NoViewer = Annotated[bool, typer.Option("--no-viewer", help="without the operator's page")]
ViewerPort = Annotated[
    str | None, typer.Option("--viewer-port", metavar="N", help="of the operator's page [8080, or the next free]")
]
ViewerHost = Annotated[
    str | None, typer.Option("--viewer-host", metavar="HOST", help="that it listens at; a token beyond [127.0.0.1]")
]
SummaryFile = Annotated[str | None, typer.Option("--summary", metavar="FILE.json", help="write the figures there")]
LogJson = Annotated[bool, typer.Option("--log-json", help="log lines as JSON objects")]
Record = Annotated[str | None, typer.Option("--record", metavar="FILE.mcap", help="record all of it there")]
ChaosSeed = Annotated[
    str | None, typer.Option("--chaos", metavar="SEED", help="faults on purpose: the same seed plans the same ones")
]
ChaosRate = Annotated[
    str | None, typer.Option("--chaos-rate", metavar="N", help="faults per minute of wall time, on average [30]")
]
UntilStdinEnds = Annotated[
    bool, typer.Option("--until-stdin-ends", help="end when standard input does: with the program that started this")
]


def _operation(
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
    viewer_host: ViewerHost = None,
    viewer_port: ViewerPort = None,
    summary: SummaryFile = None,
    log_json: LogJson = False,
    record: Record = None,
    chaos: ChaosSeed = None,
    chaos_rate: ChaosRate = None,
    until_stdin_ends: UntilStdinEnds = False,
    *,
    until_ended: bool,
) -> CellSession:
    """What is asked for with the options of `run` and `up`, which are these."""
    from common.supervision.lifecycle import interrupt_at_stdin_end
    from security.requiring import choose

    choose(secure)
    operation = CellSession(
        cell, overrides, world=world, seed=options.whole("--seed", seed, 0), speed=options.number("--speed", speed),
        domain=domain, connect=connect, no_viewer=no_viewer, summary=summary, log_json=log_json,
        share=HostOptions(listen, link, only, without),
    )
    if until_stdin_ends:
        interrupt_at_stdin_end()
    operation.serve_page(viewer_host, viewer_port)
    operation.record_to(record)
    disturbance = options.whole("--chaos", chaos, 0)
    per_minute = _per_minute(chaos, chaos_rate)
    if disturbance is not None:
        operation.disturb(disturbance, per_minute, until_ended=until_ended)
    return operation


def _per_minute(seed: str | None, rate: str | None) -> float:
    """How often faults are made on purpose.

    Raises:
        ConfigError: the rate cannot be used.
    """
    from common.errors import ConfigError
    from lab.chaos.plan import MOST_PER_MINUTE, PER_MINUTE

    per_minute = PER_MINUTE if rate is None else options.number("--chaos-rate", rate)
    if not 0 < per_minute <= MOST_PER_MINUTE:
        raise ConfigError("--chaos-rate", rate, f"must be more than 0 and at most {MOST_PER_MINUTE:g} [1/min]")
    if rate is not None and seed is None:
        raise ConfigError("--chaos-rate", rate, "needs --chaos SEED")
    return per_minute


def run(**given: Any) -> None:
    """Bring a cell up, run its task to the end, print a summary and shut down; exit 0 only if the task is DONE.

    Exit 3 if it is DONE, but the simulated world knows of something that was left and that the summary does not name.
    """
    of_applications = {name: given.pop(name) for name in given.keys() - _OPTIONS}
    before = verbs.before_run(given["cell"], given["overrides"], given["world"], of_applications)
    operation = _operation(**{**given, "overrides": before.overrides}, until_ended=True)
    operation.first = before.first
    raise typer.Exit(operation.run_to_end())


def up(**given: Any) -> None:
    """Bring a cell up and stay until Ctrl-C; the task starts by itself unless the cell says `autostart: false`."""
    raise typer.Exit(_operation(**given, until_ended=False).stay())


_ASKED = inspect.signature(_operation, eval_str=True)
_OPTIONS = _ASKED.parameters.keys() - {"until_ended"}
for verb in (run, up):
    verb.__signature__ = _ASKED.replace(  # type: ignore[attr-defined]
        parameters=[p for p in _ASKED.parameters.values() if p.name in _OPTIONS], return_annotation=None)
