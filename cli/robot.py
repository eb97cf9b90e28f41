"""Robot files: which of their links need no collision check. Robots that are up: what their controllers say and do."""

from __future__ import annotations

import asyncio
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli import completion, options
from common.errors import ConfigError, ZencellError
from common.terminal import echo

if TYPE_CHECKING:
    from common.transport.bus import Bus

app = typer.Typer(help="Prepare a robot, and ask its controller.", no_args_is_help=True)

TIMEOUT = 60.0  # [s]: power and brakes take some
FIRST_WORD = 3.0  # [s] in which a state that there is has arrived


class NothingSaid(ZencellError):
    """No executor told of its arm."""

    exit_code = 1

    def __init__(self) -> None:
        super().__init__("nobody says how the arm is: the executor of this cell is not up, or is of before")


@app.callback()
def robot() -> None:
    """Prepare a robot, and ask its controller."""


@app.command()
def collisions(
    name: Annotated[
        str, typer.Argument(metavar="ROBOT", help="a name of config/robots, or the path of a YAML file",
                            autocompletion=completion.robots)
    ],
    samples: Annotated[str, typer.Option("--samples", metavar="N", help="random configurations")] = "10000",
    margin: Annotated[str, typer.Option("--margin", metavar="M", help="pairs that come this close are checked [m]")]
    = "0.005",
    seed: Annotated[str, typer.Option("--seed", metavar="N", help="of the configurations")] = "0",
    output: Annotated[str, typer.Option("-o", "--output", metavar="FILE", help="write there, not here")] = "",
) -> None:
    """Compute an SRDF: groups, named poses, and the pairs of links that need no collision check."""
    import numpy as np

    from common.config import RobotConfig, check, find_file, read_robot
    from common.planning.disabled_collisions import disabled_pairs, srdf
    from common.robot.model import RobotModel

    count, number = options.whole("--samples", samples, 1), options.whole("--seed", seed, 0)
    distance = options.number("--margin", margin)
    if distance < 0:
        raise ConfigError("--margin", margin, "must be 0 or more")
    config = check(RobotConfig, read_robot(find_file("robots", name)), "robot")
    # The SRDF that the robot file names may be the one that is still to be made.
    model = RobotModel.load(config.model_copy(update={"srdf": ""}))
    pairs = disabled_pairs(model, samples=count or 1, margin=distance, rng=np.random.default_rng(number))
    text = srdf(model, pairs)
    if not output:
        echo(text, nl=False)
        return
    try:
        Path(output).expanduser().write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError("--output", output, f"cannot be written: {error.strerror}") from None
    found = Counter(pair.reason for pair in pairs)
    echo(f"{output}: {len(pairs)} pairs need no check "
               f"({', '.join(f'{found[reason]} {reason.lower()}' for reason in sorted(found))})")


@app.command()
def status(
    cell: options.CellName = None, domain: options.Domain = None, connect: options.Connect = None
) -> None:
    """Print what the arm's own controller says: mode, why it cannot be moved, speed slider."""
    from cli.inspection import inspect
    from common import topics
    from common.messages import RobotStatus

    async def visit(bus: Bus) -> RobotStatus:
        async with asyncio.timeout(FIRST_WORD):
            return await bus.reader(topics.ROBOT_STATUS).next()

    try:
        told = inspect(visit, cell=cell, domain=domain, connect=connect)
    except TimeoutError:
        raise NothingSaid() from None
    echo(f"{told.mode}{f': {told.message}' if told.message else ''}")
    echo(f"speed slider {told.speed:.0%}, latest cycle {told.late * 1e3:.1f} ms late, "
         f"inputs {told.inputs:#b}, outputs {told.outputs:#b}")


def _order(act: str, value: float, cell: str | None, domain: str | None, connect: str | None) -> None:
    from cli.inspection import inspect
    from common import topics
    from common.messages import RobotCommand, RobotStatus

    asked = RobotCommand.model_validate({"act": act, "value": value, "owner": options.person()})

    async def visit(bus: Bus) -> RobotStatus:
        return await bus.client(topics.ROBOT_COMMAND).call(asked, TIMEOUT)

    told = inspect(visit, cell=cell, domain=domain, connect=connect)
    echo(f"{told.mode}{f': {told.message}' if told.message else ''}")


@app.command()
def enable(
    cell: options.CellName = None, domain: options.Domain = None, connect: options.Connect = None
) -> None:
    """Power the joints and release the brakes."""
    _order("enable", 0.0, cell, domain, connect)


@app.command()
def recover(
    cell: options.CellName = None, domain: options.Domain = None, connect: options.Connect = None
) -> None:
    """Let the arm be moved again after it has stopped to protect somebody or itself."""
    _order("recover", 0.0, cell, domain, connect)


@app.command()
def freedrive(
    state: Annotated[str, typer.Argument(metavar="on|off", help="whether it is moved by hand")],
    cell: options.CellName = None, domain: options.Domain = None, connect: options.Connect = None,
) -> None:
    """Have the arm be moved by hand, or end that."""
    if state not in ("on", "off"):
        raise ConfigError("freedrive", state, "must be on or off")
    _order("freedrive", float(state == "on"), cell, domain, connect)


@app.command()
def payload(
    mass: Annotated[str, typer.Argument(metavar="KG", help="mass of what the tool carries, with its fingers")],
    cell: options.CellName = None, domain: options.Domain = None, connect: options.Connect = None,
) -> None:
    """Tell the arm's controller what the tool carries."""
    _order("payload", options.number("KG", mass), cell, domain, connect)
