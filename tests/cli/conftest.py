"""Cells of tiny services, and zencell commands as processes or within this one."""

import sys
from pathlib import Path

import pytest

from cli.main import app
from tests.harness import Zencell, free_domain


def make_folder(folder: Path, name: str = "tiny", first: str = "first") -> Path:
    """Write the file of a cell whose first service is chosen; `last` is its task."""
    (folder / f"{name}.yaml").write_text(
        f"cell: {name}\nrobot: panda\nworld: balls\npipeline: cartesian_ompl\ntask: last\n"
        f"services: {{tests.cli.fakes.{first}: {{}}, tests.cli.fakes.middle: {{}}, tests.cli.fakes.last: {{}}}}\n")
    return folder


@pytest.fixture(autouse=True)
def _restore_path(monkeypatch):
    """Forget the folders in which a cell file has its services."""
    monkeypatch.setattr(sys, "path", list(sys.path))


@pytest.fixture
def folder(tmp_path):
    return make_folder(tmp_path)


@pytest.fixture
def domain():
    return free_domain()


@pytest.fixture
def rejection(capsys):
    """Run a command that fails within this process, and return its only line."""

    def run(*arguments: str, code: int = 2) -> str:
        found = app.execute(arguments)
        shown = capsys.readouterr()
        assert (found, shown.out) == (code, ""), shown.err
        (line,) = shown.err.splitlines()
        assert line.startswith("zencell: ")
        return line

    return run


@pytest.fixture
def zencell(folder, domain):
    """Start zencell commands as processes, and kill at the end what is left of them."""
    started: list[Zencell] = []

    def start(*arguments: str) -> Zencell:
        started.append(Zencell(folder, domain, *arguments))
        return started[-1]

    yield start
    for command in started:
        for process in command.children().values():
            process.kill()
        command.process.kill()
        if command.process.stdout is not None and not command.process.stdout.closed:
            command.end()
