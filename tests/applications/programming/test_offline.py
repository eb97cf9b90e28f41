"""Check, dry run and export of program files, by their commands."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Literal

import pytest

from applications.programming.building import Builder, Built
from applications.programming.editing import parsed
from applications.programming.export import script
from applications.programming.files import BadProgram, load_program
from applications.programming.flow import Flow, Undecided
from applications.programming.form import Known, fields_of, new_step
from applications.programming.model import STEPS, Distance, Motion
from applications.programming.offline import rehearse, require_no_problems
from applications.programming.targets import backed, pose_goal
from tests.harness import ask

CELL = str(Path(__file__).parents[2] / "data" / "programs.yaml")
WRONG = """\
steps:
  - {step: move, to: hom}
  - {step: output, signal: clam}
  - {step: wait, for: {signal: busy, above: 3}}
  - {step: move, id: far, to: {position: [1.5, 0, 0.3]}}
  - {step: move, id: low, to: {position: [0.5, 0.2, 0.3]}, straight: true}
  - {step: move, id: table, to: {by: [0, 0, -0.4]}, straight: true}
  - {step: python, function: "json:load_it"}
  - {step: if, when: {holding: true}, then: [{step: move, id: inside, to: {position: [0.5, 0, -0.1]}}]}
"""
RIGHT = """\
steps:
  - {step: move, id: a, to: {position: [0.5, 0.2, 0.3]}}
  - step: loop
    count: 2
    steps:
      - {step: wait, seconds: 2}
      - {step: output, signal: clamp}
  - {step: wait, for: {signal: clamp_closed}}
  - {step: loop, steps: [{step: move, id: b, to: home}]}
"""


def written(folder: Path, text: str, name: str = "program") -> str:
    (folder / f"{name}.yaml").write_text(text)
    return str(folder / f"{name}.yaml")


def test_check_reports_all_problems_at_once_each_with_line_and_step(tmp_path: Path) -> None:
    file = written(tmp_path, WRONG)
    done = ask(tmp_path, "program", "check", file, "--cell", CELL)
    assert (done.returncode, done.stdout) == (2, "")
    lines = [line.removeprefix("zencell: ").removeprefix(f"{file}:") for line in done.stderr.splitlines()]
    for line, start in zip(lines, (
        "2: move1: steps[0].to: unknown pose 'hom' (did you mean 'home'?)",
        "3: output1: steps[1].signal: unknown output of the cell 'clam' (did you mean 'clamp'?)",
        "4: wait1: steps[2].for: busy: is digital",
        "5: far: ",
        "7: table: ",
        "8: python1: steps[6].function: 'json:load_it' does not exist; choices: ",
        "9: inside: "), strict=True):
        assert line.startswith(start), line
    assert "reach" in lines[3] and "collides with table" in lines[4], "reach, and the straight motion before contact"


UNSURE = """\
steps:
  - {step: if, when: {signal: busy}, then: [{step: move, to: {position: [0.6, 0.1, 0.5]}}]}
  - {step: retreat, distance: 0.25, axis: world}
  - {step: if, when: {signal: busy}, then: [{step: place, at: home}]}
  - {step: pick, kind: ball}
  - {step: retreat, distance: 1.5}
  - {step: move, to: {position: [1.5, 0, 0.3]}, on_failure: continue}
