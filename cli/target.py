"""The running cell that a command works on, from its options --cell, --domain and --connect."""

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
Command = TypeVar("Command", bound=Callable[..., Any])


@dataclass(frozen=True)
class CellTarget:
    """A running cell, by the options --cell, --domain and --connect.

    Its methods raise NoCellRunning without a router or a cell, and UnknownName if several cells are running and none
    was named.
    """

    cell: str | None = None
    domain: str | None = None
    connect: str | None = None

    def visit(
        self, visit: Callable[[Bus], Awaitable[T]], *, any_cell: bool = False, identity: str | None = None
    ) -> T:
        """Join the cell's network and return the result of `visit`.

        Args:
            visit: called with a bus in the cell.
            any_cell: join the network; no cell needs to be running.
            identity: certificate to use in a secured cell; default: the operator's.
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
        """Join the cell with the Python client and return the result of `visit`."""
        from common.client.cell import Cell

        async def joined() -> T:
            async with Cell(self.cell, domain=self.domain, connect=self.connect) as client:
                return await visit(client)

        return asyncio.run(joined())

    def answer(self, visit: Callable[[Cell], Awaitable[Message]]) -> None:
        """Join the cell with the Python client and print the result of `visit` as JSON."""
        from common.messages.schema import to_json

        echo(to_json(self.join(visit).model_dump()))

    def show(self, lines: Callable[[Bus], AsyncGenerator[str, None]], most: int | None) -> None:
        """Write lines as they come from the cell, at most that many."""

        async def visit(bus: Bus) -> None:
            shown = 0
            async with aclosing(lines(bus)) as coming:
                async for line in coming:
                    echo(line)
                    shown += 1
                    if shown == most:
                        return

        self.visit(visit)

    def running_cells(self) -> dict[str, RunningCell]:
        """Return the running cells by name."""
        from common.client.joining import running_cells

        return asyncio.run(running_cells(self.domain, self.connect))


RUNNING = CellTarget()  # the only running cell, at ZENCELL_DOMAIN or ZENCELL_CONNECT
_OPTIONS = {"cell": options.CellName, "domain": options.Domain, "connect": options.Connect}


class CommandGroup(typer.Typer):
    """A group of commands; a parameter `at: CellTarget` becomes the options --cell, --domain and --connect."""

    def __init__(self, about: str = "", **settings: Any) -> None:
        """Create a group with a line of help."""
        super().__init__(**{"help": about, "no_args_is_help": True, **settings})

    def command(self, *name: Any, **settings: Any) -> Callable[[Command], Command]:
        """Return a decorator that adds a command, like typer's."""
        add = super().command(*name, **settings)

        def added(command: Command) -> Command:
            add(_with_options(command))
            return command

        return added


def _with_options(command: Callable[..., T]) -> Callable[..., T]:
    """Replace `at` by its options: --cell in its position, the others last, as in all commands."""
    signature = inspect.signature(command, eval_str=True)
    if not isinstance(getattr(signature.parameters.get("at"), "default", None), CellTarget):
        return command

    @functools.wraps(command)
    def targeted(cell: str | None, domain: str | None, connect: str | None, **given: Any) -> T:
        return command(**given, at=CellTarget(cell, domain, connect))

    added = {name: inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=None, annotation=annotation)
             for name, annotation in _OPTIONS.items()}
    shown = [added.pop("cell") if name == "at" else each for name, each in signature.parameters.items()]
    targeted.__signature__ = signature.replace(parameters=[*shown, *added.values()])  # type: ignore[attr-defined]
    return targeted
