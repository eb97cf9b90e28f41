"""`robot`: robot files, disabled collision pairs, and commands to the controllers of running arms."""

from __future__ import annotations

import contextlib
import functools
import re
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperCommand

from cli import choices, options
from cli.options import OF_ARM, CellTarget, CommandGroup
from common.errors import ConfigError
from common.terminal import echo

if TYPE_CHECKING:
    from common.robot.model import RobotModel
    from tools.robot_setup.files import Layout
    from tools.robot_setup.proposal import Proposal
    from tools.robot_setup.tree import Tree

app = CommandGroup("Prepare a robot file, command the arm's controller, jog the arm.")


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
    from tools.robot_setup.sampling import disabled_pairs, srdf

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
def status(at: CellTarget = OF_ARM) -> None:
    """Print the state of the arm's controller: mode, why it cannot move, speed slider."""
    state = at.join(lambda cell: cell.arm.robot())
    echo(f"{state.mode}{f': {state.message}' if state.message else ''}")
    echo(f"speed slider {state.speed:.0%}, latest cycle {state.late * 1e3:.1f} ms late, "
         f"{state.resumed} interruptions resumed, inputs {state.inputs:#b}, outputs {state.outputs:#b}")


def _order(at: CellTarget, act: str, value: float = 0.0, **more: Any) -> None:
    state = at.join(lambda cell: cell.arm.order(act, value, **more))
    echo(f"{state.mode}{f': {state.message}' if state.message else ''}")


@app.command()
def enable(at: CellTarget = OF_ARM) -> None:
    """Power the joints and release the brakes; rejected in a protective or emergency stop."""
    _order(at, "enable")


@app.command()
def recover(at: CellTarget = OF_ARM) -> None:
    """Release the arm from a protective or emergency stop; rejected while its joints are without power."""
    _order(at, "recover")


@app.command()
def freedrive(
    state: Annotated[str, typer.Argument(metavar="on|off", help="whether the arm can be guided by hand")],
    at: CellTarget = OF_ARM,
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
    at: CellTarget = OF_ARM,
) -> None:
    """Set the payload of the arm's controller."""
    x, y, z = options.three("--com", com)
    _order(at, "payload", options.number("KG", mass), com={"x": x, "y": y, "z": z})


@app.command()
def io(
    output: Annotated[str | None, typer.Argument(metavar="OUTPUT", help="number of a digital output")] = None,
    state: Annotated[str | None, typer.Argument(metavar="on|off", help="new state of the output")] = None,
    at: CellTarget = OF_ARM,
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
def owner(at: CellTarget = OF_ARM) -> None:
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
    at: CellTarget = OF_ARM,
) -> None:
    """Take motion authority until you release it: no task and no other client can move the robot."""
    _own(at, "take", over=over)


@app.command()
def give(at: CellTarget = OF_ARM) -> None:
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
    at: CellTarget = OF_ARM,
) -> None:
    """Jog the arm for a while: at most 0.25 m/s; the arm is at standstill 0.2 s after Ctrl-C or the end."""
    from common.client.arguments import require_seconds
    from common.client.operator_motion import LONGEST_JOG

    duration = options.number("--seconds", seconds)
    require_seconds("--seconds", duration, LONGEST_JOG)
    if not (joint or linear or angular):
        raise ConfigError("jog", ..., "needs --joint NAME=V, --linear X,Y,Z or --angular X,Y,Z")
    joints = {}
    for each in joint or []:
        name, _, value = each.partition("=")
        joints[name] = options.number("--joint", value)
    request: dict[str, Any] = {
        "joints": joints, "linear": options.three("--linear", linear or "0,0,0"),
        "angular": options.three("--angular", angular or "0,0,0"), "frame": frame, "seconds": duration}
    at.join(lambda cell: cell.arm.jog(**request))


NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,39}")


class CommandWithPairs(TyperCommand):
    """A command whose option --allow-pair takes two values, which typer cannot declare for an option that repeats."""

    def __init__(self, *given: Any, **settings: Any) -> None:
        super().__init__(*given, **settings)
        for each in self.params:
            if each.name == "allow_pair":
                each.nargs = 2


