"""Commands of outlining.

`snapshot` stores what the camera sees, `outline` continues from the files alone, `task select` selects the object;
`run --ask` and `run --from` select it before the cell starts.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from common.errors import ConfigError
from common.terminal import echo
from common.verbs import BeforeRun, Verbs

if TYPE_CHECKING:
    from applications.outlining.topics import OutlineSelect
    from common.config import Cell
    from common.verbs import Shell

CELL = "ur5"  # a cell of the project
Folder = Annotated[str, typer.Argument(metavar="DIR", help="folder of the files")]
Select = Annotated[
    str, typer.Option("--select", metavar="WHICH", help="auto, a colour or an index, as `zencell task select`")
]
Ask = Annotated[bool, typer.Option("--ask", help="outlining: ask at the terminal which object")]
From = Annotated[str | None, typer.Option("--from", metavar="DIR", help="outlining: trace coordinates stored there")]


def snapshot(
    context: typer.Context, cell: str, folder: Folder, select: Select = "auto", overrides: list[str] | None = None,
    world: str | None = None, seed: str | None = None, domain: str | None = None, connect: str | None = None,
) -> None:
    """Store the images of a cell's depth camera and the three stages of its outline, under the original file names.

    Uses a running cell; else starts its services without the task, and stops them again.
    """
    from applications.outlining.contour_choice import parse_choice
    from applications.outlining.visits import store_stages

    shell: Shell = context.obj
    visit = partial(store_stages, folder=Path(folder), wanted=parse_choice(select))
    echo(shell.visit(visit, cell, overrides, world, seed, domain, connect))


def outline(
    context: typer.Context, folder: Folder,
    cell: Annotated[str, typer.Option("--cell", metavar="CELL", help="whose camera, robot and surroundings")] = CELL,
    select: Select = "auto",
    keep: Annotated[bool, typer.Option("--keep", help="plan along the cleared coordinates as they are")] = False,
    overrides: list[str] | None = None, world: str | None = None,
) -> None:
    """Find the outline in the files of a folder, write its stages there and plan its motions; nothing moves."""
    from applications.outlining.contour_choice import parse_choice
    from common.config import load_cell

    wanted = parse_choice(select)
    if wanted is None:
        raise ConfigError("--select", select, "chooses nothing; choices: auto, a colour or an index")
    shell: Shell = context.obj
    _stages(shell, load_cell(cell, tuple(overrides or ()), world=world), Path(folder), wanted, keep=keep)


def select(
    context: typer.Context,
    which: Annotated[str, typer.Argument(metavar="N", help="an index, a label such as Object_2, a colour, or auto")],
    cell: str | None = None, domain: str | None = None, connect: str | None = None,
) -> None:
    """Select the object to outline."""
    from applications.outlining.contour_choice import parse_choice
    from applications.outlining.topics import OUTLINE_SELECT

    wanted = parse_choice(which)
    if wanted is None:
        raise ConfigError("task select", which, "chooses nothing; choices: an index, a label, a colour, or auto")
    shell: Shell = context.obj
    shell.send(OUTLINE_SELECT, wanted, cell, domain, connect)


def before_run(
    cell: str, overrides: list[str], world: str | None, *, ask: Ask = False, source: From = None
) -> BeforeRun:
    """Prepare the selection of the object to outline.

    Raises:
        ConfigError: there is no terminal, the coordinates cannot be used, or the cell outlines nothing.
    """
    if not ask and source is None:
        return BeforeRun(overrides)
    from applications.outlining import APPLICATION
    from applications.outlining.stage_files import CLEARED, read_coordinates
    from applications.outlining.visits import CHOOSE_BY_HAND, ask_operator, require_terminal
    from common.config import load_cell

    for option, wanted in (("--ask", ask), ("--from", source is not None)):
        if wanted and load_cell(cell, overrides, world=world).task != APPLICATION.task:
            raise ConfigError(option, cell, f"needs a cell that outlines objects, such as {CELL}")
    if ask and source is not None:
        raise ConfigError("--ask", ..., "and --from are two ways to choose: give one of them")
    if ask:
        require_terminal()
        return BeforeRun([*CHOOSE_BY_HAND, *overrides], partial(ask_operator, folder=Path.cwd()))
    file = (Path(source or "") / CLEARED).absolute()
    read_coordinates(file)
    return BeforeRun([f"services.duplicate_remover.coordinates={json.dumps(str(file))}", *overrides])


def _stages(shell: Shell, cell: Cell, place: Path, wanted: OutlineSelect, *, keep: bool) -> None:
    from applications.outlining import stage_files
    from applications.outlining.offline import perceive, plan_outline
    from applications.outlining.solids import planning_scene
    from applications.outlining.task import MotionSegments
    from common.config import Surroundings
    from common.perception.pinhole import MountedCamera
    from common.planning.pipeline import PlanningPipeline
    from common.robot.model import RobotModel

    around = cell.section(Surroundings)
    assert isinstance(around, Surroundings)
    camera = MountedCamera(around.camera, RobotModel.load(cell.robot)).at()
    picture, depth = stage_files.read_pictures(place)
    size, expected = f"{depth.shape[1]}x{depth.shape[0]}", f"{camera.width}x{camera.height}"
    if size != expected:
        raise ConfigError(str(place / stage_files.PICTURE), size, f"must be as large as the camera's: {expected}")
    found = perceive(
        picture, depth, camera, wanted, shell.parameters(cell, "contour_detector"),
        shell.parameters(cell, "pixel_to_world"), shell.parameters(cell, "duplicate_remover").tolerance,
    )
    stage_files.write_points(place / stage_files.PIXELS, found.pixels)
    stage_files.write_points(place / stage_files.COORDINATES, found.coordinates)
    cleared, label = found.cleared, found.label
    if keep:
        cleared, label = stage_files.read_coordinates(place / stage_files.CLEARED), stage_files.CLEARED
    else:
        stage_files.write_points(place / stage_files.CLEARED, cleared)
    echo(f"{found.label}: {len(found.pixels)} pixels, {len(cleared)} points to trace; the stages are in {place}")
    parameters = shell.parameters(cell, "contour_tracer")
    assert parameters.robot.gripper is not None  # the tracer requires one
    pipeline = PlanningPipeline(RobotModel.load(cell.robot), cell.motion, cell.pipeline, seed=cell.run.seed)
    scene = planning_scene(around, found.solids, 1)
    legs = MotionSegments(parameters, parameters.robot.gripper)
    for leg, response in plan_outline(pipeline, legs, cleared, label, scene, given=keep):
        echo(f"  {leg.name:<8} {leg.seconds:6.2f} s by {response.planner}, planned in "
                   f"{1e3 * response.seconds:.0f} ms, fraction {response.fraction:.2f}")


VERBS = Verbs(commands={"snapshot": snapshot, "outline": outline, "task select": select}, before_run=before_run)