"""


@pytest.mark.parametrize(("more", "refused"), [
    ("  - {step: move, to: {position: [1.5, 0, 0.3]}}", "8: move3: no pose of the goal region can be reached"),
    ("  - {step: place, at: {position: [0.5, 0, -0.1]}}", "8: place2: all "),
    ("  - {step: if, when: {holding: false}, then: [{step: output, signal: clam}]}", "8: output1: steps[6].then[0]"),
    ("  - {step: if, when: {signal: bussy}, then: [{step: wait, seconds: 1}]}", "8: if3: steps[6].when"),
    ("  - {step: loop, while: {signal: bussy}, steps: [{step: wait, seconds: 1}]}", "8: loop1: steps[6].while"),
    ("", ""),
])
def test_run_refuses_what_fails_wherever_the_program_is_and_nothing_else(
    tmp_path: Path, more: str, refused: str,
) -> None:
    file = written(tmp_path, UNSURE + more)
    if not refused:
        with pytest.raises(BadProgram):
            require_no_problems(rehearse(Path(file), CELL, everything=True))
        require_no_problems(rehearse(Path(file), CELL, everything=True), certain=True)
        return
    done = ask(tmp_path, "run", file, "--cell", CELL)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith(f"zencell: {file}:{refused}"), done.stderr


def test_dry_run_sums_the_durations_and_says_what_is_not_known(tmp_path: Path) -> None:
    found = rehearse(Path(written(tmp_path, RIGHT)), CELL)
    items = [(each.step, each.seconds) for each in found.result.steps]
    assert [step for step, _ in items] == ["a", "wait1", "output1", "wait1", "output1", "wait2", "b"]
    first, last = items[0][1], items[-1][1]
    assert first is not None and last is not None and items[-2][1] is None
    assert found.result.seconds == pytest.approx(first + 2 * 2.0 + last)
    assert found.result.message == "loop2 repeats without end: one turn is planned"
    done = ask(tmp_path, "program", "dry-run", "program.yaml", "--cell", CELL)
    assert done.returncode == 0
    assert done.stdout.splitlines()[-2:] == [
        f"{found.result.seconds:6.2f}s  cycle time, and 1 steps of unknown time",
        "loop2 repeats without end: one turn is planned"]
    assert "      ?  program:8        wait      wait2          the wait for clamp_closed is on" in done.stdout


@pytest.mark.parametrize(("arguments", "problem"), [
    (("check", "none.yaml"), "program: 'none.yaml' cannot be read: No such file or directory"),
    (("check", "program.yaml"), "cell: is missing in program.yaml: add `cell: NAME`, or use --cell NAME"),
    (("export", "program.yaml", "--cell", "pandda"), "unknown cell 'pandda' (did you mean 'panda'?)"),
    (("check", "program.yaml", "--cell", "duo"), "cell: 'duo' has several robots (left, right), and a program"),
    (("dry-run", "bad.yaml"), "bad.yaml:1: steps[0].step: 'mov' is not a step; choices: move, "),
])
def test_bad_input_is_one_line(tmp_path: Path, arguments: tuple[str, ...], problem: str) -> None:
    written(tmp_path, RIGHT)
    written(tmp_path, "steps: [{step: mov}]", "bad")
    done = ask(tmp_path, "program", *arguments)
    assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (2, "", 1)
    assert done.stderr.startswith(f"zencell: {problem}")


def test_run_refuses_a_cell_for_what_is_no_program(tmp_path: Path) -> None:
    done = ask(tmp_path, "run", "panda", "--cell", "ur5")
    assert (done.returncode, done.stderr) == (2, "zencell: --cell: 'ur5' is for a program, and 'panda' is a cell\n")


def test_function_whose_module_ends_the_process_is_reported(tmp_path: Path) -> None:
    (tmp_path / "ending.py").write_text("import sys\nsys.exit(0)\n")
    file = written(tmp_path, "steps: [{step: python, function: 'ending:f'}]")
    done = ask(tmp_path, "program", "check", file, "--cell", CELL)
    assert (done.returncode, done.stdout) == (2, "")
    assert "'ending:f' cannot be imported: SystemExit: 0" in done.stderr and done.stderr.count("\n") == 1


def test_exported_script_is_readable_python_for_every_kind_of_step(tmp_path: Path) -> None:
    (tmp_path / "functions_of_an_export.py").write_text("def measure(size):\n    return size\n")
    file = written(tmp_path, """\
