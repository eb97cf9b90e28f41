"""Edits of programs by the service: two editors of one file, names, and what runs meanwhile."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from applications.programming.topics import PROGRAM_EDIT, ProgramContent, ProgramEdit
from common.errors import RemoteError
from tests.simulated.program_cell import Operator, simulate

ONE = "steps:\n  - {step: move, id: there, to: {position: [0.45, 0.2, 0.4]}, speed: 0.2}\n"
TWO = ONE + "  - {step: move, id: back, to: home}\n"


async def edit(operator: Operator, act: str, program: str = "", **fields: Any) -> ProgramContent:
    client = operator.bus.client(PROGRAM_EDIT)
    return await client.call(ProgramEdit.model_validate({"act": act, "program": program, **fields}), 30.0)


async def refusal(operator: Operator, act: str, program: str, **fields: Any) -> tuple[str, str]:
    with pytest.raises(RemoteError) as refused:
        await edit(operator, act, program, **fields)
    return refused.value.code, str(refused.value)


def test_file_that_was_changed_since_it_was_read_is_neither_overwritten_nor_deleted(tmp_path: Path) -> None:
    (tmp_path / "one.yaml").write_text(ONE)

    async def visit(operator: Operator) -> None:
        first = await edit(operator, "load", "one")
        saved = await edit(operator, "save", "one", text=TWO, revision=first.revision)
        assert saved.revision not in ("", first.revision) and saved.programs == ["one"]
        for fields in ({"act": "save", "text": ONE, "revision": first.revision}, {"act": "save", "text": ONE},
                       {"act": "delete", "revision": first.revision}, {"act": "delete"}):
            code, line = await refusal(operator, program="one", **fields)
            assert code == "changed" and "one was changed elsewhere" in line and "\n" not in line
        assert "back" in (tmp_path / "one.yaml").read_text()
        both = await asyncio.gather(*(
            edit(operator, "save", "one", text=f"{TWO}note: {name}\n", revision=saved.revision) for name in "ab"),
            return_exceptions=True)
        assert sorted(type(each).__name__ for each in both) == ["ProgramContent", "RemoteError"], "one of the two"
        (newest,) = [each for each in both if isinstance(each, ProgramContent)]
        assert (await edit(operator, "load", "one")).text == newest.text
        await edit(operator, "delete", "one", revision=newest.revision)
        assert (await edit(operator, "list")).programs == []

    simulate(tmp_path, visit, limit=10.0, state="NOT ENDED")


def test_invalid_program_and_hostile_names_are_refused_with_a_line(tmp_path: Path) -> None:
    folder = tmp_path / "programs"
    folder.mkdir()

    async def visit(operator: Operator) -> None:
        for text, problem in (("steps: [{step: fly}]", "'fly' is not a step"), ("steps: [{step: move}]", "is missing")):
            invalid = await edit(operator, "save", "one", text=text)
            assert (invalid.revision, invalid.programs) == ("", []) and problem in invalid.problems[0]
        unknown = "steps:\n  - {step: move, id: move1, to: nowhere}\n"
        found = await edit(operator, "check", "one", text=unknown)
        assert found.text == unknown and "unknown pose 'nowhere'" in found.problems[0]
        for name in ("../out", "/tmp/out", "a/b", ".", "..", "x.yaml", "a b", "a" * 81):
            code, line = await refusal(operator, "save", name, text=ONE)
            assert code == "bad_program" and "is no name of a program" in line and "\n" not in line

    simulate(folder, visit, limit=10.0, state="NOT ENDED")
    assert [each.name for each in tmp_path.iterdir()] == ["programs"] and not list(folder.iterdir())


def test_breakpoint_of_another_program_is_refused_while_one_runs(tmp_path: Path) -> None:
    (tmp_path / "one.yaml").write_text(ONE)
    (tmp_path / "two.yaml").write_text(TWO)

    async def visit(operator: Operator) -> None:
        await operator.send("run", program="one")
        await operator.until(lambda status: status.state == "RUNNING")
        with pytest.raises(RemoteError, match="one is at step there"):
            await operator.send("breakpoint", program="two", step="back")
        assert (await operator.until(lambda status: status.state == "DONE")).program == "one"
        first = await edit(operator, "load", "one")
        await edit(operator, "save", "one", text=TWO, revision=first.revision)
        status = await operator.send("breakpoint", program="one", step="back")
        assert status.breakpoints == ["back"], "a step that the file has since then"

    simulate(tmp_path, visit)


def test_dry_run_ends_when_the_program_runs(tmp_path: Path) -> None:
    (tmp_path / "two.yaml").write_text(TWO)

    async def visit(operator: Operator) -> None:
        await operator.send("dry_run", program="two", paced=True)
        await operator.until(lambda status: status.rehearsal.state == "running" and bool(status.rehearsal.steps))
        await operator.send("run", program="two")
        ended = await operator.until(lambda status: status.rehearsal.state == "failed")
        assert ended.rehearsal.message == "ended, as the program runs"
        await operator.until(lambda status: status.state == "DONE")

    simulate(tmp_path, visit)
