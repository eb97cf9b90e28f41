"""Parameters of running services: list, read and change them."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Generator, Iterable, Mapping
from typing import Any

from pydantic_core import to_jsonable_python

from common import topics
from common.client.arguments import require_text
from common.client.joining import TOKENS_TIMEOUT, operator_name
from common.client.subscriptions import Part
from common.config import check
from common.errors import ConfigError, NoResponder, RemoteError, RequestFailed, UnknownName, ZencellError
from common.messages import Parameter, ParameterRequest
from common.transport.bus import Bus
from common.transport.session import serves_key

TIMEOUT = 5.0  # [s] for a service to answer
BAD_INPUT = ("unknown_parameter", "bad_value")  # codes of refusals that are the caller's fault


class Listing:
    """Parameters by service, and the errors of services that did not answer."""

    def __init__(self, answers: Mapping[str, list[Parameter] | RequestFailed]) -> None:
        self.parameters = {name: answer for name, answer in answers.items() if not isinstance(answer, RequestFailed)}
        self._failures = [answer for answer in answers.values() if isinstance(answer, RequestFailed)]

    def raise_first(self) -> None:
        """Raise the error of the first service that did not answer, if any.

        Raises:
            RequestFailed: this error.
        """
        if self._failures:
            raise self._failures[0]


async def tunable_services(bus: Bus) -> list[str]:
    """Return the services of the cell that serve their parameters.

    Raises:
        NoResponder: there is none.
    """
    tokens = await bus.raw_tokens(serves_key(bus.cell, "param/*"), TOKENS_TIMEOUT)
    names = {token.rpartition("/")[2] for token in tokens}
    if not names:
        raise NoResponder(f"{bus.cell}/param/*")
    return sorted(names)


async def listing(bus: Bus, services: Iterable[str] | None) -> Listing:
    """Return the parameters of some services, or of all.

    Raises:
        UnknownName: a service that serves none; with the choices.
    """
    there = await tunable_services(bus)
    names = there if services is None else list(dict.fromkeys(services))
    for name in names:
        if name not in there:
            raise UnknownName("service", name, there)

    async def answer(name: str) -> list[Parameter] | RequestFailed:
        try:
            return await request_parameters(bus, name)
        except RequestFailed as error:
            return error

    answers = await asyncio.gather(*(answer(name) for name in names))
    return Listing(dict(zip(names, answers, strict=True)))


async def request_parameters(
    bus: Bus, service: str, changes: Mapping[str, Any] | None = None, *, dry_run: bool = False
) -> list[Parameter]:
    """Return the parameters of a service, after optional changes.

    Raises:
        ZencellError: a change is not valid.
        RequestFailed: the service refuses, or does not answer.
    """
    values = {"set": dict(changes or {}), "dry_run": dry_run, "by": f"{operator_name()}/{os.getpid()}"}
    request = check(ParameterRequest, values)
    try:
        return (await bus.client(topics.parameters_of(service)).call(request, TIMEOUT)).parameters
    except RemoteError as error:
        raise ZencellError(error.message) if error.code in BAD_INPUT else RequestFailed(error.message) from None


async def look_up(bus: Bus, paths: Iterable[str]) -> dict[str, tuple[str, Parameter]]:
    """Return service and parameter for each path.

    Raises:
        UnknownName: an unknown service or parameter; with the choices.
        RequestFailed: a service that may have the parameter does not answer.
    """
    there = await tunable_services(bus)
    full = {path: f"services.{path}" if path.partition(".")[0] in there else path for path in paths}
    owners = {path: path.split(".")[1] if path.startswith("services.") else None for path in full.values()}
    # A section such as motion does not name its service.
    found = await listing(bus, None if None in owners.values() else [name for name in owners.values() if name])
    known = {p.path: (name, p) for name, parameters in found.parameters.items() for p in parameters}
    for path, owner in owners.items():
        if owner is not None and owner not in there:
            raise UnknownName("service", owner, there)
        if path not in known:
            found.raise_first()  # that service may have it
            choices = [p for p in known if owner is None or known[p][0] == owner]
            if owner is None:
                choices = [p for p in known if not p.startswith("services.")] + [f"{name}..." for name in there]
            raise UnknownName("parameter", path, choices)
    return {path: known[full_path] for path, full_path in full.items()}


async def change(bus: Bus, values: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Change parameters by path, all of them or none; return the values before and after by full path.

    Raises:
        UnknownName: an unknown service or parameter; with the choices.
        ZencellError: a value is not valid.
        RequestFailed: a service refuses, or does not answer.
    """
    values = {path: _plain(path, value) for path, value in values.items()}
    found = await look_up(bus, values)
    changes_of: dict[str, dict[str, Any]] = {}
    for path, (service, parameter) in found.items():
        if parameter.value != values[path]:
            changes_of.setdefault(service, {})[parameter.path] = values[path]
    changed = {parameter.path: (parameter.value, parameter.value) for _, parameter in found.values()}
    for service, changes in changes_of.items():
        await request_parameters(bus, service, changes, dry_run=True)
    for service, changes in changes_of.items():
        parameters = await request_parameters(bus, service, changes)
        after = {parameter.path: parameter.value for parameter in parameters}
        if missing := next((path for path in changes if path not in after), None):
            raise RequestFailed(f"{service} did not report {missing} after the change")
        changed |= {path: (changed[path][0], after[path]) for path in changes}
    return changed


