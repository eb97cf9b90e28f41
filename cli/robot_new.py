"""`robot new`: create a robot file from a URDF. `robot check`: compare a robot file with its model."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli import choices
from common.errors import ConfigError
from common.terminal import echo

if TYPE_CHECKING:
    from common.robot.model import RobotModel
    from tools.robot_setup.proposal import Proposal

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,39}")


def new(
    urdf: Annotated[str, typer.Argument(metavar="URDF", help="URDF of the arm: a path, package://..., or a "
                                                             "xacro file")],
    gripper: Annotated[str, typer.Option("--gripper", metavar="URDF", help="URDF of a gripper to mount on the "
                                                                           "flange")] = "",
    name: Annotated[str, typer.Option("--name", metavar="NAME", help="name of the robot")] = "",
    out: Annotated[str, typer.Option("--out", "-o", metavar="FILE.yaml", help="[NAME.yaml]; the SRDF with the disabled "
                                                                              "collision pairs is written next "
                                                                              "to it")] = "",
    tip: Annotated[str | None, typer.Option("--tip", metavar="LINK", help="link at the end of the arm: the tool centre "
                                            "point, or the mount of --gripper")] = None,
    package_dir: Annotated[list[str] | None, typer.Option(
        "--package-dir", metavar="DIR", help="search path of package://; repeatable")] = None,
    cell: Annotated[str, typer.Option("--cell", metavar="FILE.yaml", help="also write a cell, with a world "
                                                                          "within reach of this arm")] = "",
    like: Annotated[str, typer.Option("--like", metavar="CELL", help="template of that cell",
                                      autocompletion=choices.cells)] = "",
    yes: Annotated[bool, typer.Option("--yes", "-y", help="ask no questions: use the best guesses")] = False,
    force: Annotated[bool, typer.Option("--force", help="overwrite existing files")] = False,
) -> None:
    """Write a robot file from a URDF: declared and measured values, and guesses, which are marked."""
    from common.config import names_of
    from common.robot.urdf import read_urdf
    from tools.robot_setup.files import folders_of_meshes, robot_file, world_layout, write_cell
    from tools.robot_setup.proposal import draft, finish
    from tools.robot_setup.tree import find_wrists, read_tree

    sources = {"urdf": urdf, "--gripper": gripper}
    urdf, gripper = (_as_urdf(each, out, force) for each in (urdf, gripper))
    folders = [str(Path(each).expanduser().resolve()) for each in package_dir or []]
    for field, each in (("urdf", urdf), ("--gripper", gripper)):
        if each:
            folders += folders_of_meshes(field, each, folders, sources[field])
    tree = read_tree(read_urdf("urdf", urdf, folders), urdf)
    chosen = name or _ask("name of the robot", _plain_name(tree.name or Path(urdf).stem), yes)
    if not NAME.fullmatch(chosen):
        raise ConfigError("--name", chosen, "must be letters, digits, - and _, and begin with a letter")
    path = Path(out or f"{chosen}.yaml").expanduser()
    pairs = path.with_suffix(".srdf")
    template = like or names_of("cells")[0]
    _require_writable("--out", path, force)
    _require_writable("--out", pairs, force, (".srdf",))
    layout = None
    if cell:
        _require_writable("--cell", Path(cell).expanduser(), force)
        if Path(cell).expanduser().resolve() == path.resolve():
            raise ConfigError("--cell", cell, "is the file of the robot: name another file")
        layout = world_layout(template)
    wrists = find_wrists(tree)
    if tip is None and len(wrists) > 1 and not yes:
        longest = max(wrists, key=lambda link: len(tree.above(link)))
        tip = _ask(f"arms end at {', '.join(wrists)}; which", longest, yes)
    made = draft(urdf, chosen, gripper=gripper, tip=tip, package_dirs=folders)
    fitting = [each.link for each in made.candidates if each.fits]
    if tip is None and len(fitting) > 1 and not yes:
        tip = _ask(f"tool centre point: {', '.join(fitting)}; which", made.values.get("tcp_link", fitting[0]), yes)
        made = draft(urdf, chosen, gripper=gripper, tip=tip, package_dirs=folders)
    echo("computing collision pairs and a home pose: a few seconds, a minute with detailed meshes", err=True)
    robot = finish(made)
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
    from tools.robot_setup.end_effector import check_gripper
    from tools.robot_setup.home import hits

    robot = RobotModel.load(load_robot(name))
    faults = check_gripper(robot)
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


def _as_urdf(urdf: str, out: str, force: bool) -> str:
    """Return the path of the URDF; a xacro file is converted first."""
    if not urdf.endswith(".xacro"):
        return urdf
    from tools.robot_setup.files import urdf_of_xacro

    return urdf_of_xacro(urdf, Path(out).expanduser().parent if out else Path(), overwrite=force)


def _print_result(made: Proposal, robot: RobotModel, path: Path, pairs: Path) -> None:
    gripper = robot.config.gripper
    hand = f"fingers open by {1e3 * gripper.max_width:.0f} mm" if gripper else "no gripper"
    echo(f"{path}, {pairs}: {robot.dof} joints, tool centre point {robot.config.tcp_link}, {hand}")
    for each in made.candidates:
        echo(f"  {each.link}: z points {each.z}")
    for title, lines in (("guessed", made.guessed), ("check", made.check), ("lost", made.lost)):
        _print_lines(title, lines)


def _print_lines(title: str, lines: Sequence[str]) -> None:
    for line in lines:
        echo(f"{title}: {line}")
