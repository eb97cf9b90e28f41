"""`zencell new`: what it writes is a whole project, and what it refuses."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from cli import choices
from common.application import find_application
from common.config import load_cell
from common.supervision.launch import Launch
from tests.harness import ask, environment

KINDS = choices.task_kinds()


def test_kinds_are_the_examples_with_a_cell_and_are_completed() -> None:
    assert KINDS == ["sort_cubes", "stack_cubes"]
    found = dict(choices.tasks("st"))
    assert list(found) == ["stack_cubes"] and found["stack_cubes"].startswith("Stack cubes")


@pytest.mark.parametrize("kind", KINDS)
def test_new_project_has_a_cell_a_task_a_test_and_five_lines_about_them(kind: str, tmp_path: Path) -> None:
    name = f"my_{kind}"
    made = ask(tmp_path, "new", f"deep/{name}", "--task", kind)
    assert (made.returncode, made.stderr) == (0, "")
    assert f"zencell run deep/{name}/cell.yaml" in made.stdout
    folder = tmp_path / "deep" / name
    assert {path.name for path in folder.iterdir()} == {"cell.yaml", "task.py", "test_task.py", "README.md"}
    assert not any(kind in path.read_text(encoding="utf-8").replace(name, "") for path in folder.iterdir())
    assert len((folder / "task.py").read_text(encoding="utf-8").splitlines()) < 120
    cell = load_cell(str(folder / "cell.yaml"))  # its modules are found beside it, wherever one stands
    assert (cell.name, cell.task, cell.application) == (name, "task", f"{name}.task")
    assert find_application(cell.application).status.key == f"{name}_status"


def test_module_beside_a_cell_file_is_found_by_its_processes_from_anywhere(tmp_path: Path) -> None:
    assert ask(tmp_path, "new", "beside_me").returncode == 0
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    made = Launch(str(tmp_path / "beside_me" / "cell.yaml")).environment({})
    told = subprocess.run([sys.executable, "-P", "-m", "beside_me.task", "--help"], cwd=elsewhere, capture_output=True,
                          env=environment() | made, text=True, check=False)
    assert told.returncode == 0 and "--cell" in told.stdout, told.stderr


@pytest.mark.parametrize(("arguments", "wanted"), [
    (["taken"], ["DIR", "'taken'", "not empty"]),
    (["a_file"], ["DIR", "'a_file'", "not empty"]),
    (["my-task"], ["DIR", "'my-task'", "letters, digits and _"]),
    (["class"], ["DIR", "'class'", "a name that Python can import"]),
    (["json"], ["DIR", "'json'", "a Python module that is there already"]),
    (["common"], ["DIR", "'common'", "a Python module that is there already"]),
    (["fine", "--task", "sort_cube"], ["unknown task 'sort_cube'", "did you mean 'sort_cubes'?", "choices:"]),
    (["a_file/below"], ["DIR", "'a_file/below'", "cannot be written"]),
])
def test_what_cannot_be_is_refused_in_one_line_and_nothing_is_written(
    arguments: list[str], wanted: list[str], tmp_path: Path
) -> None:
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine.txt").write_text("mine")
    (tmp_path / "a_file").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    told = ask(tmp_path, "new", *arguments)
    assert told.returncode == 2 and told.stderr.count("\n") == 1, told.stderr
    assert all(part in told.stderr for part in wanted), told.stderr
    assert sorted(tmp_path.rglob("*")) == before


def test_an_empty_folder_that_is_there_is_taken(tmp_path: Path) -> None:
    (tmp_path / "empty_one").mkdir()
    assert ask(tmp_path, "new", "empty_one").returncode == 0
    assert (tmp_path / "empty_one" / "cell.yaml").is_file()
