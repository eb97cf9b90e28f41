"""Disabled collision pairs of robot files; commands to the controllers of running robots."""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Any, Literal

import typer

from cli import choices, options, robot_new
from cli.target import RUNNING, CellTarget, CommandGroup
from common.errors import ConfigError
from common.terminal import echo

app = CommandGroup("Prepare a robot file, command the arm's controller, jog the arm.")
app.command()(robot_new.new)
app.command()(robot_new.check)


@app.command()
def collisions(
    name: Annotated[
        str, typer.Argument(metavar="ROBOT", help="a name of config/robots, or the path of a YAML file",
                            autocompletion=choices.robots)
    ],
    samples: Annotated[str, typer.Option("--samples", metavar="N", help="number of random configurations")] = "10000",
    margin: Annotated[str, typer.Option("--margin", metavar="M", help="check pairs that come this close [m]")]
    = "0.005",
    seed: Annotated[str, typer.Option("--seed", metavar="N", help="seed of the configurations")] = "0",
    output: Annotated[str, typer.Option("-o", "--output", metavar="FILE", help="file to write [stdout]")] = "",
) -> None:
    """Compute an SRDF: groups, named poses, and the pairs of links that need no collision check."""
    import numpy as np

    from common.config import load_robot
    from common.robot.model import RobotModel
    from tools.robot_setup.disabled_collisions import disabled_pairs, srdf

    count, number = options.whole("--samples", samples, 1), options.whole("--seed", seed, 0)
    distance = options.number("--margin", margin)
    if distance < 0:
        raise ConfigError("--margin", margin, "must be 0 or more")
    # The SRDF that the robot file names may not exist yet: this command creates it.
    model = RobotModel.load(load_robot(name).model_copy(update={"srdf": ""}))
    pairs = disabled_pairs(model, samples=count or 1, margin=distance, rng=np.random.default_rng(number))
    text = srdf(model, pairs)
    if not output:
        echo(text, nl=False)
        return
    options.write_text(output, text)
    found = Counter(pair.reason for pair in pairs)
    echo(f"{output}: {len(pairs)} pairs need no check "
         f"({', '.join(f'{found[reason]} {reason.lower()}' for reason in sorted(found))})")


@app.command()
def status(at: CellTarget = RUNNING) -> None:
    """Print the state of the arm's controller: mode, why it cannot move, speed slider."""
    state = at.join(lambda cell: cell.arm.robot())
    echo(f"{state.mode}{f': {state.message}' if state.message else ''}")
    echo(f"speed slider {state.speed:.0%}, latest cycle {state.late * 1e3:.1f} ms late, "
         f"inputs {state.inputs:#b}, outputs {state.outputs:#b}")


def _order(at: CellTarget, act: str, value: float = 0.0, **more: Any) -> None:
    state = at.join(lambda cell: cell.arm.order(act, value, **more))
    echo(f"{state.mode}{f': {state.message}' if state.message else ''}")


@app.command()
def enable(at: CellTarget = RUNNING) -> None:
    """Power the joints and release the brakes."""
    _order(at, "enable")


@app.command()
def recover(at: CellTarget = RUNNING) -> None:
    """Recover the arm from a protective stop."""
    _order(at, "recover")


@app.command()
def freedrive(
    state: Annotated[str, typer.Argument(metavar="on|off", help="whether the arm can be guided by hand")],
    at: CellTarget = RUNNING,
) -> None:
    """Switch hand guiding of the arm on or off."""
    if state not in ("on", "off"):
        raise ConfigError("freedrive", state, "must be on or off")
    _order(at, "freedrive", float(state == "on"))


@app.command()
def payload(
    mass: Annotated[str, typer.Argument(metavar="KG", help="mass on the flange: gripper and object")],
    com: Annotated[
        str, typer.Option("--com", metavar="X,Y,Z", help="centre of mass in the flange frame [m]")] = "0,0,0",
    at: CellTarget = RUNNING,
) -> None:
    """Set the payload of the arm's controller."""
    x, y, z = options.three("--com", com)
    _order(at, "payload", options.number("KG", mass), com={"x": x, "y": y, "z": z})


