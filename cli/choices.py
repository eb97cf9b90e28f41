"""Shell completion: scripts of the shells, and choices of cells, services, keys and parameters with descriptions.

They are read from syntax trees, so that a completion does not import pydantic: it must answer while a user types.
"""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer

from common.errors import UnknownName

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Model:
    """A class, and the file that defines the scope of its names."""

    path: Path
    node: ast.ClassDef


@dataclass(frozen=True)
class ModelField:
    """A field; `model` is its type if that is a model too; `empty` says that the default is None."""

    name: str
    description: str
    model: Model | None
    empty: bool


@cache
def tree_of(path: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


@cache
def find_model(path: Path, name: str) -> Model | None:
    """Return the class of a name in a file, following imports; None if it is not part of the project."""
    for node in tree_of(path).body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return Model(path, node)
        if isinstance(node, ast.ImportFrom) and name in [alias.asname or alias.name for alias in node.names]:
            source = _file_of(node.module or "")
            return find_model(source, name) if source else None
    return None


def _file_of(module: str) -> Path | None:
    base = ROOT.joinpath(*module.split("."))
    for path in (base.with_suffix(".py"), base / "__init__.py"):
        if path.is_file():
            return path
    return None


def fields_of(model: Model) -> Iterator[ModelField]:
    """Yield the fields of a model, inherited ones first, without secrets."""
    for base in model.node.bases:
        inherited = find_model(model.path, base.id) if isinstance(base, ast.Name) else None
        if inherited is not None:
            yield from fields_of(inherited)
    for node in model.node.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            if _is_secret(node.value) or "ClassVar" in ast.unparse(node.annotation):
                continue
            kind = _type_name(node.annotation)
            found = find_model(model.path, kind) if kind else None
            empty = found is not None and _default_is_none(node.value)
            yield ModelField(node.target.id, _description(node.value), found, empty)


def is_section(model: Model) -> bool:
    """Return whether a model is a shared section of the cell."""
    bases = [base.id for base in model.node.bases if isinstance(base, ast.Name)]
    return "Section" in bases or any(
        is_section(inherited) for base in bases if (inherited := find_model(model.path, base))
    )


def _type_name(annotation: ast.expr) -> str:
    """Return the name of a field's type without `| None` and `Tunable`; empty if it has none."""
    match annotation:
        case ast.BinOp(left=left, right=ast.Constant(value=None)):
            return _type_name(left)
        case ast.Subscript(value=ast.Name(id="Tunable"), slice=inner):
            return _type_name(inner)
    return annotation.id if isinstance(annotation, ast.Name) else ""


def _default_is_none(value: ast.expr | None) -> bool:
    first = value.args[0] if isinstance(value, ast.Call) and value.args else value
    return isinstance(first, ast.Constant) and first.value is None


def _is_secret(value: ast.expr | None) -> bool:
    """Return whether a field is excluded from its model's repr, as passwords and tokens are."""
    return isinstance(value, ast.Call) and any(
        keyword.arg == "repr" and isinstance(keyword.value, ast.Constant) and keyword.value.value is False
        for keyword in value.keywords
    )


def _description(value: ast.expr | None) -> str:
    if isinstance(value, ast.Call):
        for keyword in value.keywords:
            if keyword.arg == "description" and isinstance(keyword.value, ast.Constant):
                return str(keyword.value.value)
    return ""


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


SHELLS = ("bash", "zsh", "fish")
COMPLETE_VARIABLE = "_ZENCELL_COMPLETE"  # set by a shell that requests completions


def prepare(environ: Mapping[str, str] = os.environ) -> None:
    """Register the shells if a shell requests completions."""
    if COMPLETE_VARIABLE in environ:
        _register_shells()


def _register_shells() -> None:
    # Typer does this only for its built-in options, which do not accept the name of a shell.
    from typer._completion_classes import completion_init

    completion_init()


def _checked(shell: str) -> str:
    if shell not in SHELLS:
        raise UnknownName("shell", shell, SHELLS)
    return shell


def _install(ctx: typer.Context, param: Any, shell: str | None) -> None:
    if shell is not None and not ctx.resilient_parsing:
        from typer.completion import install_callback

        _register_shells()
        install_callback(ctx, param, _checked(shell))


def _show(ctx: typer.Context, param: Any, shell: str | None) -> None:
    if shell is not None and not ctx.resilient_parsing:
        from typer.completion import show_callback

        _register_shells()
        show_callback(ctx, param, _checked(shell))


def _shells(incomplete: str) -> list[str]:
    return [shell for shell in SHELLS if shell.startswith(incomplete)]


def root(
    install_completion: Annotated[
        str | None,
        typer.Option("--install-completion", metavar="SHELL", help="install completion for bash, zsh or fish",
                     callback=_install, is_eager=True, expose_value=False, autocompletion=_shells),
    ] = None,
    show_completion: Annotated[
        str | None,
        typer.Option("--show-completion", metavar="SHELL", help="show the completion script", callback=_show,
                     is_eager=True, expose_value=False, autocompletion=_shells),
    ] = None,
) -> None:
    """Robot work cells as a mesh of processes over Zenoh."""
