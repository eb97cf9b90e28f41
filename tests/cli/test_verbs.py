"""Applications add commands, and options of `run`, without a line in the command line's files."""

import subprocess
import sys

import pytest
import typer

from cli import verbs
from common.errors import ConfigError
from tests.harness import ROOT, own_modules

THING = '''
from typing import Annotated

import typer

from common.messages import TaskStatus
from common.topics import Topic
from common.application import Application, ApplicationTopics
from common.verbs import BeforeRun, Verbs

def greet(context: typer.Context, cell: str, overrides: list[str] | None = None, loud: bool = False) -> None:
    """Greet a cell."""
    typer.echo(f"hello {cell} {overrides} {loud} {type(context.obj).__name__}")

def before_run(
    cell: str, overrides: list[str], world: str | None, *,
    wish: Annotated[str, typer.Option("--wish", help="what to wish for")] = "",
) -> BeforeRun:
    return BeforeRun([*overrides, f"services.thing.wish={wish}"] if wish else overrides)

APPLICATION = Application(
    topics=ApplicationTopics(status=Topic("thing_status", TaskStatus, "state", "state")), task="thing",
    verbs=Verbs(commands={"greet": greet, "task greet": greet, "things greet": greet},
                groups={"things": "All about things."}, before_run=before_run),
)
'''


@pytest.fixture
def output(tmp_path, monkeypatch, capsys):
    """Run a command line with the commands of cell.yaml's own application, and return its output."""
    (tmp_path / "own_thing").mkdir()
    (tmp_path / "own_thing" / "thing.py").write_text(THING)
    (tmp_path / "cell.yaml").write_text("cell: mine\napplication: own_thing.thing\nrobot: panda\n")
    monkeypatch.chdir(tmp_path)
    fresh = typer.Typer()

    @verbs.with_shared_options
    def run(cell: str, overrides: list[str] | None = None, chaos: str = "", **of_applications: str) -> None:
        """Run."""
        typer.echo(f"{verbs.before_run(cell, overrides, None, of_applications).overrides} {chaos}")

    groups = {"task": typer.Typer()}
    fresh.add_typer(groups["task"], name="task")
    monkeypatch.setattr(verbs, "BEFORE_RUN", [])
    with own_modules(tmp_path):
        monkeypatch.syspath_prepend(tmp_path)
        taken = verbs.ApplicationVerbs(fresh, groups, run, last="chaos")
        taken.take_all()
        for _ in range(2):  # the second time changes nothing
            taken.take_own(["run", "cell.yaml"])
        fresh.command()(run)

        def execute(*arguments: str) -> str:
            typer.main.get_command(fresh)(list(arguments), standalone_mode=False, obj=verbs.CommandShell())
            return capsys.readouterr().out.strip()

        yield execute


def test_commands_of_a_custom_application_are_added(output):
    assert output("greet", "cell.yaml", "--set", "a=1", "--loud") == "hello cell.yaml ['a=1'] True CommandShell"
    for group in ("task", "things"):
        assert output(group, "greet", "cell.yaml") == "hello cell.yaml None False CommandShell"
    assert "All about things." in output("things", "--help")


def test_options_of_applications_reach_the_run_as_overrides(output):
    assert output("run", "cell.yaml", "--set", "a=1", "--wish", "rain") == "['a=1', 'services.thing.wish=rain']"
    assert output("run", "cell.yaml") == "[]"
    usage = output("run", "--help")
    assert usage.index("--ask") < usage.index("--wish") < usage.index("--chaos")
    with pytest.raises(ConfigError, match=r"--ask.*needs a cell that outlines objects"):
        output("run", "panda", "--ask")


def test_only_cell_files_with_their_own_application_are_imported(output, tmp_path):
    (tmp_path / "other.yaml").write_text("application: pick_place\n")
    (tmp_path / "broken.yaml").write_text("application: [\n")
    arguments = ["run", "other.yaml", "broken.yaml", "missing.yaml", "panda", "--cell=cell.yaml"]
    assert list(verbs.own_applications(arguments)) == ["own_thing.thing"]


def test_missing_application_is_one_line(tmp_path, monkeypatch, rejection):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cell.yaml").write_text("cell: mine\napplication: nowhere.thing\nrobot: panda\nworld: balls\n"
                                        "pipeline: lerp\ntask: thing\nservices: {motion_planner: {}}\n")
    assert "nowhere.thing" in rejection("run", "cell.yaml", "--no-viewer")


def test_command_line_imports_heavy_modules_only_on_demand():
    code = "import cli.main, sys; print([name for name in ('pydantic', 'zenoh', 'numpy') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