cell: panda
steps:
  - {step: through, points: [home, {position: [0.4, 0.1, 0.5]}], blend: 0.05}
  - {step: move, to: {by: [0, 0, 0.1], frame: tool}, touch: [ball]}
  - {step: grip, width: open, holds: false}
  - {step: python, function: "functions_of_an_export:measure", arguments: {size: 2}, on_failure: continue}
  - {step: if, when: {outcome: succeeded}, then: [{step: until, force: 5}], else: [{step: insert, depth: 0.02}]}
  - step: palletize
    pattern: {item: [0.05, 0.05, 0.05], columns: 2}
    steps: [{step: pick, kind: ball}, {step: call, program: part}]
  - {step: place, at: home}
  - {step: approach, to: home}
  - {step: retreat}
""")
    written(tmp_path, "steps: [{step: wait, seconds: 1}]", "part")
    done = ask(tmp_path, "program", "export", file)
    assert (done.returncode, done.stderr) == (0, "")
    names = {node.name for node in ast.walk(ast.parse(done.stdout)) if isinstance(node, ast.FunctionDef)}
    assert names == {"program", "part"}
    for line in ("    do.wait(seconds=1.0)", "    do.grip(width='open', holds=False)",
                 "    do.python(on_failure='continue', function='functions_of_an_export:measure', ",
                 "        do.pick(kind='ball')", "        do.outcome = part(cell)"):
        assert line in done.stdout, line


def test_control_flow_visits_the_steps_in_order_and_waits_where_a_condition_is_unknown(tmp_path: Path) -> None:
    file = load_program(Path(written(tmp_path, """\
steps:
  - {step: loop, count: 0, steps: [{step: wait, id: never, seconds: 1}]}
  - step: loop
    count: 2
    steps:
      - {step: wait, id: a, seconds: 1}
      - {step: palletize, id: p, pattern: {item: [0.1, 0.1, 0.1], columns: 2}, steps: [{step: wait, id: b, seconds: 1}]}
  - {step: if, when: {holding: true}, then: [{step: wait, id: c, seconds: 1}]}
""")))
    flow = Flow({file.name: file}, file.name)
    seen, position = [], flow.start
    while position := flow.leaf(position, lambda condition, _: False):
        seen.append(flow.step(position).id)
        assert flow.contains(position) and flow.find("a")
        position = flow.after(position)
    assert seen == ["a", "b", "p", "b", "p"] * 2

    def unknown(condition: object, position: object) -> bool:
        raise Undecided

    with pytest.raises(Undecided):
        flow.leaf(flow.after(flow.find("p")[:1]), unknown)


def test_one_class_is_a_kind_of_step_in_files_on_the_page_and_in_a_dry_run(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    class Wipe(Motion):
        """Move the tool there and back: a step of a user."""

        step: Literal["wipe"] = "wipe"
        length: Distance = 0.1

        def __str__(self) -> str:
            return f"wipe {1e3 * self.length:g} mm"

        def stages(self, at: Builder) -> Built:
            start = at.before.T_world_tcp
            there = backed(start, self.length, "world")
            return at.built([at.motion(self, self.id, pose_goal(T), straight=True) for T in (there, start)], start)

    request.addfinalizer(lambda: STEPS.pop("wipe"))
    step = new_step("wipe", Known())
    assert str(parsed(step)) == "wipe 100 mm"
    shown = {each.label: each.shown for each in fields_of({**step, "id": "wipe1"}, Known())}
    assert (shown["Length [mm]"], shown["Speed [%]"]) == ("100", "")
    text = "steps: [{step: move, to: {position: [0.5, 0.1, 0.3]}}, {step: wipe, length: 0.05}]"
    found = rehearse(Path(written(tmp_path, text)), CELL)
    assert [(each.step, each.problem) for each in found.result.steps] == [("move1", ""), ("wipe1", "")]
    assert found.planned == 3 and "do.wipe(length=0.05)" in script(found.flow.files, "program", CELL)
    with pytest.raises(BadProgram, match=r"steps\[0\].length: 3 must be less than or equal to 2"):
        load_program(Path(written(tmp_path, "steps: [{step: wipe, length: 3}]")))