@app.command()
def io(
    output: Annotated[str | None, typer.Argument(metavar="OUTPUT", help="number of a digital output")] = None,
    state: Annotated[str | None, typer.Argument(metavar="on|off", help="new state of the output")] = None,
    at: CellTarget = RUNNING,
) -> None:
    """Print the digital inputs and outputs of the arm's controller, or set an output."""
    if output is None:
        controller = at.join(lambda cell: cell.arm.robot())
        echo(f"inputs on: {_numbers(controller.inputs)}\noutputs on: {_numbers(controller.outputs)}")
        return
    if state not in ("on", "off"):
        raise ConfigError("io", state or "", "must be on or off")
    _order(at, "output", float(state == "on"), output=options.whole("OUTPUT", output, 0))


def _numbers(bits: int) -> str:
    """Return the numbers of the bits that are set."""
    return ", ".join(str(n) for n in range(32) if bits >> n & 1) or "none"


# --- motion authority ----------------------------------------------------------------------------------------------


@app.command()
def owner(at: CellTarget = RUNNING) -> None:
    """Print which client has motion authority. Any client may stop or hold the robot."""
    current = at.join(lambda cell: cell.arm.owner_now())
    echo(f"the motion is {current.description}{', jogging the arm' if current.jogging else ''}")


def _own(at: CellTarget, act: Literal["take", "give"], *, over: bool = False) -> None:
    current = at.join(lambda cell: cell.arm.own(act, over=over, kind="operator"))
    echo(f"the motion is {current.description}")


@app.command()
def take(
    over: Annotated[bool, typer.Option("--over", help="take it from its owner: their motion stops, and a task "
                                                      "waits for `zencell task start`")] = False,
    at: CellTarget = RUNNING,
) -> None:
    """Take motion authority until you release it: no task and no other client can move the robot."""
    _own(at, "take", over=over)


@app.command()
def give(at: CellTarget = RUNNING) -> None:
    """Give motion authority back. This moves nothing."""
    _own(at, "give")


@app.command()
def jog(
    joint: Annotated[list[str] | None, typer.Option("--joint", metavar="NAME=V", help="velocity of a joint [rad/s]; "
                                                                                      "may be given again")] = None,
    linear: Annotated[str | None, typer.Option("--linear", metavar="X,Y,Z", help="velocity of the TCP [m/s]")] = None,
    angular: Annotated[
        str | None, typer.Option("--angular", metavar="X,Y,Z", help="rotation of the tool about the TCP [rad/s]")
    ] = None,
    frame: Annotated[str, typer.Option("--frame", metavar="base|tool|world", help="frame of --linear and "
                                                                                  "--angular")] = "base",
    seconds: Annotated[str, typer.Option("--seconds", metavar="S", help="duration [s], at most 60")] = "1",
    at: CellTarget = RUNNING,
) -> None:
    """Jog the arm for a while: at most 0.25 m/s; the arm is at standstill 0.2 s after Ctrl-C or the end."""
    from common.client.operator_motion import check_seconds

    duration = options.number("--seconds", seconds)
    check_seconds(duration, "--seconds")
    if not (joint or linear or angular):
        raise ConfigError("jog", ..., "needs --joint NAME=V, --linear X,Y,Z or --angular X,Y,Z")
    joints = {}
    for each in joint or []:
        name, _, value = each.partition("=")
        joints[name] = options.number("--joint", value)
    request: dict[str, Any] = {
        "joints": joints, "linear": options.three("--linear", linear or "0,0,0"),
        "angular": options.three("--angular", angular or "0,0,0"), "frame": frame,
        "seconds": duration}
    at.join(lambda cell: cell.arm.jog(**request))
