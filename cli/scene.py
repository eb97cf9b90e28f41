"""Solids that an operator adds to the planning scene because no camera sees them."""

from __future__ import annotations

from typing import Annotated, Any, Literal, cast

import typer

from cli import options
from cli.target import RUNNING, CellTarget, CommandGroup
from common.terminal import echo

app = CommandGroup("Add solids to the planning scene that no camera sees.")

Name = Annotated[str, typer.Argument(metavar="NAME", help="name of your choice; its id in the scene is added/NAME")]


@app.command("list")
def list_(at: CellTarget = RUNNING, as_json: options.Json = False) -> None:
    """List the added solids; `zencell topic echo planning_scene` shows all obstacles."""
    from common.messages.schema import to_json

    for solid in at.join(lambda cell: cell.scene.objects()):
        middle, sides = solid.pose.position, " x ".join(f"{side:g}" for side in solid.dimensions)
        echo(to_json(solid.model_dump()) if as_json else
             f"{solid.id}  {solid.shape} {sides} m at {middle.x:g}, {middle.y:g}, {middle.z:g}")


@app.command(context_settings={"ignore_unknown_options": True})  # -0.2 is a coordinate, not an option
def add(
    name: Name,
    shape: Annotated[str, typer.Argument(metavar="SHAPE", help="box, sphere or cylinder")],
    size: Annotated[str, typer.Argument(
        metavar="SIZE", help="X,Y,Z of a box; radius of a sphere; radius,length of a cylinder [m]")],
    middle: Annotated[str, typer.Argument(metavar="X,Y,Z", help="its center in world [m]")],
    rpy: Annotated[str, typer.Option("--rpy", metavar="R,P,Y", help="roll, pitch, yaw [rad]")] = "0,0,0",
    color: Annotated[str, typer.Option("--color", metavar="R,G,B", help="0 to 1 each")] = "",
    at: CellTarget = RUNNING,
) -> None:
    """Add a solid; it persists over restarts until it is removed. A motion that would hit it brakes."""
    from common.client.goals import pose

    x, y, z = options.three("X,Y,Z", middle)
    options_given: dict[str, Any] = {"at": pose(x, y, z, rpy=options.three("--rpy", rpy))}
    if color:
        options_given["color"] = options.three("--color", color)
    kind = cast(Literal["box", "sphere", "cylinder"], shape)
    dimensions = options.numbers("SIZE", size)
    echo(at.join(lambda cell: cell.scene.add(name, kind, dimensions, **options_given)))


@app.command()
def remove(name: Name, at: CellTarget = RUNNING) -> None:
    """Remove a solid by name, also one that another operator added."""
    left = at.join(lambda cell: cell.scene.remove(name))
    echo(f"still added: {', '.join(left) or 'nothing'}")
