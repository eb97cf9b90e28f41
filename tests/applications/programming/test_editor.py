"""Programs of a page: opening, saving, two editors of one file, and commands."""

from __future__ import annotations

import pytest

from applications.programming import editing
from applications.programming.editor import ProgramEditor, problems_by_step
from applications.programming.form import Known
from common.errors import ConfigError, RemoteError, ZencellError
from tests.applications.programming.program_service import Cell

KNOWN = Known(poses=["home", "bin"], signals=["door"], outputs=["clamp"], joints=[0.1, 0.2], scales=[57.3, 1000.0])
WAIT = "steps:\n  - {step: wait, id: wait1, seconds: 1.0}\n"


def editor_of(cell: Cell) -> ProgramEditor:
    return ProgramEditor(cell.console, lambda: KNOWN)


def new_program() -> tuple[Cell, ProgramEditor]:
    cell = Cell()
    one = editor_of(cell)
    one.new("load")
    return cell, one


async def opened(text: str = WAIT) -> tuple[Cell, ProgramEditor]:
    cell = Cell()
    cell.files["load"] = text
    one = editor_of(cell)
    await one.open("load")
    return cell, one


def ids(editor: ProgramEditor) -> list[str]:
    assert editor.draft is not None
    return [row.id for row in editor.draft.rows]


async def test_second_editor_never_overwrites_the_edits_of_the_first() -> None:
    cell = Cell()
    cell.files["load"] = WAIT
    one, other = editor_of(cell), editor_of(cell)
    for each in (one, other):
        await each.open("load")
    one.add("retreat", "wait1")
    await one.save()
    other.add("pick", "wait1")
    own = other.draft.data
    with pytest.raises(RemoteError, match="changed elsewhere"):
        await other.save()
    assert other.changed_elsewhere and "retreat" in cell.files["load"] and other.draft.data == own
    await other.reload()
    assert ids(other) == ["wait1", "retreat1"] and not other.changed_elsewhere
    other.undo()
    assert other.draft.data == own, "the own edits are not lost"
    await other.save()
    assert "pick" in cell.files["load"], "after that, the operator decided with knowledge of both"


async def test_draft_remains_while_another_program_is_open() -> None:
    cell = Cell()
    cell.files |= {"a": WAIT, "b": WAIT}
    one = editor_of(cell)
    await one.open("a")
    one.add("retreat", "wait1")
    await one.open("b")
    assert ids(one) == ["wait1"] and one.chosen == ""
    await one.open("a")
    assert ids(one) == ["wait1", "retreat1"] and one.draft.unsaved


@pytest.mark.parametrize(
    "name", ["", "../x", "a/b", "/etc/passwd", ".hidden", "a.yaml", "a b", "a\nb", "x" * 81, "ä", "C:x"])
async def test_name_that_could_lead_out_of_the_folder_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="must be 1 to 80 letters") as refused:
        editor_of(Cell()).new(name)
    assert "\n" not in str(refused.value)


async def test_program_is_deleted_at_the_second_request_only() -> None:
    cell, one = await opened()
    await one.delete()
    assert one.confirms_deletion and "load" in cell.files and "Press again" in cell.notes[-1]
    one.add("retreat", "wait1")
    await one.delete()
    assert "load" in cell.files, "an edit ends the confirmation"
    await one.delete()
    assert cell.files == {} and one.draft is None
    one.new("load")


async def test_program_that_was_changed_elsewhere_is_not_deleted() -> None:
    cell, one = await opened()
    cell.files["load"] += "note: of another operator\n"
    await one.delete()
    with pytest.raises(RemoteError, match="changed elsewhere"):
        await one.delete()
    assert "load" in cell.files and one.draft is not None


async def test_run_saves_first_and_names_operator_and_acknowledged_stops() -> None:
    cell, one = new_program()
    one.add("wait", "")
    await one.command("run_from", "wait1")
    (sent,) = cell.commands
    assert "load" in cell.files and not one.draft.unsaved
    assert (sent.command, sent.program, sent.step, sent.by, sent.acknowledged, sent.override) == (
        "run_from", "load", "wait1", "page", 7, False)


async def test_program_that_cannot_be_saved_is_not_run() -> None:
    cell, one = new_program()
    one.add("loop", "")
    with pytest.raises(ZencellError, match="loop1: steps: needs at least one step"):
        await one.command("run")
    one.add("wait", "loop1", "steps")
    cell.problems = ["load.yaml:3: steps[0].steps[0].seconds: too long"]
    with pytest.raises(ZencellError, match=r"load is not saved: load\.yaml:3"):
        await one.command("run")
    assert cell.commands == [] and one.problems == {"wait1": cell.problems[0]}
    await one.command("stop")
    assert [each.command for each in cell.commands] == ["stop"]


async def test_same_command_again_overrides_another_operator_until_something_changes() -> None:
    cell, one = await opened()
    cell.refusal = RemoteError("program_runner", "held", "anna holds the arm")
    await one.command("run")
    assert cell.commands == [] and "anna holds the arm: press again to override" in cell.notes[-1]
    cell.console.acknowledged = 9
    await one.command("run")
    assert cell.commands == [], "another interlock came meanwhile"
    await one.command("run")
    assert cell.commands[-1].override


async def test_check_assigns_problems_to_steps() -> None:
    cell, one = new_program()
    one.add("loop", "")
    await one.check()
    assert cell.checked == [], "an incomplete draft is not sent"
    one.add("wait", "loop1", "steps")
    one.add("move", "loop1")
    cell.problems = ["load.yaml:9: move1: out of reach by 120 mm", "load.yaml: cell: is unknown"]
    await one.check()
    assert one.problems == {"move1": cell.problems[0], "": cell.problems[1]}
    assert problems_by_step(one.draft, ["x.yaml:4: steps[0].steps[0].for.signal (wait1): is unknown"]) == {
        "wait1": "x.yaml:4: steps[0].steps[0].for.signal (wait1): is unknown"}
    assert editing.problems(one.draft.data) == {}
