"""Interface between the command line and the commands (verbs) of an application."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

if TYPE_CHECKING:
    from common.config import Cell
    from common.messages import Message
    from common.topics import Request
    from common.transport.bus import Bus

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Verbs:
    """Commands of an application, written as typer functions.

    A parameter `context: typer.Context` has a `Shell` as its `obj`. Parameters named cell, overrides, world, seed,
    domain and connect without an annotation of their own are the options that other verbs have under these names;
    `cell` without a default is an argument.
    """

    commands: Mapping[str, Callable[..., None]] = field(default_factory=dict)
    """By name; "task select" is a command of the group `task`."""
    groups: Mapping[str, str] = field(default_factory=dict)
    """Further groups of commands by name, with their help."""
    before_run: Callable[..., BeforeRun] | None = None
    """`before_run(cell, overrides, world, *, ...)`, called before `run` or `up` starts a cell; its keyword-only
    parameters become options of `run`."""


class Shell(Protocol):
    """The command line, as an application's verbs see it."""

    def send(
        self, request: Request[Any, Any], message: Message, cell: str | None, domain: str | None, connect: str | None
    ) -> None:
        """Send a request to a running cell and print the answer as JSON."""

    def visit(
        self, visit: Callable[[Bus], Awaitable[T]], cell: str, overrides: list[str] | None, world: str | None,
        seed: str | None, domain: str | None, connect: str | None,
    ) -> T:
        """Return the result of `visit` in a running cell, or in one that is started for it without its task."""

    def parameters(self, cell: Cell, service: str) -> Any:
        """Return the validated parameters of a service of a cell."""


@dataclass(frozen=True)
class BeforeRun:
    """What a run starts with."""

    overrides: list[str]
    """Overrides of the cell, including those of the command line."""
    first: Callable[[Bus], Awaitable[None]] | None = None
    """Runs in the cell as soon as it is up, with the terminal reserved for a question."""
    cell: str = ""
    """Name or path of the cell to run instead of the given file; empty: that is the cell."""
    after: Callable[[], None] | None = None
    """Called after the end of the run, also after Ctrl-C."""
    check: Callable[[], None] | None = None
    """Called by `run` before anything starts; raises what would make its task fail."""

    def following(self, before: BeforeRun) -> BeforeRun:
        """Return this, with what an earlier hook has set and this one has not."""
        return BeforeRun(self.overrides, self.first or before.first, self.cell or before.cell,
                         self.after or before.after, self.check or before.check)

    def changed(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return the options of the run with its cell and overrides."""
        return {**given, "cell": self.cell or given["cell"], "overrides": self.overrides}

    def checked(self, work: Callable[[], T]) -> T:
        """Return the result of a run to the end of the task, as `ending` does, after `check`."""
        if self.check is not None:
            self.check()
        return self.ending(work)

    def ending(self, work: Callable[[], T]) -> T:
        """Return the result of the run, and call `after` at its end."""
        try:
            return work()
        finally:
            if self.after is not None:
                self.after()
