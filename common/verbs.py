"""What the command line gives to the verbs of an application, and gets from it.

The part `verbs` of an application has, both optional:

    VERBS        {"name": function}: verbs; "task select" is one of the group `task`
    before_run   a function that is asked before `run` brings a cell up, with options of its own

They are written as typer has it. A parameter `context: typer.Context` has a `Shell` as its `obj`. Parameters named
cell, overrides, world, seed, domain and connect that say nothing of their own are the options that other verbs have
under these names; `cell` without a default is an argument. The keyword-only parameters of
`before_run(cell, overrides, world, *, ...)` become options of `run`.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

if TYPE_CHECKING:
    from common.config import Cell
    from common.messages import Message
    from common.topics import Request
    from common.transport.bus import Bus

T = TypeVar("T")


class Shell(Protocol):
    """The command line, as an application's verbs see it."""

    def send(
        self, request: Request[Any, Any], message: Message, cell: str | None, domain: str | None, connect: str | None
    ) -> None:
        """Send a request to a cell that is up and print the answer as JSON."""

    def visit(
        self, visit: Callable[[Bus], Awaitable[T]], cell: str, overrides: list[str] | None, world: str | None,
        seed: str | None, domain: str | None, connect: str | None,
    ) -> T:
        """What a visit to a cell returns: to one that is up, or one that is brought up for it without its task."""

    def parameters(self, cell: Cell, service: str) -> Any:
        """The checked parameters of a service of a cell."""


@dataclass(frozen=True)
class BeforeRun:
    """What a run starts with.

    Attributes:
        overrides: of the cell, those that were given among them.
        first: is done in the cell as soon as it is up, with the terminal kept free for a question.
    """

    overrides: list[str]
    first: Callable[[Bus], Awaitable[None]] | None = None
