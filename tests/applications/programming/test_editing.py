"""Edits of a program that is not saved yet."""

from __future__ import annotations

import copy
import random
from typing import Any

import pytest

from applications.programming import editing
from applications.programming.editing import Draft, EditRefused
from applications.programming.model import Program
from common.errors import ConfigError, UnknownName

HERE = {"joints": [0.0, 0.5]}
MOVE = {"step": "move", "to": "home"}
LOOP = {"step": "loop", "count": 2, "steps": [MOVE, {"step": "wait", "seconds": 1}]}
IF = {"step": "if", "when": {"signal": "door"}, "then": [MOVE], "else": []}


def draft(*steps: dict[str, Any]) -> Draft:
    found = Draft("one", {"steps": []})
    for step in steps:
        found.edit("add", editing.insert, "", step)
    return found


def outline(one: Draft) -> str:
    """Return the ids in order, each with a dot for each level."""
    return " ".join("." * row.depth + row.id for row in one.rows)


def test_every_step_gets_its_own_id() -> None:
    one = draft(MOVE, LOOP, MOVE)
    assert outline(one) == "move1 loop1 .move2 .wait1 move3"
    one.edit("copy", editing.duplicate, "loop1")
    assert outline(one) == "move1 loop1 .move2 .wait1 loop2 .move4 .wait2 move3"
    one.edit("add", editing.insert, "loop1", MOVE, "steps")
    one.edit("add", editing.insert, "move1", MOVE)
    assert outline(one) == "move1 move6 loop1 .move2 .wait1 .move5 loop2 .move4 .wait2 move3"


def test_step_moves_through_the_steps_around_it_and_back() -> None:
    one = draft(MOVE, IF, {"step": "wait", "seconds": 1})
    seen = []
    for _ in range(5):
        one.edit("down", editing.move, "move1", 1)
        seen.append(outline(one))
    assert seen == ["if1 .move1 .move2 wait1", "if1 .move2 .move1 wait1", "if1 .move2 .move1 wait1",
                    "if1 .move2 move1 wait1", "if1 .move2 wait1 move1"]
    assert one.data["steps"][0].get("else") == [], "it went through the list `else`"
    with pytest.raises(EditRefused, match="move1 is the last step"):
        one.edit("down", editing.move, "move1", 1)
    for _ in range(5):
        one.edit("up", editing.move, "move1", -1)
    assert outline(one) == "move1 if1 .move2 wait1"
    with pytest.raises(EditRefused, match="the first step"):
        one.edit("up", editing.move, "move1", -1)


def test_random_edits_keep_ids_unique_and_are_undone_to_the_start() -> None:
    rng = random.Random(7)
    one = draft(MOVE, LOOP, IF)
    start, made = copy.deepcopy(one.data), 0
    while made < 80:
        ids = [row.id for row in one.rows]
        id_ = rng.choice(ids) if ids else ""
        new = rng.choice([MOVE, LOOP, IF])
        change = rng.choice([(editing.insert, id_, new), (editing.move, id_, 1), (editing.move, id_, -1),
                             (editing.duplicate, id_), (editing.delete, id_)])
        before = one.data
        try:
            one.edit("edit", *change)
        except (EditRefused, UnknownName):
            assert one.data is before
        made += one.data is not before
        found = [row.id for row in one.rows]
        assert len(found) == len(set(found))
    for _ in range(made):
        one.undo()
    assert one.data == start


