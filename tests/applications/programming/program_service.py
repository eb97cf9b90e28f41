"""A service of programs in memory, and the console of a page that uses it."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from applications.programming.files import BadProgram, parse_program, text_of
from applications.programming.topics import (
    PROGRAM_COMMAND,
    PROGRAM_EDIT,
    PROGRAM_STATUS,
    ProgramCommand,
    ProgramContent,
    ProgramEdit,
    ProgramStatus,
)
from common import topics
from common.errors import RemoteError
from common.messages import MotionStatus
from page.console import ActionQueue


def revision_of(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


class Cell:
    """A cell whose programs are `files`; `commands` are those that it got.

    Attributes:
        notes: what was shown to operators.
        refusal: raised by the next command.
    """

    def __init__(self) -> None:
        self.files: dict[str, str] = {}
        self.commands: list[ProgramCommand] = []
        self.checked: list[str] = []
        self.notes: list[str] = []
        self.status = ProgramStatus()
        self.problems: list[str] = []
        self.refusal: RemoteError | None = None
        self.console: Any = ActionQueue()
        self.console.latest = {PROGRAM_STATUS.key: lambda: self.status, topics.MOTION_STATUS.key: MotionStatus}
        latest = self.console.latest
        self.console.latest = lambda topic: latest[topic.key]() if topic.key in latest else None
        self.console.acknowledged, self.console.call = 7, self.call
        self.console.is_available = lambda _request: True
        self.console.notify = lambda text, _kind="bad": self.notes.append(text)

    async def call(self, request: Any, message: Any) -> Any:
        if request is PROGRAM_EDIT:
            return self.edit(message)
        assert request is PROGRAM_COMMAND
        if self.refusal is not None and not message.override:
            raise self.refusal
        self.commands.append(message)
        return self.status

    def edit(self, message: ProgramEdit) -> ProgramContent:
        name, text = message.program, self.files.get(message.program, "")
        if message.act in ("save", "delete") and message.revision != (revision_of(text) if text else ""):
            raise RemoteError("program_runner", "changed", f"{name} was changed elsewhere")
        problems: list[str] = []
        if message.act in ("check", "save"):
            self.checked.append(message.text)
            try:
                text, problems = text_of(parse_program(message.text, Path(f"{name}.yaml")).program), self.problems
            except BadProgram as error:
                problems = error.problems
        if message.act == "save" and not problems:
            self.files[name] = text
        if message.act == "delete":
            del self.files[name]
        return ProgramContent(programs=sorted(self.files), program=name, text=text, problems=problems,
                              revision=revision_of(text) if name in self.files else "", poses=["home", "bin"],
                              signals=["door", "clamp"])