@app.command(cls=CommandWithPairs)
def new(
    urdf: Annotated[str, typer.Argument(metavar="URDF", help="URDF or xacro file of the arm: a path, or "
                                                             "package://...")],
    arguments: Annotated[list[str] | None, typer.Argument(
        metavar="NAME:=VALUE", help="arguments of xacro files")] = None,
    gripper: Annotated[str, typer.Option("--gripper", metavar="URDF", help="URDF of a gripper to mount on the "
                                                                           "flange")] = "",
    name: Annotated[str, typer.Option("--name", metavar="NAME", help="name of the robot")] = "",
    out: Annotated[str, typer.Option("--out", "-o", metavar="FILE.yaml", help="[NAME.yaml]; the SRDF with the disabled "
                                                                              "collision pairs is written next "
                                                                              "to it")] = "",
    tip: Annotated[str | None, typer.Option("--tip", metavar="LINK", help="link at the end of the arm: the tool centre "
                                            "point, or the mount of --gripper")] = None,
    package_dir: Annotated[list[str] | None, typer.Option(
        "--package-dir", metavar="DIR", help="folder with packages, searched a few levels deep; repeatable")] = None,
    srdf: Annotated[str, typer.Option("--srdf", metavar="FILE", help="the maker's SRDF: its pairs without collision "
                                      "checks, the arm's group, named poses")] = "",
    group: Annotated[str, typer.Option("--group", metavar="NAME", help="group of that SRDF which is the arm "
                                                                       "[the first chain]")] = "",
    cell: Annotated[str, typer.Option("--cell", metavar="FILE.yaml", help="also write a cell, with a world "
                                                                          "within reach of this arm")] = "",
    like: Annotated[str, typer.Option("--like", metavar="CELL", help="template of that cell",
                                      autocompletion=choices.cells)] = "",
    allow_pair: Annotated[list[Any] | None, typer.Option(
        "--allow-pair", metavar="LINK LINK", parser=lambda pair: pair, help="links that may touch; repeatable")] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="ask no questions: use the best guesses")] = False,
    force: Annotated[bool, typer.Option("--force", help="overwrite existing files")] = False,
    trust: Annotated[bool, typer.Option("--trust", help="let expressions of xacro files run any Python")] = False,
) -> None:
    """Write a robot file from a URDF: declared and measured values, and guesses, which are marked."""
    from common.config import default_cell
    from tools.robot_setup.descriptions import Reader, existing_folders, parse_arguments, written
    from tools.robot_setup.files import robot_file, write_cell
    from tools.robot_setup.maker_srdf import MakerSrdf, read_srdf
    from tools.robot_setup.proposal import finish
    from tools.robot_setup.tree import read_tree

    reader = Reader(existing_folders(package_dir or []), parse_arguments(arguments or []), trust)
    arm = reader.read("urdf", urdf)
    hand = reader.read("--gripper", gripper) if gripper else None
    tree = read_tree(arm.root, urdf)
    maker = read_srdf(reader.read("--srdf", srdf).root, tree) if srdf else MakerSrdf()
    group = maker.arm(group) if srdf or group else ""
    reader.check_arguments()
    chosen = name or _ask("name of the robot", _plain_name(tree.name or Path(urdf).name.split(".")[0]), yes)
    if not NAME.fullmatch(chosen):
        raise ConfigError("--name", chosen, "must be letters, digits, - and _, and begin with a letter")
    path = Path(out or f"{chosen}.yaml").expanduser()
    pairs = path.with_suffix(".srdf")
    template = like or default_cell()
    _require_writable("--out", path, force)
    _require_writable("--out", pairs, force, (".srdf",))
    layout = _layout_of(cell, path, template, force) if cell else None
    with contextlib.ExitStack() as stack:
        if arm.expanded:
            urdf = stack.enter_context(written(arm, path.with_suffix(".urdf"), force))
        if hand and hand.expanded:
            gripper = stack.enter_context(written(hand, path.with_suffix(".gripper.urdf"), force))
        made = _draft(tree, urdf, chosen, gripper, tip, reader.folders, yes, maker.arms.get(group, []),
                      [(one, other) for one, other in allow_pair or []])
        echo("computing collision pairs and a home pose: a few seconds, a minute with detailed meshes", err=True)
        robot = finish(made, maker.pairs, maker.arm_poses(group))
    made.check += [*arm.notes, *(hand.notes if hand else []), *maker.notes(group)]
    head = f"{chosen}, written by `zencell robot new` from its URDF. Check the values marked GUESSED."
    path.write_text(robot_file(made, head, path.parent, pairs.name), encoding="utf-8")
    pairs.write_text(made.srdf, encoding="utf-8")
    _print_result(made, robot, path, pairs)
    if layout is not None:
        write_cell(Path(cell).expanduser(), template, path, layout)
    where = cell or f"{template} --set robot={path}"
    echo(f"next: zencell robot check {path}")
    echo(f"      zencell up {where} --set autostart=false    # check it on its page: View, Frames")
    if robot.config.gripper is not None:
        echo(f"      zencell run {where}")