def _plain(path: str, value: object) -> Any:
    """Return a value as JSON: numpy numbers and arrays become numbers and lists.

    Raises:
        ConfigError: it cannot be the value of a parameter.
    """
    def from_numpy(other: Any) -> Any:
        return other.tolist()

    try:
        return to_jsonable_python(value, inf_nan_mode="constants", fallback=from_numpy)
    except (ValueError, TypeError, AttributeError):
        raise ConfigError(path, value, "must be a number, text, list or mapping") from None


async def dumped(bus: Bus, services: Iterable[str] | None, *, everything: bool = False) -> str:
    """Return the values that differ from the defaults, or all, as YAML in the form of a cell file.

    Raises:
        UnknownName: a service that serves no parameters; with the choices.
        RequestFailed: a service does not answer; a partial dump would look complete.
    """
    import yaml

    found = await listing(bus, services or None)
    found.raise_first()
    tree = tree_of(p for parameters in found.parameters.values() for p in parameters if everything or differs(p))
    head = f"# Parameters of {bus.cell}; read back with: zencell up {bus.cell} --set @FILE\n"
    return head + yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, allow_unicode=True, width=120)


def differs(parameter: Parameter) -> bool:
    """Return whether a cell file needs the value, so that the cell starts with it."""
    return parameter.changed or parameter.value != parameter.default


def tree_of(parameters: Iterable[Parameter]) -> dict[str, Any]:
    """Return the values as nested mappings, like a cell file.

    Raises:
        RequestFailed: a parameter lies inside the value of another one.
    """
    tree: dict[str, Any] = {}
    leaves: set[str] = set()
    for parameter in parameters:
        *above, name = parameter.path.split(".")
        if any(".".join(above[:depth]) in leaves for depth in range(1, len(above) + 1)):
            raise RequestFailed(f"{parameter.path} lies inside the value of another parameter")
        leaves.add(parameter.path)
        node = tree
        for part in above:
            node = node.setdefault(part, {})
        node[name] = parameter.value
    return tree


def range_text(choices: Iterable[str], low: float | None, high: float | None) -> str:
    """Return choices or bounds of a parameter in a few words."""
    if choices:
        return " | ".join(choices)
    if low is None or high is None:
        return f">= {low:g}" if low is not None else f"<= {high:g}" if high is not None else ""
    return f"{low:g} to {high:g}"


class Parameters(Part):
    """Parameters of a cell's services by path, as in `zencell param list`; `services.` may be omitted."""

    def __init__(self, bus: Bus) -> None:
        """Parameters of the services of a cell."""
        self._bus = bus

    def __getitem__(self, path: str) -> ParameterValue:
        """Return a parameter; await it to get the value."""
        return ParameterValue(self._bus, path)

    async def set(self, path: str, value: object) -> None:
        """Change one parameter; see `change`."""
        require_text("path", path)
        await change(self._bus, {path: value})

    async def update(self, values: Mapping[str, Any]) -> None:
        """Change several parameters, all of them or none; see `change`."""
        if not isinstance(values, Mapping):
            raise ConfigError("values", values, "must be a mapping of values by path")
        for path in values:
            require_text("path", path)
        await change(self._bus, values)

    async def all(self) -> dict[str, Any]:
        """Return all values by path."""
        found = await listing(self._bus, None)
        found.raise_first()
        return {p.path: p.value for parameters in found.parameters.values() for p in parameters}


class ParameterValue:
    """A parameter whose value is read when it is awaited.

    Raises:
        UnknownName: there is no such parameter; with the choices.
    """

    def __init__(self, bus: Bus, path: str) -> None:
        """A parameter by its path; nothing is read yet."""
        require_text("path", path)
        self._bus, self._path = bus, path

    async def get(self) -> Any:
        """Return the value."""
        return (await look_up(self._bus, [self._path]))[self._path][1].value

    def __await__(self) -> Generator[Any, None, Any]:
        return self.get().__await__()
