"""Applications bring verbs and options of `run` of their own, without a line in the command line's files."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

import cli
from cli import main, verbs
from cli.main import app
from common.errors import ConfigError

THING = '''
from typing import Annotated

import typer

from common.messages import TaskStatus
from common.topics import Topic
from common.application import Application, ApplicationTopics
from common.verbs import BeforeRun, Verbs

STATUS = Topic("thing_status", TaskStatus, "state", "state")


def greet(context: typer.Context, cell: str, overrides: list[str] | None = None, loud: bool = False) -> None:
    """Greet a cell."""
    typer.echo(f"hello {cell} {overrides} {loud} {type(context.obj).__name__}")


def before_run(
    cell: str, overrides: list[str], world: str | None, *,
    wish: Annotated[str, typer.Option("--wish", help="what to wish for")] = "",
) -> BeforeRun:
    return BeforeRun([*overrides, f"services.thing.wish={wish}"] if wish else overrides)


APPLICATION = Application(
    topics=ApplicationTopics(status=STATUS), task="thing",
    verbs=Verbs(commands={"greet": greet, "task greet": greet}, before_run=before_run),
)
'''


@pytest.fixture
def own_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    (tmp_path / "own_thing").mkdir()
    (tmp_path / "own_thing" / "thing.py").write_text(THING)
    (tmp_path / "cell.yaml").write_text("cell: mine\napplication: own_thing.thing\nrobot: panda\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    fresh = typer.Typer()

    @verbs.with_shared_options
    def run(cell: str, overrides: list[str] | None = None, chaos: str = "", **of_applications: str) -> None:
        """Run."""
        before = verbs.before_run(cell, overrides, None, of_applications)
        typer.echo(f"{before.overrides} {chaos}")

    groups = {"task": typer.Typer()}
    fresh.add_typer(groups["task"], name="task")
    taken = verbs.ApplicationVerbs(fresh, groups, run, last="chaos")
    monkeypatch.setattr(verbs, "BEFORE_RUN", [])
    taken.take_all()
    taken.take_own(["run", "cell.yaml"])
    taken.take_own(["run", "cell.yaml"])  # once is enough
    fresh.command()(run)
    monkeypatch.setattr(main, "app", fresh)
    yield "cell.yaml"
    for name in [name for name in sys.modules if name.partition(".")[0] == "own_thing"]:
        del sys.modules[name]


def told(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    command = typer.main.get_command(main.app)
    command(list(arguments), standalone_mode=False, obj=verbs.CommandShell())
    return capsys.readouterr().out.strip()


def test_verbs_of_a_cells_own_application_are_there(own_cell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, "greet", own_cell, "--set", "a=1", "--loud") == "hello cell.yaml ['a=1'] True CommandShell"
    assert told(capsys, "task", "greet", own_cell) == "hello cell.yaml None False CommandShell"


def test_options_of_applications_reach_the_run_as_overrides(own_cell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, "run", own_cell, "--set", "a=1", "--wish", "rain") == "['a=1', 'services.thing.wish=rain']"
    assert told(capsys, "run", own_cell) == "[]"
    listed = told(capsys, "run", "--help")
    assert listed.index("--ask") < listed.index("--wish") < listed.index("--chaos")
    with pytest.raises(ConfigError, match=r"--ask.*needs a cell that outlines objects"):
        told(capsys, "run", "panda", "--ask")


def test_only_cell_files_with_a_module_of_their_own_are_looked_at(own_cell: str, tmp_path: Path) -> None:
    (tmp_path / "other.yaml").write_text("application: pick_place\n")
    (tmp_path / "broken.yaml").write_text("application: [\n")
    arguments = ["run", "other.yaml", "broken.yaml", "missing.yaml", "panda", f"--cell={own_cell}"]
    assert list(verbs.own_applications(arguments)) == ["own_thing.thing"]


def test_a_cell_whose_application_is_no_module_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    text = "cell: mine\napplication: nowhere.thing\nrobot: panda\nworld: balls\npipeline: lerp\ntask: thing\n"
    (tmp_path / "cell.yaml").write_text(f"{text}services: {{motion_planner: {{}}}}\n")
    assert app.execute(["run", "cell.yaml", "--no-viewer"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "nowhere.thing" in line


def test_the_command_line_loads_no_messages_before_a_verb_needs_them() -> None:
    code = "import cli.main, sys; print([name for name in ('pydantic', 'zenoh', 'numpy') if name in sys.modules])"
    root = Path(cli.__file__).parent.parent
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
