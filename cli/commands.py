"""Send requests: any of them as JSON; verbs of the task, the simulated world and the planning scene."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer

from cli import choices, options
from cli.options import OF_ARM, RUNNING, CellTarget, CommandGroup
from common.errors import ConfigError, UnknownName
from common.terminal import echo

if TYPE_CHECKING:
    from common.client.cell import Cell as Client
    from common.client.task import TaskControl
    from common.messages import Message, WorldEdit
    from common.topics import Request

task = CommandGroup("Start, pause, resume or stop the task.")
world = CommandGroup("Edit the simulated world.")
scene = CommandGroup("Add solids to the planning scene that no camera sees.")

TIMEOUT = 5.0  # [s]
X = Annotated[str, typer.Argument(metavar="X", help="[m] in world")]
Y = Annotated[str, typer.Argument(metavar="Y", help="[m] in world")]
Id = Annotated[str, typer.Argument(metavar="ID", help="as in `zencell topic echo scene_objects`")]
SolidName = Annotated[
    str, typer.Argument(metavar="NAME", help="name of your choice; its id in the scene is added/NAME")
]
NEGATIVE_NUMBERS = {"ignore_unknown_options": True}  # -0.2 is a coordinate, not an option


def call(
    key: Annotated[
        str, typer.Argument(metavar="KEY", help="key of a request, see `zencell topic list`",
                            autocompletion=choices.requests)
    ],
    body: Annotated[str, typer.Argument(metavar="JSON", help="its fields; `zencell topic info KEY` shows an example")],
    at: CellTarget = OF_ARM,
    timeout: Annotated[str, typer.Option("--timeout", metavar="S", help="[s]")] = f"{TIMEOUT:g}",
) -> None:
    """Send a request and print the answer as JSON; exit 1 with one line without an answer."""
    from common.application import all_topics, find_topic
    from common.client.json_codec import message_from_json
    from common.topics import Request

    request = find_topic(key)
    if not isinstance(request, Request):
        requests = [name for name, topic in all_topics().items() if isinstance(topic, Request)]
        raise UnknownName("request", key, requests)
    message = message_from_json(request, key, body)
    seconds = options.number("--timeout", timeout)
    if seconds <= 0:
        raise ConfigError("--timeout", timeout, "must be more than 0")
    send(at, request, message, seconds)


def send(at: CellTarget, request: Request[Any, Any], message: Message, timeout: float = TIMEOUT) -> None:
    """Send a request to a cell that is up and print the answer as JSON."""
    from common.client.joining import newest_interlock
    from common.messages import HoldRequest, TaskCommand

    async def visit(joined: Client) -> Message:
        if isinstance(message, TaskCommand | HoldRequest) and message.acknowledged is None and (
            not message.hold if isinstance(message, HoldRequest) else message.command in ("start", "resume")
        ):
            message.acknowledged = await newest_interlock(joined.bus)
        answer: Message = await joined.call(request, message, timeout=timeout)
        return answer

    at.answer(visit)


# --- task -------------------------------------------------------------------------------------------------------


def _task(at: CellTarget, command: Callable[[TaskControl], Awaitable[Message]]) -> None:
    async def visit(joined: Client) -> Message:
        try:
            return await command(joined.task)
        finally:
            if joined.task.unsaved:
                echo(f"zencell: {joined.task.unsaved}", err=True)

    at.answer(visit)


@task.command()
def start(override: options.Override = False, at: CellTarget = OF_ARM) -> None:
    """Start the task, or restart it after a stop or its end; releases your own holds of the robot."""
    _task(at, lambda task: task.start(override=override))


@task.command()
def pause(at: CellTarget = OF_ARM) -> None:
    """Stop the robot on its path at once and hold it there."""
    _task(at, lambda task: task.pause())


@task.command()
def resume(override: options.Override = False, at: CellTarget = OF_ARM) -> None:
    """Let the robot continue along its path after your pause."""
    _task(at, lambda task: task.resume(override=override))


@task.command()
def stop(at: CellTarget = OF_ARM) -> None:
    """Stop the robot, abandon its motion, and wait for a start; works also if the task does not answer."""
    _task(at, lambda task: task.stop())


@task.command()
def home(
    planner: Annotated[
        str, typer.Option("--planner", metavar="NAME", help="use only this planner", autocompletion=choices.planners)
    ] = "",
    at: CellTarget = OF_ARM,
) -> None:
    """Move to the home pose while no task uses the robot; Ctrl-C stops the robot."""
    at.answer(lambda cell: cell.arm.move("home", planner=planner))


# --- world ------------------------------------------------------------------------------------------------------


def _position(x: str, y: str) -> dict[str, float]:
    return {"x": options.number("X", x), "y": options.number("Y", y)}


def _triple(option: str, text: str, names: str) -> dict[str, float]:
    """Three numbers separated by commas, or one for all of them, by name."""
    found = options.numbers(option, text)
    if len(found) not in (1, 3):
        raise ConfigError(option, text, "must be three numbers separated by commas, or one")
    return dict(zip(names, found * (3 // len(found)), strict=True))


def _edit(at: CellTarget, values: dict[str, Any]) -> None:
    from common import topics
    from common.config import check
    from common.messages import WorldEdit

    message: WorldEdit = check(WorldEdit, values, "world")
    send(at, topics.WORLD_EDIT, message)


@world.command(context_settings=NEGATIVE_NUMBERS)
def add(
    x: X, y: Y,
    name: Annotated[str, typer.Option("--id", metavar="ID", help="default: a new id")] = "",
    like: Annotated[str, typer.Option(
        "--like", metavar="ID", help="of the first layout; without it and a shape, like the first object there")] = "",
    shape: Annotated[str, typer.Option(
        "--shape", metavar="NAME", help="sphere, box or cylinder; else `zencell call world/edit`")] = "",
    size: Annotated[str, typer.Option(
        "--size", metavar="X,Y,Z", help="of the box about it [m]; one number for all three")] = "",
    color: Annotated[str, typer.Option("--color", metavar="R,G,B", help="0 to 1 each")] = "",
    yaw: Annotated[str, typer.Option("--yaw", metavar="RAD", help="[rad]")] = "",
    at: CellTarget = RUNNING,
) -> None:
    """Add an object to the table."""
    values: dict[str, Any] = {"op": "add", "id": name, "position": _position(x, y), "like": like}
    if shape:
        values["shape"] = shape
    if size:
        values["size"] = _triple("--size", size, "xyz")
    if color:
        values["color"] = _triple("--color", color, "rgb")
    if yaw:
        values["yaw"] = options.number("--yaw", yaw)
    _edit(at, values)


@world.command(context_settings=NEGATIVE_NUMBERS)
def move(name: Id, x: X, y: Y, at: CellTarget = RUNNING) -> None:
    """Move an object to another position."""
    _edit(at, {"op": "move", "id": name, "position": _position(x, y)})


@world.command()
def remove(name: Id, at: CellTarget = RUNNING) -> None:
    """Remove an object."""
    _edit(at, {"op": "remove", "id": name})


@world.command()
def reset(at: CellTarget = RUNNING) -> None:
    """Restore the first layout."""
    _edit(at, {"op": "reset"})


# --- planning scene -----------------------------------------------------------------------------------------------


@scene.command("list")
def list_solids(at: CellTarget = OF_ARM, as_json: options.Json = False) -> None:
    """List the added solids; `zencell topic echo planning_scene` shows all obstacles."""
    from common.messages.schema import to_json

    for solid in at.join(lambda cell: cell.scene.objects()):
        middle, sides = solid.pose.position, " x ".join(f"{side:g}" for side in solid.dimensions)
        echo(to_json(solid.model_dump()) if as_json else
             f"{solid.id}  {solid.shape} {sides} m at {middle.x:g}, {middle.y:g}, {middle.z:g}")


@scene.command("add", context_settings=NEGATIVE_NUMBERS)
def add_solid(
    name: SolidName,
    shape: Annotated[str, typer.Argument(metavar="SHAPE", help="box, sphere or cylinder")],
    size: Annotated[str, typer.Argument(
        metavar="SIZE", help="X,Y,Z of a box; radius of a sphere; radius,length of a cylinder [m]")],
    middle: Annotated[str, typer.Argument(metavar="X,Y,Z", help="its center in world [m]")],
    rpy: Annotated[str, typer.Option("--rpy", metavar="R,P,Y", help="roll, pitch, yaw [rad]")] = "0,0,0",
    color: Annotated[str, typer.Option("--color", metavar="R,G,B", help="0 to 1 each")] = "",
    at: CellTarget = OF_ARM,
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


@scene.command("remove")
def remove_solid(name: SolidName, at: CellTarget = OF_ARM) -> None:
    """Remove a solid by name, also one that another operator added."""
    left = at.join(lambda cell: cell.scene.remove(name))
    echo(f"still added: {', '.join(left) or 'nothing'}")
