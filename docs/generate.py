"""Writes the pages and tables of docs/ that are made from the code; with --check, tells whether they are current.

Run as `python -m docs.generate [--check]` from the project's folder.
"""

from __future__ import annotations

import asyncio
import importlib
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from common import config as c
from common import topics
from common.application import all_topics
from common.config.tunables import bounds_of, is_tunable
from common.planning.planners import load_planner
from common.supervision.wiring import owned_in, wiring, wiring_of
from docs import reference
from docs.seed_parameters import CAMERA, CONTROLLER, VALIDATOR, SeedParameter

DOCS = Path(__file__).resolve().parent


def first_line(text: str | None) -> str:
    """The first line of a docstring."""
    return (text or "").strip().splitlines()[0] if text else ""


def shown(value: object) -> str:
    """A value, short enough for a table."""
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def rows_of(model: type[BaseModel], prefix: str, values: BaseModel | None = None) -> list[str]:
    """A table row for each parameter of a model, nested ones with a dotted path; sections are left out."""
    rows = []
    for name, info in model.model_fields.items():
        annotation = info.annotation
        value = getattr(values, name, None) if values is not None else info.get_default(call_default_factory=True)
        if isinstance(annotation, type) and issubclass(annotation, c.Section) and issubclass(model, c.Parameters):
            continue
        if isinstance(value, BaseModel):
            rows += rows_of(type(value), f"{prefix}.{name}", value)
            continue
        live = "yes" if is_tunable(info) else ""
        rows.append(f"| `{prefix}.{name}` | {shown(value)} | {bounds_of(info)} | {live} | {info.description or ''} |")
    return rows


def lookup(cell: c.Cell, path: str) -> object:
    """The value that a dotted path of the seed tables has in the cell."""
    head, *rest = path.split(".")
    if head == "services":
        config: Any = importlib.import_module(f"services.{rest[0]}").Config
        return c.service_config(cell, rest[0], config).model_dump()[rest[1]]
    if head == "pipeline":
        entry = next(p for p in cell.pipeline.planners if p.name == rest[0])
        return load_planner(entry.name, entry.options)[1].model_dump()[rest[1]]
    value: Any = getattr(cell, head)
    for part in rest:
        value = getattr(value, part)
    return value


def seed_table(cell: c.Cell, rows: list[SeedParameter]) -> list[str]:
    """The table of one of the seed's files."""
    lines = ["| seed parameter | seed value | frame | ours | became | what changes when you touch it |",
             "|---|---|---|---|---|---|"]
    for row in rows:
        ours = "<br>".join(f"`{path}` = {shown(lookup(cell, path))}" for path in row.ours)
        frame = f"{row.frame} to panda_hand_tcp" if row.became == "re-framed" else row.frame
        lines.append(f"| {row.name} | {row.value} | {frame} | {ours} | {row.became} | {row.effect} |")
    return lines


def parameters() -> str:
    """The text of docs/parameters.md."""
    cell = c.load_cell("panda")
    head = ["| parameter | default | bounds | at run time | meaning |", "|---|---|---|---|---|"]
    lines = [
        "# Parameters", "",
        "Made by `python -m docs.generate`; a test keeps it current. Every value can be set in the cell file or with",
        "`--set PATH=VALUE`, for example `--set world.count=5 --set services.camera_simulator.noise_std=8`.",
        "What says *yes* under *at run time* can also be changed while the cell is up, with",
        "`zencell param set PATH=VALUE`; the rest needs a restart.", "",
        "## The seed's numbers and ours", "",
        "The seed's controller declares 28 parameters; its document names 25 (some in pairs), and gives three more numbers",
        "in its text, marked so. *Kept*: same number, same meaning. *Re-framed*: same meaning, for the tool centre point",
        "between the finger tips instead of panda_link8, which lies 0.1034 m above it. *Replaced*: as the last column says.",
        "", "### Controller", "", *seed_table(cell, CONTROLLER), "", "### Workspace validator", "",
        *seed_table(cell, VALIDATOR), "", "### Camera and detector", "", *seed_table(cell, CAMERA), "", "## The cell", "",
        *head, *rows_of(c.Motion, "motion", cell.motion), *rows_of(c.Grasp, "grasp", cell.grasp),
        *rows_of(c.World, "world", cell.world), *rows_of(c.RobotConfig, "robot", cell.robot),
        *rows_of(c.Watchdogs, "watchdogs", cell.watchdogs),
        f"| `pipeline.validation_step` | {cell.pipeline.validation_step:g} | > 0, <= 0.2 | yes | "
        f"{c.Pipeline.model_fields['validation_step'].description} |", "",
        "## Planners", "", "Set in the pipeline file, under `options` of the planner.", "", *head,
    ]
    for entry in cell.pipeline.planners:
        options = load_planner(entry.name, entry.options)[1]
        lines += rows_of(type(options), entry.name, options)
    lines += ["", "## Services", "", *head]
    for name in c.service_names():
        config = getattr(importlib.import_module(f"services.{name}"), "Config", None)
        if config is not None:
            lines += rows_of(config, f"services.{name}")
    return "\n".join(lines) + "\n"


