"""Export a recording for other programs."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli import options
from cli.recording import Exclude, File
from common.errors import ConfigError
from common.terminal import echo, printable
from recording.formatting import format_bytes, require_new

if TYPE_CHECKING:
    from recording.reader import Recording
    from recording.sample import Decoder
    from recording.selection import Selection

PLOT_ERRORS = (ArithmeticError, ValueError, LookupError, TypeError)  # errors from values that no real run contains


def export(
    file: File,
    foxglove: Annotated[
        str | None, typer.Option("--foxglove", metavar="OUT.mcap", help="for Foxglove: JSON with its own schemas")
    ] = None,
    csv: Annotated[str | None, typer.Option("--csv", metavar="DIR", help="a table for each topic")] = None,
    images: Annotated[str | None, typer.Option("--images", metavar="DIR", help="a PNG for each image")] = None,
    video: Annotated[
        str | None, typer.Option("--video", metavar="OUT.mp4", help="video of one topic, named with --topics")
    ] = None,
    topics: Annotated[list[str] | None, typer.Option("--topics", metavar="KEY", help="only these; repeatable")] = None,
    exclude: Exclude = None,
) -> None:
    """Export a recording for other programs: Foxglove, tables, images, a video."""
    from recording.reader import Recording
    from recording.sample import Decoder
    from recording.selection import Selection

    if not (foxglove or csv or images or video):
        raise ConfigError("export", ..., "needs one or more of --foxglove OUT.mcap, --csv DIR, --images DIR, "
                                         "--video OUT.mp4")
    selection = Selection.of(topics or (), None, exclude)
    if foxglove:
        require_new(Path(foxglove), "--foxglove")
    for option, folder in (("--csv", csv), ("--images", images)):
        if folder and Path(folder).exists() and not Path(folder).is_dir():
            raise ConfigError(option, folder, "must be a folder")
    if video:
        require_new(Path(video), "--video", ".mp4")
    decoder = Decoder()
    with Recording(Path(file)) as recording:
        selection.require_in(recording.topics(), recording.path, "--topics")
        if foxglove:
            _foxglove(recording, Path(foxglove), selection, decoder)
        if csv:
            _tables(recording, Path(csv), selection, decoder)
        if images:
            _images(recording, Path(images), selection, decoder)
        if video:
            _video(recording, Path(video), selection, decoder)
    for topic, count in sorted(decoder.skipped.items()):
        echo(f"{printable(topic)}: {count} messages left out: this version does not know their type", err=True)


def _foxglove(recording: Recording, target: Path, selection: Selection, decoder: Decoder) -> None:
    from recording.foxglove import export_foxglove

    count = export_foxglove(recording, target, selection.wants, decoder)
    echo(f"{target}: {count:,} messages, {format_bytes(target.stat().st_size)}, for Foxglove")


def _tables(recording: Recording, folder: Path, selection: Selection, decoder: Decoder) -> None:
    from recording.export import export_tables

    for name, count in export_tables(recording, folder, selection.wants, decoder).items():
        echo(f"{folder / name}: {count:,} rows")


def _images(recording: Recording, folder: Path, selection: Selection, decoder: Decoder) -> None:
    from recording.export import export_images, file_names, image_topics

    if not image_topics(recording, selection.wants):
        raise ConfigError("--images", str(recording.path), "has no images among the selected topics")
    names = file_names(image_topics(recording, selection.wants))
    for topic, count in export_images(recording, folder, selection.wants, decoder).items():
        echo(f"{folder / names[topic]}: {count:,} images")


def _video(recording: Recording, target: Path, selection: Selection, decoder: Decoder) -> None:
    from recording.export import export_video, image_topics

    choices = image_topics(recording, selection.wants)
    if len(choices) != 1:
        named = ", ".join(choices) or "none"
        raise ConfigError("--video", str(target), f"needs one topic with images, by --topics KEY; choices: {named}")
    count, rate = export_video(recording, target, choices[0], decoder)
    echo(f"{target}: {count:,} images of {choices[0]} at {rate:g} Hz")


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
    with Recording(path) as recording:
        try:
            with warnings.catch_warnings(action="ignore"):  # about values that a plot cannot show
                text = build_report(recording, cell)
        except PLOT_ERRORS as error:
            raise RecordingError(f"{path}: has values that cannot be shown: {type(error).__name__}: {error}") from error
        if not recording.finished:
            echo(f"zencell: {truncated_note(recording)}", err=True)
    options.write_text(str(page_path), text)
    echo(f"{page_path}: {len(text) / 1e6:.1f} MB")
