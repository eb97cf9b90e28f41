"""`run` and `up`: bring a cell up until its task has ended, or until Ctrl-C."""

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
    str | None, typer.Option("--viewer-port", metavar="N", help="port of the operator's page [8080, or the next free]")
]
ViewerHost = Annotated[
    str | None, typer.Option("--viewer-host", metavar="HOST", help="address on which the page listens; other hosts "
                                                                   "need a token [127.0.0.1]")
]
SummaryFile = Annotated[str | None, typer.Option("--summary", metavar="FILE.json", help="write the figures of the run")]
LogJson = Annotated[bool, typer.Option("--log-json", help="write log lines as JSON objects")]
Record = Annotated[
    str | None, typer.Option("--record", metavar="FILE.mcap", help="record all published messages; requests are not "
                                                                   "recorded")
]
Foxglove = Annotated[
    str | None, typer.Option("--foxglove", metavar="[PORT]", help="serve Foxglove at this port [8765]; needs the extra")
]
Ros2 = Annotated[
    str | None, typer.Option("--ros2", metavar="[DOMAIN_ID]", help="publish to this domain of ROS 2 [0] with "
                                                                   "rmw_zenoh; needs the extra")
]
ChaosSeed = Annotated[
    str | None, typer.Option("--chaos", metavar="SEED", help="inject faults; the same seed plans the same faults")
]
ChaosRate = Annotated[
    str | None, typer.Option("--chaos-rate", metavar="N", help="average number of faults per minute of wall time [30]")
]
UntilStdinEnds = Annotated[
    bool, typer.Option("--until-stdin-ends", help="shut down at the end of standard input")
]


def _session(
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
    foxglove: Foxglove = None,
    ros2: Ros2 = None,
    chaos: ChaosSeed = None,
    chaos_rate: ChaosRate = None,
    until_stdin_ends: UntilStdinEnds = False,
    *,
    until_ended: bool,
) -> CellSession:
    """Return the session that the options of `run` and `up` describe; these are its parameters."""
    from bridges.foxglove.option import overrides_for
    from bridges.ros2.option import overrides_for as overrides_for_ros2
    from common.supervision.lifecycle import interrupt_at_stdin_end
    from security.preflight import choose

    choose(secure)
    overrides = [*overrides_for(cell, foxglove), *overrides_for_ros2(cell, ros2), *(overrides or ())]
    session = CellSession(
        cell, overrides, world=world, seed=options.whole("--seed", seed, 0), speed=options.number("--speed", speed),
        domain=domain, connect=connect, no_viewer=no_viewer, summary=summary, log_json=log_json,
        host=HostOptions(listen, link, only, without),
    )
    if until_stdin_ends:
        interrupt_at_stdin_end()
    session.serve_page(viewer_host, viewer_port)
    session.record_to(record)
    chaos_seed = options.whole("--chaos", chaos, 0)
    per_minute = _per_minute(chaos, chaos_rate)
    if chaos_seed is not None:
        session.inject_faults(chaos_seed, per_minute, until_ended=until_ended)
    return session


def _per_minute(seed: str | None, rate: str | None) -> float:
    """Return the rate of injected faults [1/min].

    Raises:
        ConfigError: the rate is not valid.
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

    Exit 3 if it is DONE but the simulated world has objects left that the summary does not explain.
    """
    of_applications = {name: given.pop(name) for name in given.keys() - _OPTIONS}
    from tools.check.cell import require_task  # slow to import

    before = verbs.before_run(given["cell"], given["overrides"], given["world"], of_applications)
    session = _session(**before.changed(given), until_ended=True)
    require_task(session.on_all_hosts)
    session.first = before.first
    raise typer.Exit(before.checked(session.run_to_end))


def up(**given: Any) -> None:
    """Bring a cell up and stay until Ctrl-C. Its task starts unless the cell file says `autostart: false`."""
    before = verbs.before_run(given["cell"], given["overrides"], given["world"], {})
    raise typer.Exit(before.ending(_session(**before.changed(given), until_ended=False).stay))


_SIGNATURE = inspect.signature(_session, eval_str=True)
_OPTIONS = _SIGNATURE.parameters.keys() - {"until_ended"}
for command in (run, up):
    command.__signature__ = _SIGNATURE.replace(  # type: ignore[attr-defined]
        parameters=[p for p in _SIGNATURE.parameters.values() if p.name in _OPTIONS], return_annotation=None)
