"""Recordings: record, show the contents, recover, play, export, report."""

from __future__ import annotations

import asyncio
import json
import sys
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli import choices, options
from cli.options import RUNNING, CellTarget
from common.errors import ConfigError
from common.terminal import Progress, echo, rewrite
from recording.formatting import cell_to_play, format_contents, format_recovery, require_new

if TYPE_CHECKING:
    from recording.player import Player


MIN_FILE_SIZE = 1.0  # [MB] of a recording that is split

File = Annotated[str, typer.Argument(metavar="FILE.mcap", help="a recording")]
Keys = Annotated[
    list[str] | None, typer.Argument(metavar="KEY", help="without the cell; * and ** as wildcards",
                                     autocompletion=choices.published)
]
Exclude = Annotated[str | None, typer.Option("--exclude", metavar="RE", help="leave out keys that match RE")]


def record_(
    keys: Keys = None,
    regex: Annotated[str | None, typer.Option("--regex", metavar="RE", help="only keys that match RE")] = None,
    exclude: Exclude = None,
    output: Annotated[str | None, typer.Option("-o", "--output", metavar="FILE.mcap", help="[CELL_TIME.mcap]")] = None,
    duration: Annotated[str | None, typer.Option("--duration", metavar="S", help="stop after this duration "
                                                                                 "[s]")] = None,
    max_size: Annotated[
        str | None, typer.Option("--max-size", metavar="MB", help="split into FILE_1.mcap, ... at this size")
    ] = None,
    at: CellTarget = RUNNING,
    gate: Annotated[bool, typer.Option("--gate", hidden=True, help="under a supervisor: wait for a line")] = False,
    own: Annotated[str, typer.Option("--own", hidden=True, help="under a supervisor: custom topics of the cell")] = "",
) -> None:
    """Record the messages of a cell until Ctrl-C: the given keys, or all."""
    from common.config import load_cell
    from common.transport.credentials import observer_identity
    from recording.capture import CustomTopics
    from recording.recorder import RecordRequest, record, record_gated, require_published
    from recording.selection import Selection

    custom, cell = CustomTopics.read(own) if own else CustomTopics(), at.cell
    if cell is not None and cell.endswith((".yaml", ".yml")):
        loaded = load_cell(cell)
        cell, custom = loaded.name, CustomTopics.of(loaded)
    selection = Selection.of(keys or (), regex, exclude)
    require_published(selection)
    seconds = _positive("--duration", duration)
    megabytes = _positive("--max-size", max_size)
    if megabytes is not None and megabytes < MIN_FILE_SIZE:
        raise ConfigError("--max-size", max_size, f"must be {MIN_FILE_SIZE:g} or more")
    if output:
        require_new(Path(output))
    request = RecordRequest(
        selection, Path(output) if output else None, None if megabytes is None else round(megabytes * 1e6), seconds,
        gate, custom)
    show = rewrite if sys.stderr.isatty() else None
    if gate:
        asyncio.run(record_gated(request, cell, at.domain, at.connect, echo, show))
    else:
        replace(at, cell=cell).visit(lambda bus: record(bus, request, echo, show), identity=observer_identity())


def _positive(option: str, text: str | None) -> float | None:
    if text is None:
        return None
    value = options.number(option, text)
    if value <= 0:
        raise ConfigError(option, text, "must be more than 0")
    return value


def info(file: File, as_json: options.Json = False) -> None:
    """Show the contents of a recording: type, count, rate and size of each topic, duration, lost messages."""
    from recording.reader import Recording
    from recording.summary import summarise

    with Progress(f"reading {file}") as read, Recording(Path(file), read) as recording:
        summary = summarise(recording)
    if as_json:
        echo(json.dumps(summary.as_dict()))
        return
    for line in format_contents(file, recording.cell, summary):
        echo(line)


def recover(
    file: File,
    output: Annotated[
        str | None, typer.Option("-o", "--output", metavar="FILE.mcap", help="[FILE_recovered.mcap]")
    ] = None,
) -> None:
    """Write a complete file from a truncated or damaged recording: every intact chunk, also those behind a hole."""
    from recording.reader import recover as recover_file

    source = Path(file)
    target = Path(output) if output else source.with_name(f"{source.stem}_recovered.mcap")
    require_new(target)
    with Progress(f"reading {file}") as read:
        saved = recover_file(source, target, read)
    echo(format_recovery(saved, target))


MAX_RATE = 1000.0


