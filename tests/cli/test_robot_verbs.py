from pathlib import Path

import pytest

from cli.main import app
from common.config import config_root


def test_collisions_of_a_robot_are_written_or_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "made.srdf"
    assert app.execute(["robot", "collisions", "panda", "--samples", "50", "-o", str(path)]) == 0
    told = capsys.readouterr().out
    assert told.startswith(f"{path}: ") and "adjacent" in told and "never" in told
    assert app.execute(["robot", "collisions", "panda", "--samples", "50"]) == 0
    shown = capsys.readouterr().out
    assert shown == path.read_text() and shown.startswith('<?xml version="1.0"?>\n<robot name="panda">')


def test_other_seed_is_another_sample(capsys: pytest.CaptureFixture[str]) -> None:
    texts = []
    for seed in ("0", "1", "0"):
        assert app.execute(["robot", "collisions", "ur5", "--samples", "3", "--seed", seed]) == 0
        texts.append(capsys.readouterr().out)
    assert texts[0] == texts[2] != texts[1]


def test_robot_file_of_ones_own_may_name_the_srdf_that_is_still_to_be_made(tmp_path: Path) -> None:
    text = (config_root() / "robots" / "panda.yaml").read_text()
    line = next(line for line in text.splitlines() if line.startswith("srdf:"))
    mine = tmp_path / "mine.yaml"
    mine.write_text(text.replace(line, "srdf: mine.srdf"))
    path = tmp_path / "mine.srdf"
    assert app.execute(["robot", "collisions", str(mine), "--samples", "10", "-o", str(path)]) == 0
    assert path.is_file()


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["pnada"], ["unknown robot 'pnada'", "did you mean 'panda'?", "ur5"]),
        (["nowhere.yaml"], ["nowhere.yaml", "is not a file"]),
        (["panda", "--samples", "0"], ["--samples", "0", "1 or more"]),
        (["panda", "--seed", "x"], ["--seed", "'x'"]),
        (["panda", "--margin", "-1"], ["--margin", "-1", "0 or more"]),
        (["panda", "--margin", "wide"], ["--margin", "'wide'", "must be a number"]),
        (["panda", "--samples", "1", "-o", "/no/where/x.srdf"], ["--output", "/no/where/x.srdf", "cannot be written"]),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], wanted: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert app.execute(["robot", "collisions", *arguments]) == 2
    shown = capsys.readouterr()
    (line,) = shown.err.splitlines()
    assert all(part in line for part in wanted) and shown.out == ""
