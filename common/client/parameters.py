"""Parameters of running services: what there is, and changing them."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Generator, Iterable, Mapping
from typing import Any

from pydantic_core import to_jsonable_python

from common import topics
from common.client.joining import LOOK_TIMEOUT, person
from common.client.part import Part
from common.config import check
from common.errors import ConfigError, NoResponder, RemoteError, RequestFailed, UnknownName, ZencellError
from common.messages import Parameter, ParameterRequest
from common.transport.bus import Bus
from common.transport.session import serves_key

TIMEOUT = 5.0  # [s] for a service to answer
BAD_INPUT = ("unknown_parameter", "bad_value")  # codes of a refusal that is the fault of what was asked for


class Listing:
    """The parameters of services by their names, and what became of those that did not answer."""

    def __init__(self, answers: Mapping[str, list[Parameter] | RequestFailed]) -> None:
        self.parameters = {name: answer for name, answer in answers.items() if not isinstance(answer, RequestFailed)}
        self._failures = [answer for answer in answers.values() if isinstance(answer, RequestFailed)]

    def raise_first(self) -> None:
        """Return when all services answered.

        Raises:
            RequestFailed: the first that did not.
        """
        if self._failures:
            raise self._failures[0]


async def serving(bus: Bus) -> list[str]:
    """The services of the cell that answer for their parameters.

    Raises:
        NoResponder: there is none.
    """
    names = [token.rpartition("/")[2] for token in await bus.raw_tokens(serves_key(bus.cell, "param/*"), LOOK_TIMEOUT)]
    if not names:
        raise NoResponder(f"{bus.cell}/param/*")
    return sorted(set(names))


async def listing(bus: Bus, wanted: Iterable[str] | None) -> Listing:
    """The parameters of services, or of all.

    Raises:
        UnknownName: a service that does not serve any; with the choices.
    """
    there = await serving(bus)
    names = there if wanted is None else list(dict.fromkeys(wanted))
    for name in names:
        if name not in there:
            raise UnknownName("service", name, there)

    async def answer(name: str) -> list[Parameter] | RequestFailed:
        try:
            return await ask(bus, name)
        except RequestFailed as error:
            return error

    answers = await asyncio.gather(*(answer(name) for name in names))
    return Listing(dict(zip(names, answers, strict=True)))


async def ask(
    bus: Bus, service: str, changes: Mapping[str, Any] | None = None, *, dry_run: bool = False
) -> list[Parameter]:
    """The parameters of a service, after a change if there is one.

    Raises:
        ZencellError: what is wrong with the change.
        RequestFailed: the service refuses, or does not answer.
    """
    values = {"set": dict(changes or {}), "dry_run": dry_run, "by": f"{person()}/{os.getpid()}"}
    request = check(ParameterRequest, values)
    try:
        return (await bus.client(topics.parameters_of(service)).call(request, TIMEOUT)).parameters
    except RemoteError as error:
        raise ZencellError(error.message) if error.code in BAD_INPUT else RequestFailed(error.message) from None


async def look_up(bus: Bus, paths: Iterable[str]) -> dict[str, tuple[str, Parameter]]:
    """The service and the parameter that each path stands for.

    Raises:
        UnknownName: a service or parameter that is not there; with the choices.
        RequestFailed: a service that has to be asked does not answer.
    """
    there = await serving(bus)
    full = {path: f"services.{path}" if path.partition(".")[0] in there else path for path in paths}
    owners = {path: path.split(".")[1] if path.startswith("services.") else None for path in full.values()}
    # A section, such as motion, does not say whose it is.
    found = await listing(bus, None if None in owners.values() else [name for name in owners.values() if name])
    known = {p.path: (name, p) for name, parameters in found.parameters.items() for p in parameters}
    for path, owner in owners.items():
        if owner is not None and owner not in there:
            raise UnknownName("service", owner, there)
        if path not in known:
            found.raise_first()  # it may be one of that service
            choices = [p for p in known if owner is None or known[p][0] == owner]
            if owner is None:
                choices = [p for p in known if not p.startswith("services.")] + [f"{name}..." for name in there]
            raise UnknownName("parameter", path, choices)
    return {path: known[whole] for path, whole in full.items()}


async def change(bus: Bus, values: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Change parameters by their paths, all of them or none: by whole path, the values before and after.

    Raises:
        UnknownName: a service or parameter that is not there; with the choices.
        ZencellError: what is wrong with a value.
        RequestFailed: a service refuses, or does not answer.
    """
    values = {path: _plain(path, value) for path, value in values.items()}
    found = await look_up(bus, values)
    wanted: dict[str, dict[str, Any]] = {}
    for path, (service, parameter) in found.items():
        if parameter.value != values[path]:
            wanted.setdefault(service, {})[parameter.path] = values[path]
    told = {parameter.path: (parameter.value, parameter.value) for _, parameter in found.values()}
    for service, changes in wanted.items():
        await ask(bus, service, changes, dry_run=True)
    for service, changes in wanted.items():
        after = {parameter.path: parameter.value for parameter in await ask(bus, service, changes)}
        if missing := next((path for path in changes if path not in after), None):
            raise RequestFailed(f"{service} does not say what became of {missing}")
        told |= {path: (told[path][0], after[path]) for path in changes}
    return told


