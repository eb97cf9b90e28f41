"""Recordings of the first release, one of each cell, are read by all commands."""

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from applications.outlining.topics import OUTLINE_STATUS
from applications.pick_place.topics import PICK_PLACE_STATUS
from cli.main import app
from common.application import message_class
from common.messages import TaskStatus
from common.topics import Topic
from common.transport.codec import decode
from recording.reader import Recording
from tests.cli.run_tape import Page

DATA = Path(__file__).resolve().parent.parent / "data"


@dataclass(frozen=True)
class Old:
    """A recording and its known content."""

    cell: str
    messages: int
    types: dict[str, tuple[str, int]]  # class and number of messages by topic, of some
    status: Topic[TaskStatus]
    head: tuple[str, ...]  # parts of the head of its report
    last: dict[str, str]  # fields of the last row of its task's table

    @property
    def path(self) -> Path:
        return DATA / f"{self.cell}_first_release.mcap"


PANDA = Old(
    "panda", 1890, {"joint_states": ("JointState", 637), "pick_place_status": ("PickPlaceStatus", 25),
                    "detected_objects": ("MarkerArray", 51), "scene_balls": ("PoseArray", 95)},
    PICK_PLACE_STATUS, ("panda: DONE", "placed 2 of 2", "rejected places 1", "truth 2 in the box, 1 on the table",
                        "in 8 plans", "frame to target"),
    {"state": "DONE", "placed": "2", "targets": "2"},
)
UR5 = Old(
    "ur5", 1393, {"joint_states": ("JointState", 541), "outline_status": ("OutlineStatus", 15),
                  "contours": ("Contours", 3), "contour_path": ("OutlinePoints", 3)},
    OUTLINE_STATUS, ("ur5: DONE", "outlined Object_0", "traced 100.0% of 0.399 m", "from the true edge 0.03 mm",
                     "in 5 plans"),
    {"state": "DONE", "object": "Object_0", "fraction": "1.0"},
)


@pytest.fixture(params=[PANDA, pytest.param(UR5, marks=pytest.mark.slow)], ids=lambda old: old.cell)
def old(request):
    return request.param


def test_messages_are_counted_and_decoded_by_their_class(old, capsys):
    assert app.execute(["info", str(old.path), "--json"]) == 0
    info = json.loads(capsys.readouterr().out)
    assert info["messages"] == old.messages and info["finished"]
    found = {topic: (info["topics"][topic]["type"], info["topics"][topic]["messages"]) for topic in old.types}
    assert found == old.types
    with Recording(old.path) as recording:
        for sample in recording.samples():
            model = message_class(sample.message)
            assert model is not None, f"no class {sample.message}: {sample.topic} of an old recording cannot be read"
            decode(model, sample.payload)
        schemas = {schema.name: json.loads(schema.data) for schema in recording.layout.schemas.values()}
    assert {name for name, _ in old.types.values()} <= schemas.keys()
    assert all(schema["properties"] for schema in schemas.values())


def test_report_has_the_figures_of_the_run(old, tmp_path):
    assert app.execute(["report", str(old.path), "-o", str(tmp_path / "report.html")]) == 0
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert all(part in page.head for part in old.head), page.head
    assert "Not understood" not in page.text


@pytest.mark.slow
def test_export_is_complete(old, tmp_path, capsys):
    assert app.execute(["export", str(old.path), "--csv", str(tmp_path / "csv"), "--images", str(tmp_path / "png"),
                        "--foxglove", str(tmp_path / "foxglove.mcap")]) == 0
    shown = capsys.readouterr()
    assert all(line.endswith("messages left out: --csv cannot hold them") for line in shown.err.splitlines())
    assert f"foxglove.mcap: {old.messages:,} messages" in shown.out
    with (tmp_path / "csv" / f"{old.status.key}.csv").open(encoding="utf-8", newline="") as file:
        *_, last = csv.DictReader(file)
    assert last | old.last == last
    assert list((tmp_path / "png").glob("*/*.png"))