@pytest.mark.parametrize(("values", "reason"), [
    ({"speed": 2}, "speed: 2 must be less than or equal to 1"),
    ({"speed": float("nan")}, "speed: nan"),
    ({"to": {"joints": [0.0], "position": [0, 0, 0]}}, "exactly one of name, joints, position, by"),
    ({"to": "x" * 4000}, "to: 'xxxx"),
    ({"to": "home\n  - {step: python}"}, "must be one line"),
    ({"requires": {"a\x1b[31m": True}}, "must be one line"),
    ({"id": "../../etc/passwd"}, "id"),
    ({"id": "move2"}, "is the id of another step"),
    ({"step": "wait"}, "to"),
    ({"width": 1}, "is not a field; choices"),
])
def test_invalid_value_is_refused_with_one_line_and_changes_nothing(values: dict[str, Any], reason: str) -> None:
    one = draft(MOVE, MOVE)
    before = one.data
    with pytest.raises(ConfigError) as refused:
        one.edit("set", editing.set_fields, "move1", values)
    assert reason in str(refused.value) and "\n" not in str(refused.value)
    assert one.data is before and one.undoes == "add"


def test_field_is_set_and_removed() -> None:
    one = draft(MOVE)
    one.edit("set", editing.set_fields, "move1", {"speed": 0.5, "id": "first"})
    assert one.data["steps"] == [{"step": "move", "to": "home", "id": "first", "speed": 0.5}]
    one.edit("set", editing.set_fields, "first", {"speed": None})
    assert one.data["steps"] == [{"step": "move", "to": "home", "id": "first"}]


@pytest.mark.parametrize(("step", "field", "expected"), [
    (MOVE, "to", HERE), ({"step": "place", "at": "home"}, "at", HERE),
    ({"step": "through", "points": ["home"]}, "points", ["home", HERE])])
def test_present_pose_becomes_the_target_of_a_step(step: dict[str, Any], field: str, expected: Any) -> None:
    one = draft(step)
    one.edit("here", editing.set_target, f"{step['step']}1", HERE)
    assert one.data["steps"][0][field] == expected


def test_step_without_a_target_takes_no_pose() -> None:
    one = draft({"step": "wait", "seconds": 1})
    with pytest.raises(EditRefused, match="wait1 is a wait, which has no target"):
        one.edit("here", editing.set_target, "wait1", HERE)


def test_empty_lists_of_steps_are_reported_until_they_are_filled() -> None:
    one = draft()
    assert editing.problems(one.data) == {"": "a program needs at least one step"}
    one = draft(IF)
    assert editing.problems(one.data) == {}
    one.edit("delete", editing.delete, "move1")
    assert editing.problems(one.data) == {"if1": "then: needs at least one step"}
    one.edit("set", editing.set_fields, "if1", {"note": "checks the door"})


def test_nesting_and_number_of_steps_are_bounded() -> None:
    one = draft(LOOP)
    with pytest.raises(EditRefused, match="at most 10 levels"):  # noqa: PT012
        for number in range(20):
            one.edit("add", editing.insert, f"loop{number + 1}", LOOP, "steps")
    big = draft({**LOOP, "steps": [MOVE] * 900})
    with pytest.raises(EditRefused, match="at most 1000 steps"):
        big.edit("copy", editing.duplicate, "loop1")


def test_saving_and_reloading_keep_the_own_edits_for_undo() -> None:
    file = Program.model_validate({"steps": [{**MOVE, "id": "move1"}]})
    one = Draft.of("one", file, "r1")
    assert not one.unsaved
    one.edit("copy", editing.duplicate, "move1")
    assert one.unsaved and one.undoes == "copy"
    own = one.data
    other = Program.model_validate({"steps": [{"step": "wait", "seconds": 2, "id": "wait1"}]})
    one.reloaded(other, "r2")
    assert (one.revision, outline(one), one.unsaved) == ("r2", "wait1", False)
    one.undo()
    assert one.data == own and one.unsaved and one.revision == "r2"
    one.saved(Program.model_validate(own), "r3", own)
    assert not one.unsaved and one.revision == "r3"


def test_edit_during_a_save_remains_unsaved() -> None:
    one = Draft.of("one", Program.model_validate({"steps": [{**MOVE, "id": "move1"}]}), "r1")
    sent = one.data
    one.edit("copy", editing.duplicate, "move1")
    one.saved(Program.model_validate(sent), "r2", sent)
    assert one.unsaved and outline(one) == "move1 move2"
