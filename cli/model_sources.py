"""Fields of the models of the configuration, read from their sources without imports."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

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
            if _is_secret(node.value):
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
