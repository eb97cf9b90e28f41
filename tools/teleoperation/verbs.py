"""Commands `zencell teleop` and `zencell demo record`."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from common.errors import ConfigError
from common.terminal import echo, rewrite
from common.verbs import Verbs

if TYPE_CHECKING:
    from common.client.cell import Cell
    from common.config import Cell as CellConfig
    from tools.teleoperation.devices import Device

DEVICES, FRAMES, RESETS, BY = ("keyboard", "gamepad", "spacemouse"), ("base", "tool", "world"), ("home", "hand"), \
    ("operator", "task")
MAX_EPISODES = 100_000

With = Annotated[str, typer.Option("--with", metavar="DEVICE", help=" | ".join(DEVICES))]
DevicePath = Annotated[str | None, typer.Option(
    "--device", metavar="FILE", help="input device, such as /dev/input/event5 [the first that fits]")]
Speed = Annotated[str, typer.Option("--speed", metavar="S", help="share of 0.25 m/s and 1 rad/s, up to 1")]
Frame = Annotated[str, typer.Option("--frame", metavar="NAME", help="axes to move along: base, tool or world")]


def teleop(
    cell: str, device: With = "keyboard", path: DevicePath = None, speed: Speed = "0.2", frame: Frame = "base",
    overrides: list[str] | None = None, world: str | None = None, seed: str | None = None, domain: str | None = None,
    connect: str | None = None,
) -> None:
    """Move the arm of a cell with a keyboard, gamepad or 3D mouse.

    Uses a running cell; else starts it without its task. The arm moves only while a key, the dead-man button or the cap
    is held. Collisions are not checked.
    """
    from tools.teleoperation.operation import Operation

    operation = _operation(device, path, speed, frame)

    async def visit(client: Cell, _: CellConfig) -> None:
        with operation.keys:
            session = Operation(client, **operation.arguments)
            await session.run()
        if session.in_control:
            echo("the task still waits: `zencell teleop` and p twice give control back to it")

    _visit(visit, cell, overrides, world, _whole("--seed", seed, 0), domain, connect, operation.help)


def record(
    cell: str,
    task: Annotated[str, typer.Option("--task", metavar="TEXT", help="what the episodes show, for the data set")] = "",
    episodes: Annotated[str, typer.Option("--episodes", metavar="N", help="how many; discarded ones do not "
                                                                         "count")] = "1",
    by: Annotated[str, typer.Option("--by", metavar="WHO", help="operator; task: the cell's own task, each episode "
                                                                "with the next seed")] = "operator",
    output: Annotated[str | None, typer.Option(
        "-o", "--output", metavar="DIR", help="of the files; one with episodes of this cell is continued [CELL_demos]",
    )] = None,
    reset: Annotated[str, typer.Option("--reset", metavar="HOW", help="after each episode: home, a motion of the arm; "
                                                                      "or by hand")] = "home",
    device: With = "keyboard", path: DevicePath = None, speed: Speed = "0.2", frame: Frame = "base",
    overrides: list[str] | None = None, world: str | None = None, seed: str | None = None, domain: str | None = None,
    connect: str | None = None,
) -> None:
    """Record demonstrations, a file each, for `zencell export DIR --lerobot`; with --by task made by the planner."""
    from common.config import load_cell
    from tools.teleoperation.episodes import EpisodeFolder
    from tools.teleoperation.planner_made import absolute, record_runs

    count = _whole("--episodes", episodes, 1)
    number = _whole("--seed", seed, 0)
    assert count is not None
    if count > MAX_EPISODES:
        raise ConfigError("--episodes", episodes, f"must be at most {MAX_EPISODES:,}")
    _choice("--by", by, BY)
    _choice("--reset", reset, RESETS)
    loaded = load_cell(cell, tuple(overrides or ()), world=world, seed=number)
    text = task or f"run the cell {loaded.name}"
    show = rewrite if sys.stderr.isatty() else lambda _: None
    if by == "operator":
        operation = _operation(device, path, speed, frame)
    folder = EpisodeFolder(absolute(output, loaded.name), loaded.name)
    for name in folder.interrupted():
        echo(f"{name} was interrupted and is no episode; to use it: zencell recover {folder.path / name}", err=True)
    if by == "task":
        options = [part for value in overrides or () for part in ("--set", value)]
        for option, value in (("--world", world), ("--domain", domain), ("--connect", connect)):
            options += [option, value] if value is not None else []
        first = len(folder.manifest.episodes) if number is None else number
        record_runs(cell, options, folder, episodes=count, task=text, first_seed=first, say=echo, show=show)
        _conclude(folder.path)
        return

    async def visit(client: Cell, config: CellConfig) -> None:
        from tools.teleoperation.demonstrating import Demonstrating
        from tools.teleoperation.episodes import EpisodeRecorder

        def say(line: str) -> None:
            show("")
            echo(line)

        recorder = EpisodeRecorder(client.bus, config, folder)
        with operation.keys:
            await Demonstrating(
                client, recorder, folder, episodes=count, task=text, seed=number, reset=reset, say=say,  # type: ignore[arg-type]
                **operation.arguments).run()

    from tools.teleoperation.demonstrating import HELP

    _visit(visit, cell, overrides, world, number, domain, connect, f"{operation.help}\n{HELP}")
    _conclude(folder.path)


def _conclude(folder: Path) -> None:
    from recording.datasets.manifest import read_manifest

    there = read_manifest(folder).episodes
    echo(f"{folder}: {len(there)} episodes, {sum(each.success for each in there)} succeeded; "
         f"next: zencell export {folder} --lerobot DIR")


class _Devices:
    """The chosen device and the terminal, as arguments of an `Operation`."""

    def __init__(self, device: Device, keyboard: Any, arguments: dict[str, Any], help_text: str) -> None:
        from common.time_source import monotonic
        from recording.keyboard import Keys

        devices = [keyboard] if device is keyboard else [device, keyboard]
        self.keys = Keys(lambda key: keyboard.press(key, monotonic()), on_terminal=sys.stdin.isatty())
        self.arguments = {"devices": devices, **arguments}
        self.help = help_text


def _operation(device: str, path: str | None, speed: str, frame: str) -> _Devices:
    """Check the options and open the device.

    Raises:
        ConfigError: names the option, its value and the choices.
    """
    from tools.teleoperation.gamepad import Gamepad
    from tools.teleoperation.keyboard import Keyboard
    from tools.teleoperation.spacemouse import SpaceMouse

    _choice("--with", device, DEVICES)
    _choice("--frame", frame, FRAMES)
    try:
        share = float(speed)
    except ValueError:
        share = float("nan")
    if not 0 < share <= 1:
        raise ConfigError("--speed", speed, "must be more than 0 and at most 1")
    if device == "keyboard":
        if not sys.stdin.isatty():
            raise ConfigError("--with", device, "needs a terminal")
        if path is not None:
            raise ConfigError("--device", path, "is for a gamepad or spacemouse")
    keyboard = Keyboard(moves=device == "keyboard")
    opened: Device = keyboard if device == "keyboard" else \
        Gamepad.open(path) if device == "gamepad" else SpaceMouse.open(path)
    show = rewrite if sys.stderr.isatty() else lambda _: None
    return _Devices(opened, keyboard, {"frame": frame, "speed": share, "show": show}, opened.help)


def _visit(
    visit: Callable[[Cell, CellConfig], Awaitable[None]], cell: str, overrides: list[str] | None, world: str | None,
    seed: int | None, domain: str | None, connect: str | None, help_text: str,
) -> None:
    from common.config import load_cell
    from tools.teleoperation.joining import joined_or_started

    config = load_cell(cell, tuple(overrides or ()), world=world, seed=seed)

    async def work() -> None:
        async with joined_or_started(cell, config, overrides or (), world, seed, domain, connect, echo) as client:
            echo(help_text)
            await visit(client, config)
            await _report_stop(client)

    asyncio.run(work())


async def _report_stop(client: Cell) -> None:
    motion = await client.arm.status()
    if motion.interlocks:
        echo(f"{client.name} is {'; '.join(each.description for each in motion.interlocks)}: "
             "`zencell task start` lets its task continue")


def _choice(option: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ConfigError(option, value, f"choices: {', '.join(choices)}")


def _whole(option: str, text: str | None, least: int) -> int | None:
    if text is None:
        return None
    if not (text.isascii() and text.isdigit() and int(text) >= least):
        raise ConfigError(option, text, f"must be a whole number, {least} or more")
    return int(text)


VERBS = Verbs(commands={"teleop": teleop, "demo record": record},
              groups={"demo": "Record demonstrations for robot learning."})
