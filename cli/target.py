"""Where a verb is done: a cell that is up, or what its options name, and short visits to it."""

from __future__ import annotations

import asyncio
import functools
import inspect
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import aclosing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import typer

from cli import options
from common.terminal import echo

if TYPE_CHECKING:
    from common.client.cell import Cell
    from common.client.joining import RunningCell
    from common.messages import Message
    from common.transport.bus import Bus

T = TypeVar("T")
Verb = TypeVar("Verb", bound=Callable[..., Any])


@dataclass(frozen=True)
class CellTarget:
    """A cell that is up, by the options --cell, --domain and --connect.

    Its methods raise NoCellRunning without a router or a cell, and UnknownName if several cells are up and none was
    named, or if another one was.
    """

    cell: str | None = None
    domain: str | None = None
    connect: str | None = None

    def visit(
        self, visit: Callable[[Bus], Awaitable[T]], *, any_cell: bool = False, identity: str | None = None
    ) -> T:
        """What a visit to the cell's network returns.

        Args:
            visit: is called with a bus in the cell.
            any_cell: the visit is to the network, no cell needs to be up.
            identity: whose certificate is shown in a secured cell; the operator's if not given.
        """
        from common.client.joining import joined
        from common.transport.credentials import OPERATOR

        async def visited() -> T:
            cell = None if any_cell else self.cell
            async with joined(cell, domain=self.domain, connect=self.connect, any_cell=any_cell,
                              identity=identity or OPERATOR) as bus:
                return await visit(bus)

        return asyncio.run(visited())

    def join(self, visit: Callable[[Cell], Awaitable[T]]) -> T:
        """What is done in the cell, as a program with the client does it."""
        from common.client.cell import Cell

        async def joined() -> T:
            async with Cell(self.cell, domain=self.domain, connect=self.connect) as client:
                return await visit(client)

        return asyncio.run(joined())

    def answer(self, visit: Callable[[Cell], Awaitable[Message]]) -> None:
        """Print what a program with the client gets for an answer, as JSON."""
        from common.messages.schema import to_json

        echo(to_json(self.join(visit).model_dump()))

    def show(self, lines: Callable[[Bus], AsyncGenerator[str, None]], most: int | None) -> None:
        """Write lines as they come in the cell, until there are so many."""

        async def visit(bus: Bus) -> None:
            shown = 0
            async with aclosing(lines(bus)) as coming:
                async for line in coming:
                    echo(line)
                    shown += 1
                    if shown == most:
                        return

        self.visit(visit)

    def look(self) -> dict[str, RunningCell]:
        """The cells that are up, by name; none when nothing is up there."""
        from common.client.joining import look

        return asyncio.run(look(self.domain, self.connect))


RUNNING = CellTarget()  # the one cell that is up, where ZENCELL_DOMAIN or ZENCELL_CONNECT say
_OPTIONS = {"cell": options.CellName, "domain": options.Domain, "connect": options.Connect}


class CommandGroup(typer.Typer):
    """A group of verbs; the parameter `at: CellTarget` of one is what --cell, --domain and --connect say."""

    def __init__(self, about: str = "", **settings: Any) -> None:
        """A group with a line about it."""
        super().__init__(**{"help": about, "no_args_is_help": True, **settings})

    def command(self, *name: Any, **settings: Any) -> Callable[[Verb], Verb]:
        """What adds a verb, as typer's does."""
        add = super().command(*name, **settings)

        def added(verb: Verb) -> Verb:
            add(_with_options(verb))
            return verb

        return added


def _with_options(verb: Callable[..., T]) -> Callable[..., T]:
    """The verb with the options of its place: --cell where `at` stands, the others last, as in all verbs."""
    signature = inspect.signature(verb, eval_str=True)
    if not isinstance(getattr(signature.parameters.get("at"), "default", None), CellTarget):
        return verb

    @functools.wraps(verb)
    def placed(cell: str | None, domain: str | None, connect: str | None, **given: Any) -> T:
        return verb(**given, at=CellTarget(cell, domain, connect))

    made = {name: inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=None, annotation=annotation)
            for name, annotation in _OPTIONS.items()}
    shown = [made.pop("cell") if name == "at" else each for name, each in signature.parameters.items()]
    placed.__signature__ = signature.replace(parameters=[*shown, *made.values()])  # type: ignore[attr-defined]
    return placed
