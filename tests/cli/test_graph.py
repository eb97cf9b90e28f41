import xml.etree.ElementTree as ET

import pytest

from cli.main import app
from common.supervision.wiring import ServiceWiring
from tests.harness import ask
from tools.graph import OUTSIDE, Graph, dot, edges, graph_of, mermaid, svg

SERVICES = [
    ServiceWiring("planner", "Plans.", writes=["display_trajectory"], serves=["motion/plan"], reads=["joint_states"]),
    ServiceWiring("executor", "Moves.", writes=["joint_states", "motion/status"],
                  serves=["motion/execute", "world/edit"]),
    ServiceWiring("task", "Decides.", reads=["motion/status", "my/own"], calls=["motion/plan", "motion/execute"]),
]
RUNNING = frozenset({"executor", "task"})
SVG = "{http://www.w3.org/2000/svg}"


def drawn(alive: frozenset[str] | None = None) -> Graph:
    return graph_of("tiny", SERVICES, alive)


def test_graph_has_every_key_once_with_its_kind():
    assert drawn().kinds == {
        "display_trajectory": "state", "joint_states": "stream", "motion/status": "state", "motion/plan": "request",
        "motion/execute": "request", "world/edit": "request", "my/own": "event",
    }


def test_edges_run_from_writers_and_callers_to_readers_and_servers():
    found = {(start, end) for start, end, _, _ in edges(drawn())}
    assert {("executor", "key joint_states"), ("key joint_states", "planner"), ("task", "key motion/plan"),
            ("key motion/plan", "planner")} <= found
    assert ("planner", "key motion/plan") not in found
    assert drawn().outside == ["world/edit"], "no service of the cell sends this request"
    assert (OUTSIDE, "key world/edit", True, True) in edges(drawn())


def test_supervisor_publishes_its_status_and_parameters_are_omitted():
    page = ServiceWiring("viewer", "", reads=["supervisor/status"], calls=["param/task", "motion/stop"])
    graph = graph_of("tiny", [page])
    assert ("supervisor", "key supervisor/status", False, True) in edges(graph)
    assert set(graph.kinds) == {"motion/stop", "supervisor/status"}
    assert page.calls == ["param/task", "motion/stop"]


def test_drawing_has_all_names_in_boxes_that_do_not_overlap():
    root = ET.fromstring(svg(drawn()))
    texts = [each.text for each in root.iter(f"{SVG}text")]
    assert {"planner", "executor", "task", *drawn().kinds} <= set(texts)
    size = [float(root.attrib[name]) for name in ("width", "height")]
    sides: dict[str, list[tuple[float, float]]] = {}
    for box in (box for box in root.iter(f"{SVG}rect") if "x" in box.attrib):
        x, y, width, height = (float(box.attrib[name]) for name in ("x", "y", "width", "height"))
        assert 0 <= x <= size[0] - width and 0 <= y <= size[1] - height
        if box.attrib.get("rx") == "4":
            sides.setdefault(box.attrib["x"], []).append((y, y + height))
    assert len(sides) == 2
    for boxes in sides.values():
        assert all(upper[1] <= lower[0] for upper, lower in zip(sorted(boxes), sorted(boxes)[1:], strict=False))


@pytest.mark.parametrize(("alive", "dashed"), [(None, 0), (RUNNING | {"planner"}, 0), (RUNNING, 2)])
def test_stopped_services_are_dashed_on_both_sides(alive, dashed):
    boxes = ET.fromstring(svg(drawn(alive))).iter(f"{SVG}rect")
    assert sum("stroke-dasharray" in box.attrib for box in boxes) == dashed


def test_dot_and_mermaid_have_each_edge_and_mark_stopped_services():
    text, lines = dot(drawn(RUNNING)), mermaid(drawn(RUNNING)).splitlines()
    assert text.startswith('digraph "tiny" {') and '"planner" [shape=box, style="dashed"' in text
    assert '  "executor" -> "key joint_states";' in text and '  "task" -> "key motion/plan" [style=dashed];' in text
    arrows = [line.split() for line in lines if "->" in line]
    assert text.count("->") == len(arrows) == len(list(edges(drawn())))
    assert lines[0] == "flowchart LR" and all(start.isalnum() and end.isalnum() for start, _, end in arrows)
    assert '["planner"]:::gone' in "\n".join(lines) and '["task"]:::alive' in "\n".join(lines)


@pytest.mark.parametrize("suffix", [".svg", ".dot", ".mmd"])
def test_cell_is_drawn_without_running(suffix, tmp_path, capsys):
    path = tmp_path / f"it{suffix}"
    for options in ([], ["--no-viewer"]):
        assert app.execute(["graph", "ur5", "-o", str(path), "--connect", "tcp/127.0.0.1:1", *options]) == 0
        assert capsys.readouterr().out.startswith(f"{path}: ")
        text = path.read_text()
        assert ("viewer" in text) == (not options)
        assert all(name in text for name in ("contour_tracer", "depth_camera/image_raw", "outline/select"))


def test_service_that_cannot_be_wired_is_reported_and_the_others_are_drawn(folder):
    (folder / "broken").mkdir()
    (folder / "broken" / "middle.py").write_text("raise OSError('no such device')\n")
    file = folder / "tiny.yaml"
    file.write_text(file.read_text().replace("tests.cli.fakes.middle", "broken.middle"))
    done = ask(folder, "graph", "tiny.yaml", "--connect", "tcp/127.0.0.1:1")
    assert done.returncode == 0
    assert "services.middle" in done.stderr and "no such device" in done.stderr
    assert '["middle"]' in done.stdout and '["first"]' in done.stdout
    done = ask(folder, "node", "info", "middle", "--cell", "tiny.yaml", "--connect", "tcp/127.0.0.1:1")
    assert done.returncode == 1