def play_(
    file: File,
    keys: Annotated[list[str] | None, typer.Argument(metavar="KEY", help="only these; * and ** as wildcards")] = None,
    topics: Annotated[
        list[str] | None, typer.Option("--topics", metavar="KEY", help="only these: the same as naming them after FILE")
    ] = None,
    exclude: Exclude = None,
    remap: Annotated[
        list[str] | None, typer.Option("--remap", metavar="FROM:=TO", help="publish under another key; repeatable")
    ] = None,
    rate: Annotated[str, typer.Option("--rate", metavar="X", help="speed factor")] = "1",
    loop: Annotated[bool, typer.Option("--loop", help="repeat until Ctrl-C")] = False,
    start_offset: Annotated[str, typer.Option("--start-offset", metavar="S", help="start at this time of the "
                                                                                  "recording [s]")] = "0",
    start_paused: Annotated[bool, typer.Option("--start-paused", help="wait for space at the start")] = False,
    stamp_now: Annotated[
        bool, typer.Option("--stamp-now", help="shift stamps to the present [stamps as recorded]")
    ] = False,
    into_live: Annotated[
        list[str] | None, typer.Option("--into-live", metavar="KEY", help="publish commands of this key although a "
                                       "cell is up, after a confirmation on the terminal; repeatable")
    ] = None,
    wait: Annotated[
        list[str] | None, typer.Option("--wait", metavar="SERVICE", help="start once this service is ready; repeatable")
    ] = None,
    cell: Annotated[str | None, typer.Option("--cell", metavar="NAME", help="play as this cell")] = None,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Publish the messages of a recording with their timing; start a router if none is running.

    On a terminal space pauses, right steps one message, down one image, left goes back 5 s, q quits.
    """
    from common.transport.credentials import require_open_cell
    from recording.player import play, played_topics, renaming
    from recording.reader import Recording
    from recording.selection import Selection

    require_open_cell("play")
    selection = Selection.of([*(keys or ()), *(topics or ())], None, exclude)
    renamed = renaming(remap or [])
    speed, offset = options.number("--rate", rate), options.number("--start-offset", start_offset)
    if not 0 < speed <= MAX_RATE:
        raise ConfigError("--rate", rate, f"must be more than 0 and at most {MAX_RATE:g}")
    on_terminal = sys.stdin.isatty() and sys.stderr.isatty()
    if start_paused and not on_terminal:
        raise ConfigError("--start-paused", ..., "needs a terminal, where space continues; --wait SERVICE needs none")
    with Progress(f"reading {file}") as read, Recording(Path(file), read) as recording:
        if not 0 <= offset <= recording.seconds:
            raise ConfigError("--start-offset", start_offset, f"must be 0 to {recording.seconds:.1f}, its length [s]")
        played = played_topics(recording, selection)
        if loop and recording.seconds == 0:
            raise ConfigError("--loop", ..., f"needs a recording with a length, but {file} has none")

        def create() -> Player:
            from recording.player import Player

            return Player(recording, selection.wants, renamed, rate=speed, offset=offset, loop=loop,
                          paused=start_paused, stamp_now=stamp_now, into_live=into_live or ())

        name, show = cell_to_play(recording.cell, file, cell), rewrite if on_terminal else None
        messages = {renamed(topic): message for topic, (message, _) in played.items()}
        _confirm_commands(into_live or [], messages, name, on_terminal)
        code = asyncio.run(play(create, recording, played, name, wait or [], domain, connect, echo, show))
    raise typer.Exit(code)


def _confirm_commands(into_live: list[str], played: Mapping[str, str], cell: str, on_terminal: bool) -> None:
    """Ask whether commands of these keys may reach a cell.

    Raises:
        ConfigError: they are not commands that are played, or the operator did not confirm them.
    """
    from recording.player import is_command

    for key in into_live:
        if key not in played or not is_command(key, played[key]):
            commands = ", ".join(each for each, message in played.items() if is_command(each, message)) or "none"
            raise ConfigError("--into-live", key, f"is no command that is played; played commands: {commands}")
        if not on_terminal:
            raise ConfigError("--into-live", key, "needs a terminal, to confirm that the cell may move")
        if typer.prompt(f"{key} moves the robot of {cell} as recorded. To confirm, type {cell}") != cell:
            raise ConfigError("--into-live", key, "was not confirmed")


PLOT_ERRORS = (ArithmeticError, ValueError, LookupError, TypeError)  # errors from values that no real run contains


def export(
    files: Annotated[list[str], typer.Argument(
        metavar="FILE.mcap", help="recordings, or a folder of `zencell demo record`")],
    foxglove: Annotated[
        str | None, typer.Option("--foxglove", metavar="OUT.mcap", help="for Foxglove: JSON with its own schemas")
    ] = None,
    csv: Annotated[str | None, typer.Option("--csv", metavar="DIR", help="a table for each topic")] = None,
    images: Annotated[str | None, typer.Option("--images", metavar="DIR", help="a PNG for each image")] = None,
    video: Annotated[
        str | None, typer.Option("--video", metavar="OUT.mp4", help="video of one topic, named with --topics")
    ] = None,
    lerobot: Annotated[
        str | None, typer.Option("--lerobot", metavar="DIR", help="LeRobotDataset v3.0, an episode for each recording")
    ] = None,
    hdf5: Annotated[
        str | None, typer.Option("--hdf5", metavar="OUT.hdf5", help="robomimic's layout, a demo for each recording")
    ] = None,
    parquet: Annotated[str | None, typer.Option("--parquet", metavar="DIR", help="typed tables of topics")] = None,
    numpy: Annotated[str | None, typer.Option("--numpy", metavar="DIR", help="arrays for each topic")] = None,
    topics: Annotated[list[str] | None, typer.Option("--topics", metavar="KEY", help="only these; repeatable")] = None,
    exclude: Exclude = None,
    fps: Annotated[str | None, typer.Option("--fps", metavar="N", help="frames per second of --lerobot and --hdf5 "
                                                                       "[rate of the camera]")] = None,
    task: Annotated[
        list[str] | None, typer.Option("--task", metavar="TEXT", help="of all episodes, or one for each recording")
    ] = None,
    robot_type: Annotated[
        str | None, typer.Option("--robot-type", metavar="NAME", help="of --lerobot [name of the cell]")
    ] = None,
    max_gap: Annotated[
        str | None, typer.Option("--max-gap", metavar="S", help="longest gap that frames are filled over [0.5]")
    ] = None,
    actions: Annotated[str | None, typer.Option("--actions", metavar="WHAT", help="set-points or next-state "
                                                "[set-points if they are recorded]")] = None,
    failures: Annotated[bool, typer.Option("--failures", help="also failed episodes of a folder")] = False,
    embed_images: Annotated[
        bool, typer.Option("--embed-images", help="PNG in the files of --lerobot instead of video")
    ] = False,
) -> None:
    """Export recordings for other programs: Foxglove, tables, images, a video, data sets for robot learning."""
    from recording import exporting
    from recording.datasets.command import DatasetOptions
    from recording.selection import Selection

    targets = {"--foxglove": foxglove, "--csv": csv, "--images": images, "--video": video, "--lerobot": lerobot,
               "--hdf5": hdf5, "--parquet": parquet, "--numpy": numpy}
    exporting.export(exporting.ExportRequest(
        files, {option: target for option, target in targets.items() if target},
        Selection.of(topics or (), None, exclude),
        DatasetOptions(fps, task or (), robot_type, embed_images, max_gap, actions), failures))


def report(
    file: File,
    output: Annotated[str, typer.Option("-o", "--output", metavar="FILE.html", help="[next to the recording]")] = "",
    cell: Annotated[
        str | None, typer.Option("--cell", metavar="CELL", help="cell with the robot [the cell of the recording]")
    ] = None,
) -> None:
    """Write an HTML report of a recorded run: timeline, plans, latency, joints, detections and failures."""
    from recording.reader import Recording
    from recording.report.build import build_report, truncated_note
    from recording.sample import RecordingError

    path = Path(file)
    page_path = Path(output).expanduser() if output else path.with_suffix(".html")
    if page_path.suffix not in (".html", ".htm"):
        raise ConfigError("--output", output, "must end in .html")
    if not page_path.absolute().parent.is_dir():
        raise ConfigError("--output", output, "cannot be written: the folder does not exist")
    with Progress(f"reading {path}") as read, Recording(path, read) as recording:
        try:
            with warnings.catch_warnings(action="ignore"):  # about values that a plot cannot show
                text = build_report(recording, cell)
        except PLOT_ERRORS as error:
            raise RecordingError(f"{path}: has values that cannot be shown: {type(error).__name__}: {error}") from error
        if not recording.finished:
            echo(f"zencell: {truncated_note(recording)}", err=True)
    options.write_text(str(page_path), text)
    echo(f"{page_path}: {len(text) / 1e6:.1f} MB")
