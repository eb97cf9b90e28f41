"""Outlining stage by stage: `snapshot` stores what the camera sees, `outline` goes on from the files alone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli import options
from common.applications.outlining.messages import OutlinePoints, OutlineSelect
from common.applications.outlining.topics import CONTOUR_PATH, CONTOUR_POINTS, CONTOURS, OUTLINE_SELECT
from common.errors import ConfigError, ZencellError

if TYPE_CHECKING:
    from common.config import Cell
    from common.messages import Image
    from common.transport.bus import Bus, Reader

TIMEOUT = 30.0  # [s] for a picture and its outline
ALL_WITHIN = 3.0  # [s, cell time] after the first picture for a contour to be chosen

Folder = Annotated[str, typer.Argument(metavar="DIR", help="folder of the files")]
Select = Annotated[
    str, typer.Option("--select", metavar="WHICH", help="auto, a colour or an index, as `zencell task select`")
]


class NoOutline(ZencellError):
    """The picture was stored, but it has no outline."""

    exit_code = 1


def snapshot(
    cell: options.CellArgument, folder: Folder, select: Select = "auto",
    overrides: options.Overrides = None, world: options.WorldName = None, seed: options.Seed = None,
    domain: options.Domain = None, connect: options.Connect = None,
) -> None:
    """Store what a cell's depth camera sees, and the three stages of its outline, under the names of the seed.

    A cell that is up is asked; else its services are started for it, without the task, and stopped again.
    """
    from cli.inspection import inspect
    from cli.operation import Operation
    from common.applications.outlining.contours_choice import parse_choice
    from common.config import load_cell
    from common.supervision.launch import place_of, require_free_port
    from common.transport.endpoint import endpoint_of
    from common.transport.router import PortInUse

    wanted, place = parse_choice(select), Path(folder)

    async def visit(bus: Bus) -> str:
        return await store(bus, place, wanted)

    number, endpoint = place_of(domain, connect)
    try:
        if endpoint is None:
            require_free_port(endpoint_of(number))
        is_up = endpoint is not None
    except PortInUse:  # somebody has the port: a router, if it is zencell's
        is_up = True
    if is_up:
        name = load_cell(cell, tuple(overrides or ()), world=world).name
        typer.echo(inspect(visit, cell=name, domain=domain, connect=connect))
        return
    operation = Operation(cell, overrides, world, seed, "1", domain, connect, no_viewer=True)
    operation.leave_out(operation.cell.task)
    typer.echo(operation.visit(visit))


async def store(bus: Bus, folder: Path, wanted: OutlineSelect | None) -> str:
    """Put a picture, its depth and the stages of its outline into a folder; returns what was stored.

    Raises:
        NoOutline: there is a picture and no outline in it.
        StageFileError: a file can not be written.
    """
    import asyncio

    from common import topics
    from common.applications.outlining import stage_files
    from common.perception.depth_intake import depth_of
    from common.perception.intake import colour_picture

    pictures, depths = bus.reader(topics.DEPTH_CAMERA_IMAGE), bus.reader(topics.DEPTH_CAMERA_DEPTH)
    contours, points = bus.reader(CONTOURS), bus.reader(CONTOUR_POINTS)
    paths = bus.reader(CONTOUR_PATH)
    try:
        async with asyncio.timeout(TIMEOUT):
            first = await pictures.next()
            if wanted is not None and wanted.rule != "auto":
                await contours.next()
                await bus.client(OUTLINE_SELECT).call(wanted)
            picture, depth = await _pair(pictures, depths)
            stage_files.write_pictures(folder, colour_picture(picture), depth_of(depth))
            path = await paths.next()
            while path.header.stamp < picture.header.stamp or not path.poses:
                if path.message and path.header.stamp - first.header.stamp > ALL_WITHIN * 1e9:
                    raise NoOutline(f"{path.message}; the picture is in {folder}")
                path = await paths.next()
    except TimeoutError:
        raise NoOutline(f"no outline came within {TIMEOUT:g} s: does the cell have a depth camera?") from None
    found, seen = points.latest, contours.latest
    chosen = next((c for c in seen.contours if c.label == path.object), None) if seen else None
    if chosen is not None:
        stage_files.write_points(folder / stage_files.PIXELS, chosen.pixels)
    if found is not None:
        stage_files.write_points(folder / stage_files.COORDINATES, _points(found))
    stage_files.write_points(folder / stage_files.CLEARED, _points(path))
    return f"{path.object}, {len(path.poses)} points: the picture and the stages are in {folder}"


async def _pair(pictures: Reader[Image], depths: Reader[Image]) -> tuple[Image, Image]:
    """A picture and the depth image that was taken with it."""
    while True:
        picture, depth = await pictures.next(), depths.latest
        if depth is not None and depth.header.stamp == picture.header.stamp:
            return picture, depth


def _points(outline: OutlinePoints) -> list[tuple[float, float, float]]:
    return [(p.position.x, p.position.y, p.position.z) for p in outline.poses]


def outline(
    folder: Folder,
    cell: Annotated[str, typer.Option("--cell", metavar="CELL", help="whose camera, robot and surroundings")] = "ur5",
    select: Select = "auto",
    keep: Annotated[bool, typer.Option("--keep", help="plan along the cleared coordinates as they are")] = False,
    overrides: options.Overrides = None, world: options.WorldName = None,
) -> None:
    """Find the outline in the files of a folder, write its stages there and plan its tracing; nothing moves."""
    from common.applications.outlining.contours_choice import parse_choice
    from common.config import load_cell

    wanted = parse_choice(select)
    if wanted is None:
        raise ConfigError("--select", select, "chooses nothing; choices: auto, a colour or an index")
    _stages(load_cell(cell, tuple(overrides or ()), world=world), Path(folder), wanted, keep=keep)


def _stages(cell: Cell, place: Path, wanted: OutlineSelect, *, keep: bool) -> None:
    from common.applications.outlining import stage_files
    from common.applications.outlining.legs import Legs
    from common.applications.outlining.offline import perceive, plan_outline
    from common.applications.outlining.scene import planning_scene
    from common.applications.outlining.task import Config
    from common.config import Surroundings, service_config
    from common.perception.pinhole import Pinhole
    from common.planning.pipeline import PlanningPipeline
    from common.robot.model import RobotModel
    from services import contour_detector, duplicate_remover, pixel_to_world

    around = cell.section(Surroundings)
    assert isinstance(around, Surroundings)
    camera = Pinhole.from_config(around.camera)
    picture, depth = stage_files.read_pictures(place)
    size, expected = f"{depth.shape[1]}x{depth.shape[0]}", f"{camera.width}x{camera.height}"
    if size != expected:
        raise ConfigError(str(place / stage_files.PICTURE), size, f"must be as large as the camera's: {expected}")
    tolerance = service_config(cell, "duplicate_remover", duplicate_remover.Config).tolerance
    found = perceive(
        picture, depth, camera, wanted, service_config(cell, "contour_detector", contour_detector.Config),
        service_config(cell, "pixel_to_world", pixel_to_world.Config), tolerance,
    )
    stage_files.write_points(place / stage_files.PIXELS, found.pixels)
    stage_files.write_points(place / stage_files.COORDINATES, found.coordinates)
    cleared, label = found.cleared, found.label
    if keep:
        cleared, label = stage_files.read_coordinates(place / stage_files.CLEARED), stage_files.CLEARED
    else:
        stage_files.write_points(place / stage_files.CLEARED, cleared)
    typer.echo(f"{found.label}: {len(found.pixels)} pixels, {len(cleared)} points to trace; the stages are in {place}")
    parameters = service_config(cell, "contour_tracer", Config)
    assert parameters.robot.gripper is not None  # the tracer needs one as well
    pipeline = PlanningPipeline(RobotModel.load(cell.robot), cell.motion, cell.pipeline, seed=cell.run.seed)
    scene = planning_scene(around, found.solids, 1)
    legs = Legs(parameters, parameters.robot.gripper)
    for leg, response in plan_outline(pipeline, legs, cleared, label, scene, given=keep):
        typer.echo(f"  {leg.name:<8} {leg.seconds:6.2f} s by {response.planner}, planned in "
                   f"{1e3 * response.seconds:.0f} ms, fraction {response.fraction:.2f}")