def _plain(path: str, value: object) -> Any:
    """A value as it travels: what numpy has as numbers and lists.

    Raises:
        ConfigError: it is nothing of which a parameter is made.
    """
    def told(other: Any) -> Any:
        return other.tolist()

    try:
        return to_jsonable_python(value, inf_nan_mode="constants", fallback=told)
    except (ValueError, TypeError, AttributeError):
        raise ConfigError(path, value, "must be a number, text, list or mapping") from None


async def dumped(bus: Bus, services: Iterable[str] | None, *, everything: bool = False) -> str:
    """What differs from the defaults, or everything, as YAML in the shape of a cell file.

    Raises:
        UnknownName: a service that does not serve any; with the choices.
        RequestFailed: one does not answer, and half of it would look like all of it.
    """
    import yaml

    found = await listing(bus, services or None)
    found.raise_first()
    tree = tree_of(p for parameters in found.parameters.values() for p in parameters if everything or differs(p))
    head = f"# Parameters of {bus.cell}; read back with: zencell up {bus.cell} --set @FILE\n"
    return head + yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, allow_unicode=True, width=120)


def differs(parameter: Parameter) -> bool:
    """Whether a cell needs to be told the value, to start with it."""
    return parameter.changed or parameter.value != parameter.default


def tree_of(parameters: Iterable[Parameter]) -> dict[str, Any]:
    """The values in the shape of a cell file.

    Raises:
        RequestFailed: one would be a part of another's value.
    """
    tree: dict[str, Any] = {}
    told: set[str] = set()
    for parameter in parameters:
        *above, name = parameter.path.split(".")
        if any(".".join(above[:depth]) in told for depth in range(1, len(above) + 1)):
            raise RequestFailed(f"{parameter.path} is told of as a part of another parameter")
        told.add(parameter.path)
        node = tree
        for part in above:
            node = node.setdefault(part, {})
        node[name] = parameter.value
    return tree


def range_of(parameter: Parameter) -> str:
    """Bounds or choices in a few words."""
    if parameter.choices:
        return " | ".join(parameter.choices)
    low, high = parameter.minimum, parameter.maximum
    if low is None or high is None:
        return f">= {low:g}" if low is not None else f"<= {high:g}" if high is not None else ""
    return f"{low:g} to {high:g}"


class Parameters(Part):
    """Parameters of a cell's services by path, as `zencell param list` has them; `services.` may be left out."""

    def __init__(self, bus: Bus) -> None:
        """Of the services of a cell."""
        self._bus = bus

    def __getitem__(self, path: str) -> ParameterValue:
        """To be awaited: the value."""
        return ParameterValue(self._bus, path)

    async def set(self, path: str, value: object) -> None:
        """Change one; see `change`."""
        await change(self._bus, {path: value})

    async def update(self, values: Mapping[str, Any]) -> None:
        """Change several, all of them or none; see `change`."""
        await change(self._bus, values)

    async def all(self) -> dict[str, Any]:
        """All values by path."""
        found = await listing(self._bus, None)
        found.raise_first()
        return {p.path: p.value for parameters in found.parameters.values() for p in parameters}


class ParameterValue:
    """The value of a parameter, once it is awaited.

    Raises:
        UnknownName: there is no such parameter; with the choices.
    """

    def __init__(self, bus: Bus, path: str) -> None:
        """Not asked for yet."""
        self._bus, self._path = bus, path

    async def get(self) -> Any:
        """Ask for it."""
        return (await look_up(self._bus, [self._path]))[self._path][1].value

    def __await__(self) -> Generator[Any, None, Any]:
        return self.get().__await__()
