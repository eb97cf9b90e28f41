"""Edit and run programs from the page: drafts, the file of each, and the requests. No user interface."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from applications.programming import editing
from applications.programming.editing import Data, Draft, EditRefused
from applications.programming.files import BadProgram, parse_program, text_of
from applications.programming.form import FormField, Known, new_step
from applications.programming.model import Program
from applications.programming.topics import (
    PROGRAM_COMMAND,
    PROGRAM_EDIT,
    PROGRAM_STATUS,
    ProgramCommand,
    ProgramContent,
    ProgramEdit,
)
from common.config import check
from common.errors import ConfigError, RemoteError
from page.status_text import error_text

if TYPE_CHECKING:
    from page.console import Console

NAME = re.compile(r"[A-Za-z0-9_-]{1,80}")
MOVES = ("run", "run_from", "step", "resume")  # commands after which the arm may move


class ProgramEditor:
    """The open program and the chosen step. Drafts stay until the page's server ends, also while another one is open.

    Attributes:
        content: newest answer of the service: names of programs, poses and signals.
        draft: of the open program.
        chosen: id of the chosen step, or empty.
        point: number of the point of a `through` that the form shows.
        problems: what the newest check found, by the id of the step; "" for the program.
        changed_elsewhere: whether the file of the open program has another content than the one it was read with.
    """

    def __init__(self, console: Console, known: Callable[[], Known]) -> None:
        """Start without a program; `known` returns what a new step may name, and the present pose."""
        self._console, self._known = console, known
        self._drafts: dict[str, Draft] = {}
        self.content = ProgramContent()
        self.draft: Draft | None = None
        self.chosen, self.point = "", 0
        self.problems: dict[str, str] = {}
        self.changed_elsewhere = False
        self._rejected: object = None  # command; sending it again overrides another operator
        self._deletion = ""  # name of a program whose deletion waits for a second press

    @property
    def step(self) -> Data | None:
        """Data of the chosen step."""
        return self.draft.step(self.chosen) if self.draft is not None else None

    @property
    def confirms_deletion(self) -> bool:
        """Whether the next request to delete the open program does so."""
        return self.draft is not None and self._deletion == self.draft.name

    @property
    def incomplete(self) -> str:
        """Why there is nothing to save or run; empty if there is."""
        if self.draft is None:
            return "open a program first"
        return next((f"{id_}: {why}".removeprefix(": ") for id_, why in editing.problems(self.draft.data).items()), "")

    # --- files ---

    async def refresh(self) -> None:
        """Read the names of the programs."""
        await self._request("list", "")

    async def open(self, name: str) -> None:
        """Open a program: its draft if there is one, else its file. Raises ConfigError."""
        draft = self._drafts.get(name)
        if draft is None:
            content = await self._request("load", name)
            draft = Draft.of(name, _program(name, content), content.revision)
        self._show(draft)

    def new(self, name: str) -> None:
        """Start a program without steps; its file is written by `save`. Raises ConfigError."""
        if not NAME.fullmatch(name):
            raise ConfigError("program", name[:40], "must be 1 to 80 letters, digits, - and _")
        if name in self._drafts or name in self.content.programs:
            raise ConfigError("program", name, "exists: open it, or enter another name")
        self._show(Draft(name, {"steps": []}))

    async def save(self) -> None:
        """Write the draft to its file. Raises EditRefused, BadProgram, RemoteError."""
        draft, text = self._draft_text()
        sent = draft.data
        try:
            content = await self._request("save", draft.name, text, draft.revision)
        except RemoteError as error:
            self.changed_elsewhere = self.changed_elsewhere or error.code == "changed"
            raise
        self._note_problems(draft, content)
        if not content.revision:
            raise BadProgram([f"{draft.name} is not saved: {content.problems[0]}"])
        draft.saved(_program(draft.name, content), content.revision, sent)
        self.changed_elsewhere = False
        self._console.notify(f"{draft.name} is saved", "good")

    async def reload(self) -> None:
        """Take the content of the file; `undo` then returns to the steps of this page."""
        draft = self._required()
        content = await self._request("load", draft.name)
        draft.reloaded(_program(draft.name, content), content.revision)
        self._show(draft)

    async def delete(self) -> None:
        """Delete the open program and its file on the second request."""
        draft = self._required()
        if self._deletion != draft.name:
            self._deletion = draft.name
            self._console.notify(f"Press again to delete {draft.name} with its file", "busy")
            return
        self._deletion = ""
        if draft.revision:
            await self._request("delete", draft.name, revision=draft.revision)
        self._drafts.pop(draft.name, None)
        self.draft, self.chosen, self.problems = None, "", {}
        self._console.notify(f"{draft.name} is deleted", "good")

    async def check(self) -> None:
        """Have the service check the draft: names of poses, signals and programs, and reach."""
        if not self.incomplete:
            draft, text = self._draft_text()
            self._note_problems(draft, await self._request("check", draft.name, text))

    def _draft_text(self) -> tuple[Draft, str]:
        draft = self._required()
        if self.incomplete:
            raise EditRefused(self.incomplete)
        return draft, text_of(Program.model_validate(draft.data))

    def _note_problems(self, draft: Draft, content: ProgramContent) -> None:
        if draft is self.draft:
            self.problems = problems_by_step(draft, content.problems)

    async def _request(self, act: str, name: str, text: str = "", revision: str = "") -> ProgramContent:
        request = check(ProgramEdit, {"act": act, "program": name, "text": text, "revision": revision,
                                      "by": self._console.permissions.client_name}, "program")
        content = await self._console.call(PROGRAM_EDIT, request)
        self.content = content if act != "check" else content.model_copy(update={"programs": self.content.programs})
        return content

    def _show(self, draft: Draft) -> None:
        self._drafts[draft.name], self.draft = draft, draft
        self.chosen, self.point, self.problems, self.changed_elsewhere, self._deletion = "", 0, {}, False, ""

    def _required(self) -> Draft:
        if self.draft is None:
            raise EditRefused("open a program first")
        return self.draft

    # --- edits ---

    def choose(self, id_: str, point: int = 0) -> None:
        """Choose a step."""
        self.chosen, self.point = id_, point

    def edit(self, text: str, change: Callable[..., str | None], *values: Any) -> None:
        """Make an edit of editing.py, and choose the step that it returns."""
        self._deletion = ""
        chosen = self._required().edit(text, change, *values)
        if chosen is not None:
            self.choose(chosen)

    def add(self, kind: str, after: str, inside: str = "") -> None:
        """Add a step of a kind below another one, or in its list of steps, and choose it."""
        self.edit(f"add {kind}", editing.insert, after, new_step(kind, self._known()), inside)

    def add_here(self, after: str, *, tool: bool = False) -> None:
        """Add a motion to the present pose, by its joint positions or by the pose of the tool."""
        self.edit("add move", editing.insert, after, {"step": "move", "to": self._known().here(tool=tool)})

    def use_present_pose(self, id_: str, *, add: bool = False) -> None:
        """Make the present joint positions the target of a step; of several the chosen one, unless they are added."""
        self.edit(f"change {id_}", editing.set_target, id_, self._known().here(), None if add else self.point)

    def apply(self, id_: str, field: FormField, shown: Any) -> None:
        """Set a field of a step to a displayed value. Raises ConfigError."""
        step = self._required().step(id_)
        if step is not None:
            values = field.values(step, shown)
            self.edit(f"change {id_}", editing.set_fields, id_, values)
            if self.chosen == id_:
                self.chosen = values.get("id", id_)

    def undo(self) -> None:
        """Take back the newest edit."""
        self._required().undo()

    # --- run ---

    async def command(self, command: str, step: str = "", *, enabled: bool = True, paced: bool = False) -> None:
        """Send a command for the open program, with fields of `ProgramCommand`; what was not saved is saved first.

        Raises:
            RemoteError: it is refused; if another operator holds the arm, the same command again overrides that.
        """
        console, name = self._console, ""
        if command not in ("pause", "stop", "resume"):
            draft = self._required()
            name = draft.name
            if draft.unsaved:
                await self.save()
        status = console.latest(PROGRAM_STATUS)
        request = (command, name, step, console.acknowledged, status.step if status else "")
        override, self._rejected = self._rejected == request and command in MOVES, None
        message = check(ProgramCommand, {
            "command": command, "program": name, "step": step, "enabled": enabled, "paced": paced, "override": override,
            "by": console.permissions.client_name, "acknowledged": console.acknowledged}, "program")
        console.notify("")
        try:
            await console.call(PROGRAM_COMMAND, message)
        except RemoteError as error:
            if error.code in ("held", "not_owner") and command in MOVES:
                self._rejected = request
                console.notify(f"{error_text(error)}: press again to override")
                return
            raise


def _program(name: str, content: ProgramContent) -> Program:
    if not content.text:  # the file is invalid
        raise BadProgram(content.problems[:1])
    return parse_program(content.text, Path(f"{name}.yaml")).program


_PATH = re.compile(r"steps\[\d+\](?:\.(?:steps|then|else)\[\d+\])*")


def problems_by_step(draft: Draft, problems: list[str]) -> dict[str, str]:
    """Return the first problem of each step by its id; "" for those that name no step of the draft.

    A line names the path of the step in the file, or its id between colons or parentheses.
    """
    ids, found = {row.path: row.id for row in draft.rows}, dict[str, str]()
    for problem in problems:
        path = _PATH.search(problem)
        id_ = ids.get(path[0], "") if path else next(
            (id_ for id_ in ids.values() if re.search(rf"[:(] ?{re.escape(id_)}[:)]", problem)), "")
        found.setdefault(id_, problem)
    return found
