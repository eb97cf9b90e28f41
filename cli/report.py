"""A page about a recorded run."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated

import typer

from cli import options
from cli.recording import File
from common.errors import ConfigError
from common.terminal import echo

CANNOT_BE_SHOWN = (ArithmeticError, ValueError, LookupError, TypeError)  # what numbers that no run has lead to


def report(
    file: File,
    output: Annotated[str, typer.Option("-o", "--output", metavar="FILE.html", help="[beside the recording]")] = "",
    cell: Annotated[
        str | None, typer.Option("--cell", metavar="CELL", help="whose robot it was, if the recording's is not here")
    ] = None,
) -> None:
    """Write one page about a recorded run: timeline, plans, latency, joints, what was seen, and what went wrong."""
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
            with warnings.catch_warnings(action="ignore"):  # of numbers that no picture can show
                text = build_report(recording, cell)
        except CANNOT_BE_SHOWN as error:
            raise RecordingError(f"{path}: has values that cannot be shown: {type(error).__name__}: {error}") from error
        if not recording.finished:
            echo(f"zencell: {truncated_note(recording)}", err=True)
    options.write_text(str(page_path), text)
    echo(f"{page_path}: {len(text) / 1e6:.1f} MB")
