import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from cli.main import app
from common.supervision.wiring import ServiceWiring
from tools.graph import OUTSIDE, Graph, dot, edges, graph_of, mermaid, svg

SERVICES = [
    ServiceWiring("planner", "Plans.", writes=["display_trajectory"], serves=["motion/plan"], reads=["joint_states"]),
    ServiceWiring("executor", "Moves.", writes=["joint_states", "motion/status"],
                  serves=["motion/execute", "world/edit"]),
    ServiceWiring("task", "Decides.", reads=["motion/status", "my/own"], calls=["motion/plan", "motion/execute"]),
]
SVG = "{http://www.w3.org/2000/svg}"


def drawn(alive: frozenset[str] | None = None) -> Graph:
    return graph_of("tiny", SERVICES, alive)


def texts(document: str) -> list[str]:
    return [each.text or "" for each in ET.fromstring(document).iter(f"{SVG}text")]


def test_graph_has_every_key_once_with_its_kind() -> None:
    assert drawn().kinds == {
        "display_trajectory": "state", "joint_states": "stream", "motion/status": "state", "motion/plan": "request",
        "motion/execute": "request", "world/edit": "request", "my/own": "event",
    }


def test_request_that_nobody_in_the_cell_sends_comes_from_outside() -> None:
    assert drawn().outside == ["world/edit"]
    assert (OUTSIDE, "key world/edit", True, True) in edges(drawn())


def test_what_the_supervisor_says_comes_from_it_and_parameters_are_left_out() -> None:
    page = ServiceWiring("viewer", "", reads=["supervisor/status"], calls=["param/task", "motion/stop"])
    made = graph_of("tiny", [page])
    assert ("supervisor", "key supervisor/status", False, True) in edges(made)
    assert set(made.kinds) == {"motion/stop", "supervisor/status"}
    assert page.calls == ["param/task", "motion/stop"]


def test_edges_run_from_writers_and_callers_to_readers_and_servers() -> None:
    found = {(start, end) for start, end, _, _ in edges(drawn())}
    assert ("executor", "key joint_states") in found
    assert ("key joint_states", "planner") in found
    assert ("task", "key motion/plan") in found
    assert ("key motion/plan", "planner") in found
    assert ("planner", "key motion/plan") not in found


def test_picture_shows_services_and_keys_inside_of_it() -> None:
    document = svg(drawn())
    shown = texts(document)
    for name in ("planner", "executor", "task", *drawn().kinds):
        assert name in shown
    root = ET.fromstring(document)
    width, height = float(root.attrib["width"]), float(root.attrib["height"])
    for box in root.iter(f"{SVG}rect"):
        if "x" in box.attrib:
            assert 0 <= float(box.attrib["x"]) <= width - float(box.attrib["width"])
            assert 0 <= float(box.attrib["y"]) <= height - float(box.attrib["height"])


def test_boxes_of_one_side_do_not_overlap() -> None:
    sides: dict[str, list[tuple[float, float]]] = {}
    for box in ET.fromstring(svg(drawn())).iter(f"{SVG}rect"):
        if box.attrib.get("rx") == "4":
            top = float(box.attrib["y"])
            sides.setdefault(box.attrib["x"], []).append((top, top + float(box.attrib["height"])))
    assert len(sides) == 2
    for boxes in sides.values():
        for upper, lower in zip(sorted(boxes), sorted(boxes)[1:], strict=False):
            assert upper[1] <= lower[0]


def test_what_is_not_alive_is_dashed_while_the_cell_is_up() -> None:
    def dashed_boxes(document: str) -> int:
        return sum(1 for box in ET.fromstring(document).iter(f"{SVG}rect") if "stroke-dasharray" in box.attrib)

    assert dashed_boxes(svg(drawn())) == 0
    assert dashed_boxes(svg(drawn(frozenset({"planner", "executor", "task"})))) == 0
    assert dashed_boxes(svg(drawn(frozenset({"executor", "task"})))) == 2  # planner, on both sides
    gone = drawn(frozenset({"executor", "task"}))
    assert '"planner" [shape=box, style="dashed"' in dot(gone)
    assert '["planner"]:::gone' in mermaid(gone)
    assert '["task"]:::alive' in mermaid(gone)


def test_dot_names_each_edge_and_quotes_what_needs_it() -> None:
    text = dot(drawn())
    assert text.startswith('digraph "tiny" {')
    assert '  "executor" -> "key joint_states";' in text
    assert '  "task" -> "key motion/plan" [style=dashed];' in text
    assert text.count("->") == len(list(edges(drawn())))


def test_mermaid_ids_are_words() -> None:
    lines = mermaid(drawn()).splitlines()
    assert lines[0] == "flowchart LR"
    arrows = [line.split() for line in lines if "->" in line]
    assert len(arrows) == len(list(edges(drawn())))
    assert all(start.isalnum() and end.isalnum() for start, _, end in arrows)


@pytest.mark.parametrize("suffix", [".svg", ".dot", ".mmd"])
def test_cell_is_drawn_without_being_up(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / f"it{suffix}"
    assert app.execute(["graph", "ur5", "-o", str(path), "--connect", "tcp/127.0.0.1:1"]) == 0
    assert capsys.readouterr().out.startswith(f"{path}: ")
    assert "viewer" in path.read_text()
    assert app.execute(["graph", "ur5", "-o", str(path), "--no-viewer", "--connect", "tcp/127.0.0.1:1"]) == 0
    text = path.read_text()
    assert "viewer" not in text
    for name in ("contour_tracer", "depth_camera/image_raw", "outline/select"):
        assert name in text


@pytest.mark.parametrize(("arguments", "wanted"), [
    (["ur5", "-o", "it.png"], ["--output", "'it.png'", ".svg, .dot, .mmd"]),
    (["ur5", "-o", "/no/where/it.svg", "--connect", "tcp/127.0.0.1:1"], ["/no/where/it.svg", "cannot be written"]),
    (["ur6"], ["unknown cell 'ur6'", "ur5"]),
])
def test_bad_input_is_one_line(arguments: list[str], wanted: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert app.execute(["graph", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert all(part in line for part in wanted)


def test_service_that_can_not_be_wired_is_named_and_the_rest_is_drawn(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (folder / "fakes" / "middle.py").write_text("raise OSError('no such device')\n")
    assert app.execute(["graph", "tiny.yaml", "--connect", "tcp/127.0.0.1:1"]) == 0
    shown = capsys.readouterr()
    assert "services.middle" in shown.err
    assert "no such device" in shown.err
    assert '["middle"]' in shown.out
    assert '["first"]' in shown.out
    assert app.execute(["node", "info", "middle", "--cell", "tiny.yaml", "--connect", "tcp/127.0.0.1:1"]) == 1
