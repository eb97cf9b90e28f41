"""Export a program as a readable Python script, which does the same over the blocking client."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from applications.programming.files import ProgramFile
from applications.programming.handling import Palletize
from applications.programming.model import BaseStep
from applications.programming.steps import Call, If, Loop

COMMON = {"step", "id", "note"}  # of a step, and not written


def script(files: Mapping[str, ProgramFile], main: str, cell: str) -> str:
    """Return the script of a program; `cell` is where it runs if it is given no name of a running cell."""
    bodies = [line for name in reversed(list(files)) for line in _function(files[name], files[main])]
    return "\n".join([
        f'"""{main}.yaml as a script: python {main}.py [NAME of a running cell]."""', "", "import sys", "",
        "from applications.programming.scripted import Steps", "from zencell.blocking import Cell", "",
        f"CELL = {cell!r}", "", *bodies, "", "with Cell(sys.argv[1]) if sys.argv[1:] else Cell.start(CELL) as cell:",
        f"    {_name(main)}(cell)"]) + "\n"


def _function(file: ProgramFile, main: ProgramFile) -> Iterator[str]:
    speed, poses = file.program.speed or main.program.speed, file.program.poses
    yield ""
    yield f"def {_name(file.name)}(cell):"
    if file.program.note:
        yield f"    {file.program.note!r}"
    more = f", speed={speed:g}" if speed is not None else ""
    if poses:
        yield "    poses = {"
        yield from (f"        {name!r}: {_data(target)!r}," for name, target in poses.items())
        yield "    }"
        more += ", poses=poses"
    yield f"    do = Steps(cell, CELL{more})"
    yield from _body(file.program.steps, "    ")
    yield "    return do.outcome"
    yield ""


def _body(steps: Sequence[BaseStep], indent: str) -> Iterator[str]:
    for step in steps:
        if step.note:
            yield f"{indent}# {step.note}"
        yield from (f"{indent}{line}" for line in _lines(step))


def _lines(step: BaseStep) -> Iterator[str]:
    if isinstance(step, Call):
        yield f"do.outcome = {_name(step.program)}(cell)"
    elif isinstance(step, If):
        yield f"if do.met({_arguments(_data(step.condition))}):"
        yield from _body(step.then, "    ")
        if step.otherwise:
            yield "else:"
            yield from _body(step.otherwise, "    ")
    elif isinstance(step, Loop):
        if step.condition is not None:
            yield f"while do.met({_arguments(_data(step.condition))}):"
        else:
            yield "while True:" if step.count is None else f"for _ in range({step.count}):"
        yield from _body(step.steps, "    ")
    else:
        fields = {name: value for name, value in _data(step).items() if name not in COMMON}
        if isinstance(step, Palletize):
            del fields["steps"]
            yield f"for _ in do.palletize({_arguments(fields)}):"
            yield from _body(step.steps, "    ")
        else:
            yield f"do.{step.step}({_arguments(fields)})"


def _data(part: Any) -> Any:
    return part.model_dump(mode="json", exclude_defaults=True)


def _arguments(fields: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value!r}" for name, value in fields.items())


def _name(program: str) -> str:
    name = re.sub(r"\W", "_", program)
    return name if name.isidentifier() else f"program_{name}"
