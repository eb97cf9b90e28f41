"""Reading and writing of program files."""

from pathlib import Path

import pytest

from applications.programming.files import BadProgram, load_all, load_program, parse_program, save_program, text_of
from applications.programming.model import STEPS, walk
from common.errors import ConfigError

PATH = Path("programs/tend.yaml")
TEXT = """\
cell: panda
poses:
  bin: {joints: [0, 0, 0, -1.5, 0, 1.5, 0]}
steps:
  - {step: move, to: home}
  - step: loop
    count: 3
    steps:
      - {step: move, to: {by: [0, 0, 0.1], frame: tool}, straight: true}
      - {step: wait, for: {signal: door}, timeout: 3}
  - {step: if, when: {holding: true}, then: [{step: grip, width: open}], else: [{step: grip, width: 0.01}]}
  - {step: palletize, pattern: {item: [0.1, 0.1, 0.1], columns: 2}, steps: [{step: pick, kind: part}]}
"""


def test_program_is_written_as_it_was_read_and_every_step_has_an_id() -> None:
    file = parse_program(TEXT, PATH)
    assert parse_program(text_of(file.program), PATH).program == file.program
    assert list(file.steps) == ["move1", "loop1", "move2", "wait1", "if1", "grip1", "grip2", "palletize1", "pick1"]
    assert file.where(file.steps["wait1"]) == "tend.yaml:10: wait1"


@pytest.mark.parametrize(("text", "problem"), [
    ("steps: [}", ":1: does not parse: expected the node content, but found '}'"),
    ("steps:\n  - {step: move, to: {joints: [1.0e+308]}}",
     ":2: steps[0].to.joints[0]: 1e+308 must be less than or equal to 1000"),
    ("steps: []", ":1: steps: [] must have at least 1 of them"),
    ("cell: panda", ": steps: is missing"),
    ("steps:\n  - {step: move}", ":2: steps[0].to: is missing"),
    ("steps:\n  - {step: mov, to: home}", f":2: steps[0].step: 'mov' is not a step; choices: {', '.join(STEPS)}"),
    ("steps:\n  - {step: retreat, far: 1}", ":2: steps[0].far: 1 is not a field; choices: axis, distance, id, note, "
                                            "on_failure, requires, speed, step, touch"),
    ("steps:\n  - {step: move, to: {positio: [1, 2]}}",
     ":2: steps[0].to.positio: [1, 2] is not a field; choices: by, frame, joints, name, position, rpy, turn"),
    ("steps:\n  - {step: move, to: {joints: [1], by: [0, 0, 0]}}",
     ":2: steps[0].to: a target has exactly one of name, joints, position, by, not joints and by"),
    ("steps:\n  - {step: loop, steps: [{step: move, to: home},\n      {step: wait, for: {signa: x}}]}",
     ":3: steps[0].steps[1].for.signa: 'x' is not a field; choices: above, below, holding, outcome, signal, value"),
    ("steps:\n  - {step: wait}", ":2: steps[0]: a wait has exactly one of seconds, for"),
    ("steps:\n  - {step: until, force: 5, direction: [0, 0, 0]}",
     ":2: steps[0].direction: must not be 0 along all axes"),
    ("steps:\n  - {step: grip, width: 2}",
     ":2: steps[0].width: 2 must be less than or equal to 0.2, or must be 'open' or 'close'"),
    ("steps:\n  - {step: move, id: a, to: home}\n  - {step: move, id: a, to: home}",
     ":3: steps[1].id: 'a' is also the id of the step in line 2; each needs its own"),
    ("steps: [{step: move, id: a, to: home}, {step: move, id: a, to: home}]",
     ":1: steps[1].id: 'a' is also the id of the step in line 1; each needs its own"),
    ("steps: 5", ":1: steps: 5 must be a list"),
    ('"x\\ny": 3\nsteps: [{step: move, to: home}]',
     ": x y: 3 is not a field; choices: cell, note, poses, speed, steps"),
    ("speed: fast\nsteps: []", ":1: speed: 'fast' must be a valid number"),
    ("poses: {bin: 3}\nsteps: []", ":1: poses.bin: 3 must be a mapping"),
])
def test_error_names_file_line_step_field_and_choices(text: str, problem: str) -> None:
    with pytest.raises(BadProgram) as raised:
        parse_program(text, PATH)
    assert raised.value.problems[0] == f"{PATH}{problem}"


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        load_program(tmp_path / "none.yaml")


def test_called_programs_are_found_next_to_the_caller_and_recursion_is_refused(tmp_path: Path) -> None:
    main = tmp_path / "main.yaml"
    main.write_text("steps:\n  - {step: call, program: part}\n")
    with pytest.raises(BadProgram, match=r"main.yaml:2: steps\[0\].program \(call1\): unknown program 'part'"):
        load_all(load_program(main))
    part = parse_program("steps: [{step: move, to: home}]", tmp_path / "part.yaml")
    save_program(part)
    assert list(load_all(load_program(main))) == ["main", "part"]
    (tmp_path / "part.yaml").write_text("steps:\n  - {step: call, program: main}\n")
    with pytest.raises(BadProgram, match=r"part.yaml:2: .*'main' calls itself: main > part > main"):
        load_all(load_program(main))


def test_steps_are_found_in_all_bodies() -> None:
    places = [place for place, _ in walk(parse_program(TEXT, PATH).program.steps)]
    assert places[-4:] == ["steps[2].then[0]", "steps[2].else[0]", "steps[3]", "steps[3].steps[0]"]
