"""Program files: reading with errors that name file, line, step and field; writing; ids of steps."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from applications.programming import handling  # noqa: F401 its kinds of steps are registered
from applications.programming.model import BaseStep, Program, as_data, walk
from applications.programming.steps import Call
from common.atomic_file import write_atomically
from common.config import parse_yaml
from common.errors import ConfigError, UnknownName, ZencellError, expected_text

SUFFIX = ".yaml"
MAX_BYTES = 1_000_000


class BadProgram(ZencellError):
    """Everything that is wrong with a program, one line for each problem."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


@dataclass(frozen=True)
class ProgramFile:
    """A program, the file that it is from, and the lines of its steps there by their id."""

    name: str
    path: Path
    program: Program
    lines: dict[str, int] = field(default_factory=dict)

    @cached_property
    def steps(self) -> dict[str, BaseStep]:
        """All steps by their id, in the order of the file."""
        return {step.id: step for _, step in walk(self.program.steps)}

    def where(self, step: BaseStep) -> str:
        """Return file, line and step in words, for messages."""
        line = self.lines.get(step.id)
        return f"{self.path.name}{f':{line}' if line else ''}: {step.id}"


def names_in(folder: Path) -> list[str]:
    """Return the names of the programs of a folder."""
    return sorted(path.stem for path in folder.glob(f"*{SUFFIX}")) if folder.is_dir() else []


def path_of(folder: str | Path, program: str) -> Path:
    """Return the absolute path of a program: of a name in the folder, or of a path that ends in .yaml."""
    path = Path(program) if program.endswith(SUFFIX) else Path(folder) / f"{program}{SUFFIX}"
    return path.expanduser().resolve()


