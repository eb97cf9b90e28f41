"""One service of a cell: what it has to do with, its parameters, and how it is while the cell is up."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from common import topics as keys
from common.client.joining import RunningCell, joined
from common.client.subscriptions import Carried
from common.config import Cell, ServiceEntry, load_cell, names_of, service_names
from common.config.tunables import describe
from common.errors import RequestFailed, UnknownName
from common.messages import Parameter, ParameterRequest, ServiceStatus
from common.supervision.wiring import ServiceWiring
from common.transport.session import ROUTER

ASK_TIMEOUT = 2.0  # [s]
SIDES = ("reads", "writes", "serves", "calls")


def find(service: str, cell: str | None, cells: dict[str, RunningCell]) -> tuple[Cell, ServiceEntry]:
    """The cell that a service belongs to, those that are up first, and its entry there.

    Raises:
        ConfigError, UnknownName: there is none.
    """
    names = [cell] if cell else sorted(names_of("cells"), key=lambda name: (name not in cells, name))
    choices = {name for name in service_names() if name != ROUTER}
    for name in names:
        loaded = load_cell(name)
        for entry in loaded.services.values():
            if service in (entry.name, entry.module):
                return loaded, entry
            choices.add(entry.name)
    if service not in choices:
        raise UnknownName("service", service, choices)
    # One that no cell has: as it would be in the first.
    return load_cell(names[0]), ServiceEntry(name=service, module=f"services.{service}")


async def parameters_of(
    found: ServiceWiring, cell: str, presence: RunningCell | None, domain: str | None, connect: str | None
) -> tuple[list[Parameter], RequestFailed | None]:
    """The parameters as they are in the running service, else as they would be, and why it did not tell its own."""
    why = None
    if presence is not None and found.name in presence.ready:
        try:
            async with joined(cell, domain=domain, connect=connect) as bus:
                asking = bus.client(keys.parameters_of(found.name))
                return (await asking.call(ParameterRequest(), ASK_TIMEOUT)).parameters, None
        except RequestFailed as error:
            why = error
    assert found.config is not None
    return describe(found.config, found.name), why


def described(
    cell: str, found: ServiceWiring, presence: RunningCell | None, parameters: list[Parameter]
) -> dict[str, Any]:
    """All that is known of a service as JSON can hold it."""
    state = "ready" if presence is not None and found.name in presence.ready else "not running"
    status = ServiceStatus(name=found.name, state="stopped")
    for each in presence.status.services if presence and presence.status else []:
        if each.name == found.name:
            status, state = each, each.state
    return {
        "cell": cell, "service": found.name, "doc": found.doc, "state": state, "pid": status.pid,
        "restarts": status.restarts, "ready_seconds": status.ready_seconds,
        **{side: getattr(found, side) for side in SIDES},
        "parameters": [each.model_dump() for each in parameters],
    }


def lines(described: dict[str, Any], topics: Mapping[str, Carried]) -> Iterator[str]:
    """The same in lines for people."""
    yield f"{described['cell']}/{described['service']}: {described['doc']}"
    yield f"state: {described['state']}" + (
        f", pid {described['pid']}, {described['restarts']} restarts" if described["pid"] else ""
    )
    for side in SIDES:
        yield f"{side}:" if described[side] else f"{side}: nothing"
        for key in described[side]:
            topic = topics.get(key)
            answer = getattr(topic, "answer", None)
            carries = f"{topic.kind:<8} {topic.message.__name__}" if topic else ""
            yield f"  {key:<28} {carries}{f' -> {answer.__name__}' if answer else ''}".rstrip()
    yield "parameters:" if described["parameters"] else "parameters: none"
    for each in described["parameters"]:
        yield f"  {_parameter_line(each)}"


def _parameter_line(each: dict[str, Any]) -> str:
    low, high = each["minimum"], each["maximum"]
    bounds = " to ".join(f"{value:g}" for value in (low, high) if value is not None)
    if (low is None) != (high is None):
        bounds = f">= {bounds}" if high is None else f"<= {bounds}"
    about = "; ".join(part for part in (each["description"], ", ".join(each["choices"]) or bounds,
                                        "at run time" if each["runtime"] else "") if part)
    return f"{each['path']} = {json.dumps(each['value'])}" + (f"  # {about}" if about else "")
