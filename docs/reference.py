"""Pages of the reference that are made from the code: command line, messages, Python client."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

import typer
from pydantic import BaseModel

import zencell
from cli.main import app
from common.application import all_topics
from common.client.arm import Arm
from common.client.cell import Cell
from common.client.gripper import Gripper
from common.client.parameters import Parameters
from common.client.scene import Scene, World
from common.client.subscriptions import Camera
from common.client.task import TaskControl
from common.config.tunables import bounds_of
from common.messages import schema
from common.topics import Request

MADE = "Made by `python -m docs.generate`; a test keeps it current."
WIDTH = 90  # of a line of code that can be read without scrolling
PARTS = {  # of the client, as a program gets at each
    "Cell": Cell, "cell.arm": Arm, "cell.gripper": Gripper, "cell.camera()": Camera, "cell.task": TaskControl,
    "cell.param": Parameters, "cell.scene": Scene, "cell.world": World,
}


def words(text: str | None) -> str:
    """A text as one line of a table, in which nothing is taken for markup."""
    return " ".join((text or "").split()).replace("|", "\\|").replace("<", "&lt;")


def code(text: str) -> str:
    """A text as code in a table, in which a bar would be the end of a cell."""
    if "|" in text:
        return f"<code>{words(text).replace(chr(92) + '|', '&#124;')}</code>"
    return f"`{text}`" if text else ""


# --- the command line -------------------------------------------------------------------------------------------------


def commands() -> str:
    """The text of docs/reference/commands.md: every verb with its arguments and options."""
    lines = [
        "# Command line", "",
        f"{MADE} `zencell VERB --help` prints the same.", "",
        "Exit codes: 0 done, 1 it failed, 2 bad input (one line says what, and the choices), 130 Ctrl-C.",
    ]
    root: Any = typer.main.get_command(app)
    for name, verb in verbs_of(root, "zencell"):
        lines += ["", f"## {name}", "", " ".join((verb.help or "").split()), ""]
        lines += ["| | default | |", "|---|---|---|", *map(option_row, shown_parameters(verb))]
    return "\n".join(lines) + "\n"


def verbs_of(group: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Every verb below a group that does something, with its whole name."""
    for part, verb in group.commands.items():
        if hasattr(verb, "commands"):
            yield from verbs_of(verb, f"{name} {part}")
        elif not verb.hidden:
            yield f"{name} {part}", verb


def shown_parameters(verb: Any) -> list[Any]:
    """Arguments and options that `--help` shows."""
    return [parameter for parameter in verb.params if not getattr(parameter, "hidden", False)]


def option_row(parameter: Any) -> str:
    """A row of the table of a verb."""
    if parameter.param_type_name == "argument":
        name = (parameter.metavar or parameter.name.upper()).strip("[]")  # some have one for two
    else:
        name = ", ".join([*parameter.opts, *parameter.secondary_opts])
        if not getattr(parameter, "is_flag", False):
            name += f" {parameter.metavar or parameter.type.name.upper()}"
    default = parameter.default
    unsaid = default in (None, False, (), []) or callable(default)
    told = "required" if parameter.required else "" if unsaid else code(str(default))
    return f"| {code(name)} | {told} | {words(parameter.help)} |"


# --- messages ---------------------------------------------------------------------------------------------------------


def messages() -> str:
    """The text of docs/reference/messages.md: every message that a topic carries, and what is in it."""
    lines = [
        "# Messages", "",
        MADE, "",
        "Each is sent as a msgpack map of these names. Lengths are metres, angles radians, times seconds unless a unit says",
        "otherwise; quaternions are x, y, z, w; a stamp is cell time in ns since the Unix epoch.",
        "`zencell topic info KEY` prints the message of a key with an example; keys: [topics](topics.md).",
    ]
    for model in sorted(models(), key=lambda model: model.__name__):
        lines += ["", f"## {model.__name__}", "", *prose(model), ""]
        fields = [*model.model_fields.items()]
        if fields:
            lines += ["| field | type | default | bounds | |", "|---|---|---|---|---|"]
        for name, info in fields:
            default = info.default if isinstance(info.default, str | int | float | bool) else ""
            told = "required" if info.is_required() else code(f"{default!r}") if default != "" else ""
            lines.append(f"| `{name}` | {code(schema.type_name(info.annotation))} | {told} | {words(bounds_of(info))} | {words(info.description)} |")
    return "\n".join(lines) + "\n"