def revision_of(path: Path) -> str:
    """Return what changes with each change of a file; empty without a file. Raises OSError."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    except FileNotFoundError:
        return ""


def load_program(path: Path) -> ProgramFile:
    """Return the program of a file. Raises BadProgram and ConfigError."""
    try:
        text = path.read_bytes()[:MAX_BYTES].decode()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError("program", str(path), f"cannot be read: {getattr(error, 'strerror', '') or error}") from None
    return parse_program(text, path)


def parse_program(text: str, path: Path) -> ProgramFile:
    """Return the program of a text that is, or will be, in a file; the errors are those of `load_program`."""
    try:
        tree = parse_yaml(text)
    except (yaml.YAMLError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or str(error)
        raise BadProgram([f"{path}{f':{mark.line + 1}' if mark else ''}: does not parse: {problem}"]) from None
    lines = dict(_lines(yaml.compose(text)))
    if not isinstance(tree, dict):
        raise BadProgram([f"{path}: must hold a mapping with steps"])
    try:
        program = Program.model_validate(tree)
    except ValidationError as error:
        raise BadProgram(_problems(path, lines, error.errors(include_url=False))) from None
    first: dict[str, int] = {}  # lines of ids
    for place, step in walk(program.steps):
        line = lines.get(place, 0)
        if step.id in first:
            raise BadProgram([f"{path}:{line}: {place}.id: {step.id!r} is also the id of the step in line "
                              f"{first[step.id]}; each needs its own"])
        if step.id:
            first[step.id] = line
    program = with_ids(program)
    found = {step.id: lines[place] for place, step in walk(program.steps) if place in lines}
    return ProgramFile(path.stem, path, program, found)


def save_program(file: ProgramFile) -> None:
    """Write a program to its file, completely or not at all. Raises OSError."""
    write_atomically(file.path, text_of(file.program))


def text_of(program: Program) -> str:
    """Return a program as YAML, with one line for each simple step."""
    return "\n".join(_yaml(as_data(program), "")) + "\n"


def with_ids(program: Program) -> Program:
    """Return the program with an id for each step that has none: its kind and a number."""
    used = {step.id for _, step in walk(program.steps)}

    def named(step: BaseStep) -> BaseStep:
        changed: dict[str, Any] = {name: [named(each) for each in getattr(step, name)] for name in step.BODIES}
        return step.model_copy(update={**changed, "id": step.id or new_id(step.step, used)})

    return program.model_copy(update={"steps": [named(step) for step in program.steps]})


def new_id(kind: str, used: set[str]) -> str:
    """Return the next free id for a step of a kind, and mark it as used."""
    found = next(id_ for number in count(1) if (id_ := f"{kind}{number}") not in used)
    used.add(found)
    return found


def load_all(file: ProgramFile) -> dict[str, ProgramFile]:
    """Return a program and all programs that it calls, by name. Raises BadProgram and ConfigError."""
    found: dict[str, ProgramFile] = {}

    def visit(one: ProgramFile, above: tuple[str, ...]) -> None:
        found[one.name] = one
        for place, step in walk(one.program.steps):
            if not isinstance(step, Call):
                continue
            where = f"{one.path}:{one.lines.get(step.id, 0)}: {place}.program ({step.id})"
            if step.program in (*above, one.name):
                raise BadProgram([f"{where}: {step.program!r} calls itself: {' > '.join((*above, one.name))} > "
                                  f"{step.program}"])
            path = one.path.with_name(f"{step.program}{SUFFIX}")
            if not path.is_file():
                raise BadProgram([f"{where}: {UnknownName('program', step.program, names_in(one.path.parent))}"])
            visit(found.get(step.program) or load_program(path), (*above, one.name))

    visit(file, ())
    return found


def _lines(node: yaml.Node | None, place: str = "") -> Iterator[tuple[str, int]]:
    """Yield the line of each value of a document by its path, such as `steps[0].to`."""
    if node is None:
        return
    if place:
        yield place, node.start_mark.line + 1
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield from _lines(value, f"{place}.{key.value}".lstrip("."))
    elif isinstance(node, yaml.SequenceNode):
        for number, value in enumerate(node.value):
            yield from _lines(value, f"{place}[{number}]")


def _problems(path: Path, lines: Mapping[str, int], errors: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return validation errors in lines with file, line, path of the field, value and choices; one for each field."""
    by_place: dict[str, list[Mapping[str, Any]]] = {}
    for error in errors:
        place = ""
        for part in error["loc"]:
            if isinstance(part, int):
                place += f"[{part}]"
            elif "-" not in part and not part.endswith("]"):  # not a branch of a union, such as constrained-float
                place = " ".join(f"{place}.{part}".lstrip(".").split())  # a key may contain line breaks
        by_place.setdefault(place, []).append(error)
    return [_problem(path, lines, place, found[0], ", or ".join(map(expected_text, found)))
            for place, found in by_place.items()]


def _problem(path: Path, lines: Mapping[str, int], place: str, error: Mapping[str, Any], text: str) -> str:
    known = place
    while known and known not in lines:
        known = known[: max(known.rfind("."), known.rfind("["), 0)]
    where = f"{path}:{lines[known]}" if known else str(path)
    if error["type"] == "missing":
        return f"{where}: {place}: is missing"
    if error["type"] == "value_error":
        return f"{where}: {place or 'program'}: {text}"
    return f"{where}: {ConfigError(place, error['input'], text)}"


_BODIES = ("steps", "then", "else")


def _yaml(value: Any, indent: str) -> Iterator[str]:
    """Yield the lines of a mapping: nested steps are lists, all else is in flow style."""
    for name, each in value.items():
        if name in _BODIES or name == "poses":
            yield f"{indent}{name}:"
            items = each.items() if isinstance(each, dict) else enumerate(each)
            for key, item in items:
                if isinstance(each, dict):
                    yield f"{indent}  {flow_text(key)}: {flow_text(item)}"
                elif any(body in item for body in _BODIES):
                    first, *rest = _yaml(item, f"{indent}    ")
                    yield f"{indent}  - {first.strip()}"
                    yield from rest
                else:
                    yield f"{indent}  - {flow_text(item)}"
        else:
            yield f"{indent}{name}: {flow_text(each)}"


def flow_text(value: Any) -> str:
    """Return a value as YAML on one line."""
    text: str = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=10**9, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...")
