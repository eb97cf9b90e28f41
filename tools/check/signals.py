"""Checks of the inputs and outputs of a cell: its backend accepts them, a service reads them, its task names them."""

from __future__ import annotations

import ast
import importlib.util
from collections.abc import Iterator
from pathlib import Path

from common.config import Cell
from common.errors import UnknownName
from common.hardware.signals import load_io
from tools.check import Finding, error

SERVICE = "io"
STAGES = ("Output", "WaitFor")  # of common.tasks.signals


def require_valid_io(cell: Cell) -> None:
    """Return if the backend of the cell's I/O accepts its signals and options; nothing is connected.

    Raises:
        UnknownName, ConfigError: it does not.
    """
    if cell.io.signals:
        load_io(cell.io, lambda: 0.0)


def check_signals(cell: Cell) -> Iterator[Finding]:
    """Yield a missing service, and signals that the task's stages name and the cell does not have."""
    if cell.io.signals and not any(entry.kind == SERVICE for entry in cell.services.values()):
        yield error(f"io.signals: {len(cell.io.signals)} signals, but no service reads them", "add io: {} to services")
    entry = cell.services.get(cell.task)
    for line, stage, name in _named(entry.module) if entry is not None else ():
        try:
            cell.io.find(name, output=stage == STAGES[0])
        except UnknownName as problem:
            yield error(f"{cell.task}, line {line}: {stage}: {problem}", "add it to io.signals, or name another")


def _named(module: str) -> Iterator[tuple[int, str, str]]:
    """Yield line, stage and signal of each stage for I/O whose signal is written out in the source of a module."""
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return
    for node in ast.walk(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in STAGES and node.args:
            first = node.args[0]
            if isinstance(first, ast.Constant) and isinstance(first.value, str):
                yield node.lineno, node.func.id, first.value
