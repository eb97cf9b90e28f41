"""Frames: where one is in another, and the tree that they make."""

from __future__ import annotations

import asyncio
import json
import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli import options
from common import terminal

if TYPE_CHECKING:
    from common.robot.transform_tree import TransformTree
    from common.transport.bus import Bus

app = typer.Typer(help="Frames: where one is in another, and the tree that they make.", no_args_is_help=True)

Rate = Annotated[str, typer.Option("--rate", metavar="HZ", help="lines per second")]
Once = Annotated[bool, typer.Option("--once", help="one line, then end")]


@app.command()
def echo(
    target: Annotated[str, typer.Argument(metavar="A", help="the frame to measure in, as in `zencell tf frames`")],
    source: Annotated[str, typer.Argument(metavar="B", help="the frame whose pose is wanted")],
    once: Once = False,
    rate: Rate = "1",
    count: options.Count = None,
    cell: options.CellName = None,
    as_json: options.Json = False,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Show the pose of B in A: position, quaternion x y z w, and roll, pitch, yaw in degrees."""
    from cli.inspection import inspect
    from common.client.hearing import Frames

    period = 1 / options.rate(rate)
    most = 1 if once else options.whole("--count", count, 1)

    async def visit(bus: Bus) -> None:
        frames = Frames(bus)
        async with frames:
            await frames.until_known(target, source)
            shown = 0
            while True:
                figures = pose_figures(frames.tree, target, source)
                terminal.echo(json.dumps(figures) if as_json else describe(figures))
                shown += 1
                if shown == most:
                    return
                await asyncio.sleep(period)

    inspect(visit, cell=cell, domain=domain, connect=connect)


@app.command()
def frames(
    cell: options.CellName = None,
    as_json: options.Json = False,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Show the tree of frames, and which of them move."""
    from cli.inspection import inspect
    from common.client.hearing import Frames

    async def visit(bus: Bus) -> None:
        found = Frames(bus)
        async with found:
            await found.gather()
        for depth, name in found.tree.walk():
            parent = found.tree.parent_of(name)
            moves = name in found.moving
            if as_json:
                terminal.echo(json.dumps({"frame": name, "parent": parent, "moves": moves}))
            else:
                terminal.echo(f"{'  ' * depth}{name}{'  (moves)' if moves else ''}")

    inspect(visit, cell=cell, domain=domain, connect=connect)


def pose_figures(tree: TransformTree, target: str, source: str) -> dict[str, Any]:
    """The pose of source in target as JSON can hold it: position [m], quaternion x, y, z, w, rpy [deg], stamp [ns]."""
    from common.robot.transforms import matrix_to_quaternion, matrix_to_rpy

    T = tree.pose(target, source)
    # Of all that the pose is made of, what changed last.
    stamp = max(map(tree.stamp_of, tree.path(target, source)))
    return {
        "target": target, "source": source, "stamp": stamp,
        "position": [round(float(value), 6) + 0.0 for value in T[:3, 3]],
        "quaternion": [round(value, 6) + 0.0 for value in matrix_to_quaternion(T[:3, :3])],
        "rpy_degrees": [round(math.degrees(value), 3) + 0.0 for value in matrix_to_rpy(T[:3, :3])],
    }


def describe(figures: dict[str, Any]) -> str:
    """The pose in one line for people."""

    def listed(values: list[float], digits: int) -> str:
        return " ".join(f"{round(value, digits) + 0.0:.{digits}f}" for value in values)

    return (
        f"{figures['source']} in {figures['target']}: position {listed(figures['position'], 4)} m, "
        f"quaternion {listed(figures['quaternion'], 4)}, rpy {listed(figures['rpy_degrees'], 2)} deg"
    )
