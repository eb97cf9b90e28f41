"""No cell of an exported table is a formula to a spreadsheet."""

import csv
from pathlib import Path

import pytest

from common.messages import GripperState
from recording import export
from recording.reader import Recording
from recording.sample import Decoder
from tests.recording.samples import joints, packed, write


@pytest.mark.parametrize("text", ['=cmd|"/C calc"!A0', "+1+1", "-2+3", "@SUM(A1)", "\t=1"])
def test_text_that_begins_like_a_formula_gets_an_apostrophe(tmp_path: Path, text: str) -> None:
    state = joints(0, key="panda/gripper/state", payload=packed(GripperState(message=text)), message="GripperState")
    path = write(tmp_path / "a.mcap", [joints(-1), state])
    with Recording(path) as recording:
        export.export_tables(recording, tmp_path / "csv", lambda topic: True, Decoder())
    rows = {}
    for name in ("joint_states", "gripper_state"):
        with (tmp_path / "csv" / f"{name}.csv").open(newline="", encoding="utf-8") as file:
            rows[name] = list(csv.DictReader(file))
    assert rows["gripper_state"][0]["message"] == f"'{text}"
    assert float(rows["joint_states"][0]["a.position"]) == -0.1
