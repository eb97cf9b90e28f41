"""`zencell robot identify-payload`: measure what is beyond the flange of a running arm."""

from __future__ import annotations

from typing import Annotated

import typer

from common.errors import ConfigError
from common.terminal import echo
from common.verbs import Verbs


def identify_payload(
    poses: Annotated[str, typer.Option("--poses", metavar="N", help="orientations to measure in, 4 to 12")] = "6",
    speed: Annotated[str, typer.Option("--speed", metavar="S", help="share of the speed limits")] = "0.2",
    cell: str | None = None, domain: str | None = None, connect: str | None = None,
) -> None:
    """Tilt the tool where it is, measure mass and centre of mass beyond the flange at rest, and return."""
    from tools.joining import join
    from tools.payload import measurement

    if not poses.isdecimal():
        raise ConfigError("--poses", poses, "must be a whole number, 4 to 12")
    try:
        share = float(speed)
    except ValueError:
        raise ConfigError("--speed", speed, "must be a number") from None
    measurement.check_request(int(poses), share)
    found, flange = join(lambda joined: measurement.identify_payload(
        joined, poses=int(poses), speed=share, report=lambda line: echo(line, err=True)), cell, domain, connect)
    for line in measurement.report_lines(found, flange):
        echo(line)


VERBS = Verbs(commands={"robot identify-payload": identify_payload})
