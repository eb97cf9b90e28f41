"""`zencell new` writes a complete project."""

import subprocess

import pytest

from cli import choices
from common.application import find_application
from common.config import load_cell
from common.supervision.launch import Launch
from tests.harness import ask, environment

KINDS = choices.task_kinds()


def test_kinds_are_the_examples_with_a_cell_and_are_completed():
    assert KINDS == ["palletize", "sort_cubes", "stack_cubes"]
    found = dict(choices.tasks("st"))
    assert list(found) == ["stack_cubes"] and found["stack_cubes"].startswith("Stack cubes")


@pytest.mark.parametrize("kind", KINDS)
def test_project_has_a_cell_and_a_task_whose_process_starts_in_any_folder(kind, tmp_path):
    name = f"my_{kind}"
    done = ask(tmp_path, "new", f"deep/{name}", "--task", kind)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"zencell run deep/{name}/cell.yaml" in done.stdout
    folder = tmp_path / "deep" / name
    assert {path.name for path in folder.iterdir()} == {"cell.yaml", "task.py", "test_task.py", "README.md"}
    assert not any(kind in path.read_text(encoding="utf-8").replace(name, "") for path in folder.iterdir())
    assert len((folder / "task.py").read_text(encoding="utf-8").splitlines()) < 120
    cell = load_cell(str(folder / "cell.yaml"))
    assert (cell.name, cell.task, cell.application) == (name, "task", f"{name}.task")
    assert find_application(cell.application).status.key == f"{name}_status"
    launch = Launch(str(folder / "cell.yaml"))
    command = [*launch.service_command(cell.services[cell.task], gate=False), "--help"]
    process = subprocess.run(command, cwd="/", env=environment() | launch.environment({}), capture_output=True,
                             text=True, check=False)
    assert process.returncode == 0 and "--cell" in process.stdout, process.stderr


def test_project_is_written_into_an_empty_folder(tmp_path):
    (tmp_path / "empty_one").mkdir()
    assert ask(tmp_path, "new", "empty_one").returncode == 0
    assert (tmp_path / "empty_one" / "cell.yaml").is_file()
