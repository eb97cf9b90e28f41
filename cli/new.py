"""`new`: a small project of one's own: a cell, the task that it is for, and their test."""

from __future__ import annotations

import importlib.util
import keyword
import re
from pathlib import Path
from typing import Annotated

import typer

from cli import choices
from cli.model_sources import ROOT
from common.errors import ConfigError, UnknownName
from common.terminal import echo

EXAMPLES = ROOT / "examples"  # each folder with a cell file is a kind of task, and its own template
DEFAULT = "sort_cubes"


def new(
    folder: Annotated[str, typer.Argument(metavar="DIR", help="is made; its name is that of cell and task")],
    task: Annotated[
        str, typer.Option("--task", metavar="KIND", help="what it begins as", autocompletion=choices.tasks)
    ] = DEFAULT,
) -> None:
    """Write a cell, a task in one file and their test into a new folder: they run at once."""
    kinds = choices.task_kinds()
    if task not in kinds:
        raise UnknownName("task", task, kinds)
    to = Path(folder).expanduser().absolute()
    _require_name(folder, to)
    try:
        if to.exists() and (not to.is_dir() or any(to.iterdir())):
            raise ConfigError("DIR", folder, "is there already and not empty: take another, or empty it")
        to.mkdir(parents=True, exist_ok=True)
        for file in sorted(path for path in (EXAMPLES / task).iterdir() if path.is_file()):
            text = file.read_text(encoding="utf-8").replace(task, to.name)
            (to / file.name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError("DIR", folder, f"cannot be written: {error.strerror}") from None
    for line in ("run {}/cell.yaml", "simulate {}/cell.yaml --seeds 1-3"):
        echo(f"zencell {line.format(folder.rstrip('/') or '.')}")
    echo(f"pytest {folder}")


def _require_name(folder: str, to: Path) -> None:
    """Return when the task can be imported as a module of that folder.

    Raises:
        ConfigError: it cannot, and why.
    """
    name = to.name
    if not re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII) or keyword.iskeyword(name):
        raise ConfigError("DIR", folder, "must end in a name that Python can import: letters, digits and _")
    try:
        found = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        found = None
    if found is not None and [Path(place).absolute() for place in found.submodule_search_locations or ()] != [to]:
        raise ConfigError("DIR", folder, f"has the name of a Python module that is there already: {name!r}")
