"""Completions of cells, robots, services, keys and parameters, each with a description.

They are read from syntax trees, so that a completion does not import pydantic: it must answer while a user types."""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator
from pathlib import Path

from cli.model_sources import ROOT, Model, ModelField, fields_of, find_model, is_section, tree_of

LONGEST_DOC = 60  # [characters]

Offer = tuple[str, str]  # a completion and its description


def cells(incomplete: str) -> list[Offer]:
    """Return cells by name, with the first comment of their files."""
    return _starting(incomplete, ((path.stem, _first_comment(path)) for path in _config_files("cells")))


def default_cell() -> str:
    """Return the first cell in alphabetical order."""
    return min((path.stem for path in _config_files("cells")), default="")


def worlds(incomplete: str) -> list[Offer]:
    """Return worlds by name."""
    return _starting(incomplete, ((path.stem, _first_comment(path)) for path in _config_files("worlds")))


def robots(incomplete: str) -> list[Offer]:
    """Return robots by name."""
    return _starting(incomplete, ((path.stem, _first_comment(path)) for path in _config_files("robots")))


def services(incomplete: str) -> list[Offer]:
    """Return the built-in services, with the first line of their docstrings."""
    return _starting(incomplete, ((path.stem, _doc(path)) for path in _modules("services")))


def tasks(incomplete: str) -> list[Offer]:
    """Return the templates of new projects."""
    return _starting(incomplete, ((kind, _doc(ROOT / "examples" / kind / "task.py")) for kind in task_kinds()))


def task_kinds() -> list[str]:
    """Return the examples with a cell file: each is a template of `zencell new`."""
    return sorted(path.parent.name for path in (ROOT / "examples").glob("*/cell.yaml"))


def planners(incomplete: str) -> list[Offer]:
    """Return planners by name."""
    return _starting(incomplete, ((path.stem, _doc(path)) for path in _modules("common/planning/planners")))


def keys(incomplete: str) -> list[Offer]:
    """Return all keys: topics and requests."""
    return _starting(incomplete, ((key, doc) for key, _, doc in _topics()))


def published(incomplete: str) -> list[Offer]:
    """Return the keys of topics."""
    return _starting(incomplete, ((key, doc) for key, kind, doc in _topics() if kind == "Topic"))


def requests(incomplete: str) -> list[Offer]:
    """Return the keys of requests."""
    return _starting(incomplete, ((key, doc) for key, kind, doc in _topics() if kind == "Request"))


def parameters(incomplete: str) -> list[Offer]:
    """Return dotted paths of all parameters, as for `--set` and `param`."""
    return _starting(incomplete, _parameters(incomplete))


def overrides(incomplete: str) -> list[Offer]:
    """Return the same paths, each followed by `=`."""
    return [(f"{path}=", doc) for path, doc in parameters(incomplete)]


def _starting(incomplete: str, offers: Iterator[Offer]) -> list[Offer]:
    return sorted({word: (word, _short(doc)) for word, doc in offers if word.startswith(incomplete)}.values())


def _short(doc: str) -> str:
    """Shorten a description to one line; brackets would be parsed as markup."""
    text = doc.replace("[", "(").replace("]", ")")
    return text if len(text) <= LONGEST_DOC else f"{text[: LONGEST_DOC - 3].rstrip()}..."


# --- files ------------------------------------------------------------------------------------------------------


def _config_files(kind: str) -> list[Path]:
    # Same rule as common.config.config_root, whose import loads pydantic.
    root = Path(os.environ.get("ZENCELL_CONFIG") or ROOT / "config")
    return sorted((root / kind).glob("*.yaml"))


def _first_comment(path: Path) -> str:
    with path.open(encoding="utf-8", errors="replace") as file:
        line = file.readline()
    return line.lstrip("# ").strip() if line.startswith("#") else ""


def _modules(package: str) -> list[Path]:
    return [path for path in sorted((ROOT / package).glob("[a-z]*.py")) if path.stem != "router"]


def _doc(path: Path) -> str:
    return (ast.get_docstring(tree_of(path)) or "").partition("\n")[0]


# --- syntax trees -----------------------------------------------------------------------------------------------


def _topics() -> Iterator[tuple[str, str, str]]:
    """Yield key, Topic or Request, and description from common/topics.py and the applications."""
    files = [ROOT / "common" / "topics.py", *sorted((ROOT / "applications").glob("*/topics.py"))]
    for node in (node for file in files for node in tree_of(file).body):
        match node:
            case ast.Assign(value=ast.Call(func=ast.Name(id="Topic" | "Request" as kind), args=[*arguments])):
                texts = [each.value for each in arguments if isinstance(each, ast.Constant)]
                if texts:
                    yield str(texts[0]), kind, str(texts[-1])


def _parameters(incomplete: str) -> Iterator[Offer]:
    """Yield the parameters; files that cannot match the typed text are not read."""

    def may_follow(prefix: str) -> bool:
        return f"{prefix}.".startswith(incomplete) or incomplete.startswith(f"{prefix}.")

    cell = find_model(ROOT / "common" / "config" / "cell.py", "Cell")
    for field in fields_of(cell) if cell else ():
        if field.model is not None and field.name != "run" and may_follow(field.name):
            yield from _paths(field.model, field.name)
    for path in _modules("services"):
        if not may_follow(f"services.{path.stem}"):
            continue
        config = find_model(path, "Config")
        for field in fields_of(config) if config else ():
            if field.empty:
                yield f"services.{path.stem}.{field.name}", field.description
            elif field.model is None or not is_section(field.model):
                yield from _below(field, f"services.{path.stem}")


def _paths(model: Model, prefix: str) -> Iterator[Offer]:
    for field in fields_of(model):
        yield from _below(field, prefix)


def _below(field: ModelField, prefix: str) -> Iterator[Offer]:
    path = f"{prefix}.{field.name}"
    if field.model is None:
        yield path, field.description
    else:
        yield from _paths(field.model, path)
