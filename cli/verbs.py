"""Verbs and options of applications: built-in ones, and the custom application of a cell file."""

from __future__ import annotations

import contextlib
import importlib
import inspect
from collections.abc import Awaitable, Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_type_hints

import typer

from cli import options
from cli.options import CellTarget
from common.application import Application, applications, find_application
from common.errors import ConfigError
from common.verbs import BeforeRun, Verbs

if TYPE_CHECKING:
    from common.config import Cell
    from common.messages import Message
    from common.topics import Request
    from common.transport.bus import Bus

T = TypeVar("T")

SHARED = {
    "overrides": options.Overrides, "world": options.WorldName, "seed": options.Seed, "domain": options.Domain,
    "connect": options.Connect,
}


class CommandShell:
    """See `common.verbs.Shell`."""

    def send(
        self, request: Request[Any, Any], message: Message, cell: str | None, domain: str | None, connect: str | None
    ) -> None:
        """Send a request to a cell that is up and print the answer as JSON."""
        from cli.commands import send

        send(CellTarget(cell, domain, connect), request, message)

    def visit(
        self, visit: Callable[[Bus], Awaitable[T]], cell: str, overrides: list[str] | None, world: str | None,
        seed: str | None, domain: str | None, connect: str | None,
    ) -> T:
        """Call `visit` in the running cell, or bring the cell up without its task for it; return the result."""
        from cli.session.session import CellSession
        from common.config import load_cell
        from common.supervision.launch import require_free_port, router_location
        from common.transport.endpoint import endpoint_of
        from common.transport.router import PortInUse

        number, endpoint = router_location(domain, connect)
        try:
            if endpoint is None:
                require_free_port(endpoint_of(number))
            is_up = endpoint is not None
        except PortInUse:  # a router of zencell may have the port
            is_up = True
        if is_up:
            name = load_cell(cell, tuple(overrides or ()), world=world).name
            return CellTarget(name, domain, connect).visit(visit)
        operation = CellSession(cell, overrides, world=world, seed=options.whole("--seed", seed, 0), domain=domain,
                              connect=connect, no_viewer=True)
        operation.leave_out(operation.cell.task)
        return operation.visit(visit)

    def parameters(self, cell: Cell, service: str) -> Any:
        """Return the validated parameters of a service of a cell."""
        from common.config import service_config

        found = (entry.module for entry in cell.services.values() if entry.name == service)
        return service_config(cell, service, importlib.import_module(next(found, f"services.{service}")).Config)


class ApplicationVerbs:
    """Adds the verbs and options of applications to the command line."""

    def __init__(self, app: typer.Typer, groups: dict[str, typer.Typer], run: Callable[..., None], last: str) -> None:
        """Start without applications.

        Args:
            app: the command that gets the verbs.
            groups: command groups by name, which get verbs such as `task select`.
            run: the verb that gets additional options; receives them as keywords.
            last: the parameter of `run` before which the help lists these options.
        """
        self._app, self._groups, self._run, self._last = app, groups, run, last
        self.known: set[str] = set()

    def take_all(self) -> None:
        """Add the verbs and options of the built-in applications."""
        for found in applications():
            self.take(found)

    def take_own(self, arguments: Sequence[str]) -> None:
        """Add those of custom applications of cell files on the command line."""
        for name in own_applications(arguments):
            with contextlib.suppress(ConfigError):  # loading the cell reports the error
                self.take(find_application(name))

    def take(self, application: Application) -> None:
        """Add the verbs and options of one application once."""
        if application.name not in self.known and application.verbs is not None:
            self.take_verbs(application.verbs)
        self.known.add(application.name)

    def take_verbs(self, verbs: Verbs) -> None:
        """Add commands and options."""
        for name, text in verbs.groups.items():
            if name not in self._groups:
                self._groups[name] = options.CommandGroup(text)
                self._app.add_typer(self._groups[name], name=name)
        for name, verb in verbs.commands.items():
            group, _, last = name.rpartition(" ")
            (self._groups[group] if group else self._app).command(last)(with_shared_options(verb))
        if verbs.before_run is not None:
            add_options(self._run, verbs.before_run, self._last)
            BEFORE_RUN.append(verbs.before_run)


BEFORE_RUN: list[Callable[..., BeforeRun]] = []


def before_run(cell: str, overrides: list[str] | None, world: str | None, given: dict[str, Any]) -> BeforeRun:
    """Return overrides and first action of a run, after the hooks of all applications.

    Args:
        cell: name or path.
        overrides: values of `--set`.
        world: name or path of another world.
        given: values of options that applications added to `run`, by parameter name.
    """
    so_far = BeforeRun(list(overrides or ()))
    for before in BEFORE_RUN:
        names = inspect.signature(before).parameters
        found = before(so_far.cell or cell, so_far.overrides, world, **{n: given[n] for n in given if n in names})
        so_far = found.following(so_far)
    return so_far


def with_shared_options(verb: Callable[..., None]) -> Callable[..., None]:
    """Annotate a verb's bare parameters with the shared options of the same names."""
    hints = get_type_hints(verb, include_extras=True)
    for name, parameter in inspect.signature(verb).parameters.items():
        if hasattr(hints[name], "__metadata__"):
            continue
        if name == "cell":
            hints[name] = options.CellArgument if parameter.default is parameter.empty else options.CellName
        elif name in SHARED:
            hints[name] = SHARED[name]
    verb.__annotations__ = hints
    return verb


def add_options(run: Callable[..., None], before: Callable[..., BeforeRun], last: str) -> None:
    """Add the keyword-only parameters of `before` to a verb as options, before its parameter `last`."""
    signature = inspect.signature(run, eval_str=True)
    parameters = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    more = [p for p in inspect.signature(before, eval_str=True).parameters.values() if p.kind is p.KEYWORD_ONLY]
    at = next(i for i, parameter in enumerate(parameters) if parameter.name == last)
    parameters[at:at] = [p.replace(kind=p.POSITIONAL_OR_KEYWORD) for p in more]
    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]


def own_applications(arguments: Sequence[str]) -> Iterator[str]:
    """Yield the application modules (dotted names) of the cell files on the command line."""
    for argument in arguments:
        path = Path(argument.rpartition("=")[2])
        if path.suffix == ".yaml" and path.is_file():
            from common.config import read_yaml  # imported late: completion must be fast

            with contextlib.suppress(ConfigError):
                name = read_yaml(path).get("application")
                if isinstance(name, str) and "." in name:
                    yield name