def writers() -> dict[str, str]:
    """By key, who writes or serves it in the cells that come with the project."""
    shared = {topic.key: "everyone" for topic in (topics.LOG, topics.COUNTERS, topics.PARAMETERS)}
    found: dict[str, dict[str, None]] = {}
    for name in c.names_of("cells"):
        cell = c.load_cell(name, ["services.viewer.port=0"])  # it listens while it is looked at
        wirings = {entry.name: asyncio.run(wiring_of(cell, entry)) for entry in cell.services.values()}
        for key, (_, services) in owned_in(wirings).items():
            found.setdefault(key, {}).update(dict.fromkeys(services))
    return {**{key: ", ".join(services) for key, services in found.items()}, **shared,
            topics.SUPERVISOR_STATUS.key: "supervisor", topics.MOTION_JOG.key: "who jogs"}


def topic_table() -> str:
    """All topics, of all cells."""
    written_by = writers()
    lines = ["| key, after the cell | message | kind | written or served by | |", "|---|---|---|---|---|"]
    for topic in all_topics().values():
        message = topic.message.__name__
        if isinstance(topic, topics.Request):
            message = f"{message} → {topic.answer.__name__}"
        lines.append(f"| `{topic.key}` | {message} | {topic.kind} | {written_by[topic.key]} | {topic.doc} |")
    return "\n".join(lines)


def service_table(cell_name: str) -> str:
    """The services of a cell in start order, with what each reads, writes, serves and asks."""
    cell = c.load_cell(cell_name, ["services.viewer.port=0"])  # it listens while it is looked at
    lines = ["| | service | what it does | reads | writes | serves | asks |", "|---|---|---|---|---|---|---|"]
    for number, name in enumerate(cell.services, 1):
        module = importlib.import_module(f"services.{name}")
        wired = asyncio.run(wiring(module.run, c.service_config(cell, name, module.Config)))
        keys = [", ".join(sorted({f"`{shown_key(t)}`" for t in side if not t.signed}))
                for side in (wired.reads, wired.writes, wired.serves, wired.calls)]
        lines.append(f"| {number} | {name} | {first_line(module.__doc__)} | {' | '.join(keys)} |")
    return "\n".join(lines)


def shown_key(topic: topics.AnyTopic) -> str:
    """The key of a topic; one for the parameters of all services."""
    return topics.PARAMETERS.key if topic.key.startswith("param/") else topic.key


TABLES: dict[str, dict[str, Callable[[], str]]] = {  # by page, the tables in it and what makes each
    "reference/services.md": {"services": lambda: service_table("panda"), "ur5": lambda: service_table("ur5")},
    "reference/topics.md": {"topics": topic_table},
}
PAGES: dict[str, Callable[[], str]] = {
    "parameters.md": parameters, "reference/commands.md": reference.commands,
    "reference/messages.md": reference.messages, "reference/python.md": reference.client,
}


def made(page: str) -> str:
    """The text of a page of docs/: all of it is made, or its tables are made anew between their markers."""
    if page in PAGES:
        return PAGES[page]()
    text = (DOCS / page).read_text(encoding="utf-8")
    for name, table in TABLES[page].items():
        pattern = re.compile(rf"(<!-- {name}: made by docs/generate.py -->\n).*?(\n<!-- end of {name} -->)", re.DOTALL)
        if not pattern.search(text):
            raise SystemExit(f"docs/{page} has no place for the table of {name}")
        rows = table()
        text = pattern.sub(lambda match, rows=rows: f"{match[1]}{rows}{match[2]}", text)
    return text


def main() -> int:
    """Write what is not current, or say that it is not."""
    files = {DOCS / page: made(page) for page in [*PAGES, *TABLES]}
    old = [path for path, text in files.items() if not path.exists() or path.read_text(encoding="utf-8") != text]
    if "--check" in sys.argv:
        for path in old:
            sys.stderr.write(f"docs/{path.relative_to(DOCS)} is not current: run `make docs`\n")
        return 1 if old else 0
    for path in old:
        path.write_text(files[path], encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