def _layout_of(cell: str, robot: Path, template: str, force: bool) -> Layout:
    """Return the layout for the world of a new cell; its file must be writable, and not that of the robot."""
    from tools.robot_setup.files import world_layout

    path = Path(cell).expanduser()
    _require_writable("--cell", path, force)
    if path.resolve() == robot.resolve():
        raise ConfigError("--cell", cell, "is the file of the robot: name another file")
    return world_layout(template)


def _draft(
    tree: Tree, urdf: str, name: str, gripper: str, tip: str | None, folders: list[str], yes: bool,
    group: Sequence[str], allowed: Sequence[tuple[str, str]],
) -> Proposal:
    """Return a draft of the robot file; ask for the end of the arm if several links may be it."""
    from tools.robot_setup.proposal import draft
    from tools.robot_setup.tree import find_wrists

    wrists = find_wrists(tree)
    if tip is None and not group and len(wrists) > 1 and not yes:
        longest = max(wrists, key=lambda link: len(tree.above(link)))
        tip = _ask(f"arms end at {', '.join(wrists)}; which", longest, yes)
    make = functools.partial(
        draft, urdf, name, gripper=gripper, package_dirs=folders, group=group, allowed_pairs=allowed)
    made = make(tip=tip)
    fitting = [each.link for each in made.candidates if each.fits]
    if tip is None and len(fitting) > 1 and not yes:
        tip = _ask(f"tool centre point: {', '.join(fitting)}; which", made.values.get("tcp_link", fitting[0]), yes)
        made = make(tip=tip)
    return made


@app.command()
def check(
    name: Annotated[
        str, typer.Argument(metavar="ROBOT", help="a name of config/robots, or the path of a YAML file",
                            autocompletion=choices.robots)
    ],
) -> None:
    """Check the gripper, tool and home pose of a robot file on its model; one line for each fault, exit code 1."""
    from common.config import load_robot
    from common.planning.robot_geometry import RobotGeometry
    from common.robot.model import RobotModel
    from tools.robot_setup.descriptions import Reader
    from tools.robot_setup.end_effector import check_gripper
    from tools.robot_setup.plausibility import findings
    from tools.robot_setup.sampling import hits

    robot = RobotModel.load(load_robot(name))
    for note in Reader(robot.config.package_dirs).read("robot.urdf", robot.config.urdf).notes:
        echo(note)
    impossible, notes = findings(robot)
    for note in notes:
        echo(note)
    faults = [*check_gripper(robot), *impossible]
    touching = hits(robot, RobotGeometry(robot), robot.named("home"))
    faults += [f"named_poses.home: {pair} touch" for pair in touching]
    for line in faults:
        echo(line)
    if faults:
        raise typer.Exit(1)
    gripper = robot.config.gripper
    fingers = f", fingers close along its {gripper.closing_axis}" if gripper and gripper.joints else ""
    echo(f"{robot.config.name}: {robot.dof} joints, tool centre point {robot.config.tcp_link}{fingers}, home is free")


def _ask(question: str, guess: str, yes: bool) -> str:
    """Return the user's answer, or the guess with `--yes`."""
    if yes:
        return guess
    try:
        return str(typer.prompt(question, default=guess))
    except typer.Abort:
        if sys.stdin.isatty():
            raise
        raise ConfigError("--yes", ..., "is needed without a terminal: it takes the best guesses") from None


def _plain_name(text: str) -> str:
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", text).strip("_-")[:40]
    return name if NAME.fullmatch(name) else "robot"


def _require_writable(option: str, path: Path, force: bool, suffixes: Sequence[str] = (".yaml", ".yml")) -> None:
    if path.suffix not in suffixes:
        raise ConfigError(option, str(path), "must end in .yaml")
    if not path.parent.is_dir():
        raise ConfigError(option, str(path), f"cannot be written: the folder {path.parent} does not exist")
    if path.exists() and not force:
        raise ConfigError(option, str(path), "is there already; --force overwrites it")


def _print_result(made: Proposal, robot: RobotModel, path: Path, pairs: Path) -> None:
    gripper = robot.config.gripper
    hand = f"fingers open by {1e3 * gripper.max_width:.0f} mm" if gripper else "no gripper"
    echo(f"{path}, {pairs}: {robot.dof} joints, tool centre point {robot.config.tcp_link}, {hand}")
    for each in made.candidates:
        echo(f"  {each.link}: z points {each.z}")
    for title, lines in (("guessed", made.guessed), ("check", made.check), ("lost", made.lost)):
        for line in lines:
            echo(f"{title}: {line}")