def models() -> set[type[BaseModel]]:
    """The messages of all topics, and the messages in them."""
    found: set[type[BaseModel]] = set()
    wanted = [
        model for topic in all_topics().values()
        for model in ((topic.message, topic.answer) if isinstance(topic, Request) else (topic.message,))
    ]
    while wanted:
        model = wanted.pop()
        if model not in found:
            found.add(model)
            wanted += [inner for info in model.model_fields.values() for inner in schema.models_in(info.annotation)]
    return found


# --- the Python client ------------------------------------------------------------------------------------------------


def client() -> str:
    """The text of docs/reference/python.md: what `zencell` gives to programs, from its docstrings."""
    lines = [
        "# Python client", "",
        MADE, "",
        "With `from zencell import Cell` what says `await` is awaited,",
        "`from zencell.blocking import Cell` is the same without. What it is for: [client](../client.md).",
    ]
    for name, part in PARTS.items():
        lines += ["", f"## {name}", "", *prose(part)]
        for member, value in members(part):
            if isinstance(value, property):
                lines += entry(f"{name}.{member}", value.fget, "property")
            else:
                called = name if member == "__init__" else f"{name}.{member}"
                lines += entry(called, value, "await" if inspect.iscoroutinefunction(value) else "")
    given = [(name, getattr(zencell, name)) for name in zencell.__all__]
    lines += ["", "## Goals"]
    for name, value in given:
        if inspect.isfunction(value):
            lines += entry(name, value, "")
    lines += ["", "### Plan", "", *prose(zencell.Plan), ""]
    lines += ["## Exceptions", "", "| exception | is a | |", "|---|---|---|"]
    for name, value in given:
        if inspect.isclass(value) and issubclass(value, Exception):
            lines.append(f"| `{name}` | `{value.__bases__[0].__name__}` | {words(inspect.getdoc(value))} |")
    return "\n".join(lines) + "\n"


def members(part: type) -> list[tuple[str, Any]]:
    """What a class offers to programs, in the order in which it is written."""
    found = []
    for name, value in vars(part).items():
        plain = value.__func__ if isinstance(value, classmethod | staticmethod) else value
        public = not name.startswith("_") or (name == "__init__" and part is Cell)
        if public and (inspect.isfunction(plain) or isinstance(plain, property)):
            found.append((name, plain))
    return found


def entry(name: str, function: Any, kind: str) -> list[str]:
    """Heading, signature and docstring of a function."""
    lines = ["", f"### {name}", ""]
    if kind != "property":
        begin = f"{'await ' if kind == 'await' else ''}{name}("
        arguments = [*arguments_of(function)]
        short = f"{begin}{', '.join(arguments)})"
        call = [short] if len(short) <= WIDTH else [begin, *(f"    {each}," for each in arguments), ")"]
        lines += ["```python", *call, "```", ""]
    return [*lines, *prose(function)]


def arguments_of(function: Any) -> Iterator[str]:
    """The arguments of a function as its source has them, without the object that it belongs to."""
    starred = False
    for name, parameter in inspect.signature(function).parameters.items():
        if name in ("self", "cls"):
            continue
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY and not starred:
            starred = True
            yield "*"
        starred = starred or parameter.kind is inspect.Parameter.VAR_POSITIONAL
        told = (parameter.kind.description.startswith("variadic") and str(parameter).split(":")[0]) or name
        if parameter.annotation is not inspect.Parameter.empty:
            told += f": {parameter.annotation}"
        yield told if parameter.default is inspect.Parameter.empty else f"{told} = {parameter.default!r}"


def prose(thing: Any) -> list[str]:
    """A docstring as Markdown: its sections are lists."""
    lines: list[str] = []
    section = False
    for line in (inspect.getdoc(thing) or "").splitlines():
        if heading := re.fullmatch(r"(Args|Returns|Raises|Attributes|Yields):", line):
            section = True
            lines += [f"**{heading[1]}**", ""]
        elif section and (item := re.fullmatch(r"    (\*{0,2}\w+): (.*)", line)):
            lines.append(f"- `{item[1]}`: {item[2]}")
        elif section and line.startswith("    "):
            lines.append(f"  {line.strip()}")
        else:
            section = section and not line
            lines.append(line)
    return lines
