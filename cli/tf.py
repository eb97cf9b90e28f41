"""`tf`: the pose of one coordinate frame in another, and the tree of frames."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import AsyncGenerator
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli import options
from cli.options import RUNNING, CellTarget, CommandGroup
from common import terminal

if TYPE_CHECKING:
    from common.robot.transform_tree import TransformTree
    from common.transport.bus import Bus

app = CommandGroup("Show poses of coordinate frames, and the tree of frames.")


@app.command()
def echo(
    target: Annotated[str, typer.Argument(metavar="A", help="reference frame, one of `zencell tf frames`")],
    source: Annotated[str, typer.Argument(metavar="B", help="frame whose pose is shown")],
    once: Annotated[bool, typer.Option("--once", help="print one line and exit")] = False,
    rate: Annotated[str, typer.Option("--rate", metavar="HZ", help="lines per second")] = "1",
    count: options.Count = None,
    at: CellTarget = RUNNING,
    as_json: options.Json = False,
) -> None:
    """Show the pose of B in A: position, quaternion x y z w, and roll, pitch, yaw in degrees."""
    from common.client.frames import Frames

    period = 1 / options.rate(rate)
    most = 1 if once else options.whole("--count", count, 1)

    async def lines(bus: Bus) -> AsyncGenerator[str, None]:
        async with Frames(bus) as frames:
            await frames.until_known(target, source)
            while True:
                frames.require_recent(target, source)
                figures = pose_figures(frames.tree, target, source)
                yield json.dumps(figures) if as_json else pose_line(figures)
                await asyncio.sleep(period)

    at.show(lines, most)


def pose_figures(tree: TransformTree, target: str, source: str) -> dict[str, Any]:
    """Return the pose of source in target as JSON: position [m], quaternion x, y, z, w, rpy [deg], stamp [ns]."""
    from common.robot.transforms import matrix_to_quaternion, matrix_to_rpy

    T = tree.pose(target, source)
    stamp = max(map(tree.stamp_of, tree.path(target, source)))  # of the newest transform on the path
    return {
        "target": target, "source": source, "stamp": stamp,
        "position": [round(float(value), 6) + 0.0 for value in T[:3, 3]],
        "quaternion": [round(value, 6) + 0.0 for value in matrix_to_quaternion(T[:3, :3])],
        "rpy_degrees": [round(math.degrees(value), 3) + 0.0 for value in matrix_to_rpy(T[:3, :3])],
    }


def pose_line(figures: dict[str, Any]) -> str:
    """Return a pose as a line of text."""

    def listed(values: list[float], digits: int) -> str:
        return " ".join(f"{round(value, digits) + 0.0:.{digits}f}" for value in values)

    return (
        f"{figures['source']} in {figures['target']}: position {listed(figures['position'], 4)} m, "
        f"quaternion {listed(figures['quaternion'], 4)}, rpy {listed(figures['rpy_degrees'], 2)} deg"
    )


@app.command()
def frames(at: CellTarget = RUNNING, as_json: options.Json = False) -> None:
    """Show the tree of frames, and which of them move."""
    from common.client.frames import Frames

    async def gather(bus: Bus) -> Frames:
        async with Frames(bus) as found:
            await found.gather()
        return found

    found = at.visit(gather)
    for depth, name in found.tree.walk():
        moves = name in found.moving
        if as_json:
            terminal.echo(json.dumps({"frame": name, "parent": found.tree.parent_of(name), "moves": moves}))
        else:
            terminal.echo(f"{'  ' * depth}{name}{'  (moves)' if moves else ''}")
