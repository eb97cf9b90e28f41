"""Access rules of a cell's keys, derived from what its services declare; everything else is denied.

The rules are those of Zenoh's access control: a message is checked when it enters the router (ingress) and when it
leaves it (egress), and a process is identified by the common name of its certificate.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from common.application import all_topics
from common.config import Cell
from common.errors import ZencellError
from common.supervision.launch import require_modules
from common.supervision.wiring import Wiring, WiringFailed, require_one_owner, wiring_of
from common.topics import (
    COUNTERS,
    LOG,
    MOTION_JOG,
    SUPERVISOR_STATUS,
    Request,
    Topic,
    general_key,
    of_service,
    parameters_of,
)
from common.transport.credentials import OBSERVER, OPERATOR, RECORDER, ROUTER_NAME, SUPERVISOR, common_name
from common.transport.session import alive_key, owns_key, serves_key
from common.transport.writer import plain_key
from security.page_tokens import VIEWER

MESSAGES = [
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
]


class Declares(Protocol):
    """Declarations of a service (common.supervision.wiring)."""

    reads: set[Topic[Any]]
    writes: set[Topic[Any]]
    serves: set[Request[Any, Any]]
    calls: set[Request[Any, Any]]


@dataclass
class Rights:
    """Key expressions, without the cell, that a process may use, by kind of use."""

    write: set[str] = field(default_factory=set)  # streams and events
    keep: set[str] = field(default_factory=set)  # states: published, and answered
    read: set[str] = field(default_factory=set)
    get: set[str] = field(default_factory=set)  # states that it queries; ** would include every request
    serve: set[str] = field(default_factory=set)
    call: set[str] = field(default_factory=set)


def rights_in(cell: Cell, names: Collection[str] | None = None) -> dict[str, Rights]:
    """Return the rights of each process of a cell, from what its services declare.

    Args:
        cell: resolved and complete: what a service declares may depend on the other services.
        names: of the services to include; by default all.

    Raises:
        ConfigError: a service cannot be configured, or two of them write or serve one key.
        WiringFailed: a service fails before it has declared everything.
    """
    require_modules(cell)
    apart = cell.model_copy(update={"services": {
        # The port of the page may be in use: the cell may be up.
        key: entry.model_copy(update={"parameters": {**entry.parameters, "host": "127.0.0.1", "port": 0}})
        if entry.kind == VIEWER else entry for key, entry in cell.services.items()
    }})

    async def find() -> dict[str, Wiring]:
        found = {}
        for entry in apart.services.values():
            if names is not None and entry.name not in names:
                continue
            try:
                found[entry.name] = await wiring_of(apart, entry)
            except ZencellError:
                raise
            except Exception as error:  # any error of a service that cannot run alone
                raise WiringFailed(entry.name, error) from error
        return found

    wirings = asyncio.run(find())
    require_one_owner(wirings)
    rights = {name: rights_of(name, declared) for name, declared in wirings.items()}
    return {**rights, SUPERVISOR: rights_of_supervisor(), RECORDER: rights_of_recorder(rights.values())}


def rights_of(service: str, declared: Declares) -> Rights:
    """Return the rights of a service: for its declarations, and for what every service does."""
    rights = _rights_of_each(service)
    rights.serve.add(parameters_of(service).key)
    for topic in declared.writes:
        (rights.keep if topic.kind == "state" else rights.write).add(topic.key)
    for topic in declared.reads:
        rights.read.add(topic.expression)
        if topic.kind == "state":
            rights.get.add(topic.expression)
    rights.serve |= {request.key for request in declared.serves}
    for request in declared.calls:
        rights.call.add(request.expression)
    return rights


def _rights_of_each(service: str) -> Rights:
    """Return the rights of every process for its own keys."""
    return Rights(write={of_service(LOG, service).key}, keep={of_service(COUNTERS, service).key})


def rights_of_supervisor() -> Rights:
    """Return the rights of a cell's supervisor, which writes the summary from all messages."""
    rights = _rights_of_each(SUPERVISOR)
    plain = {plain_key(topic) for topic in (LOG, COUNTERS)}  # former keys, under which it repeats those of services
    keep = {*rights.keep, SUPERVISOR_STATUS.key}
    return replace(rights, write=rights.write | plain, keep=keep, read={"**"}, get={"**"}, call={"**"})


def rights_of_recorder(services: Iterable[Rights] = ()) -> Rights:
    """Return the rights of the recorder of a cell with these services: it reads everything and calls nothing."""
    return replace(_rights_of_each(RECORDER), read={"**"}, get=_states(services))


def rights_of_tools(services: Iterable[Rights] = ()) -> dict[str, Rights]:
    """Return the rights of tools in all cells of a router, which have these services."""
    return {
        OPERATOR: Rights(write={MOTION_JOG.key}, read={"**"}, get={"**"}, call={"**"}),
        OBSERVER: Rights(read={"**"}, get=_states(services)),
    }


def _states(services: Iterable[Rights]) -> set[str]:
    # Not `**`: to the router a `get` of every key is also a call of every request.
    known = {topic.expression for topic in all_topics().values() if topic.kind == "state"}
    own = {key for rights in services for key in rights.keep if general_key(key) == key}
    of_arms = {f"*/{key}" for key in known}  # of arms with any name: the rules for one cell do not depend on another's
    return known | of_arms | {key for key in own if key.partition("/")[2] not in known}


def access_control(cells: Mapping[str, Mapping[str, Rights]]) -> dict[str, Any]:
    """Return the `access_control` section of a router's configuration.

    Args:
        cells: rights of each process, by cell and process.
    """
    rules: list[dict[str, Any]] = []
    subjects, policies = [], []
    every = [rights for processes in cells.values() for rights in processes.values()]
    for cell, processes in {**cells, "*": rights_of_tools(every)}.items():
        for process, rights in processes.items():
            name = common_name(cell, process)
            own = list(_rules(cell, process, rights))
            for rule in own:
                rule["id"] = f"{name} {rule['id']}"
            rules += own
            subjects.append({"id": name, "cert_common_names": [name]})
            policies.append({"id": name, "rules": [rule["id"] for rule in own], "subjects": [name]})
    # The router of another host has already applied its own rules.
    rules.append({
        "id": f"{ROUTER_NAME} passes on", "permission": "allow", "flows": ["ingress", "egress"], "messages": MESSAGES,
        "key_exprs": ["**"],
    })
    subjects.append({"id": ROUTER_NAME, "cert_common_names": [ROUTER_NAME]})
    policies.append({"id": ROUTER_NAME, "rules": [f"{ROUTER_NAME} passes on"], "subjects": [ROUTER_NAME]})
    return {
        "enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies,
    }


def _rules(cell: str, process: str, rights: Rights) -> Iterable[dict[str, Any]]:
    in_cell = {kind: sorted(f"{cell}/{key}" for key in getattr(rights, kind)) for kind in Rights.__dataclass_fields__}
    written, answered = in_cell["write"] + in_cell["keep"], in_cell["keep"] + in_cell["serve"]
    # A client sends only keys for which the router has reported a subscriber, and the router forwards a later
    # subscription unchanged: one to `cell/**` would not match a rule for a key of this process.
    subscriptions = ["**"] if written else []
    queried = sorted({*in_cell["get"], *in_cell["call"]})
    own = [alive_key(cell, process), *(serves_key(cell, key, process) for key in sorted(rights.serve))]
    own += [owns_key(cell, key, service=process) for key in sorted({*rights.write, *rights.keep, *rights.serve})]
    everyone = [f"{cell}/alive/*", f"{cell}/serves/**", f"{cell}/owns/**"]
    # The names are in the files of existing folders, which `secure check` compares: they stay.
    for name, flow, messages, keys in (
        ("writes", "ingress", ["put", "delete"], written),
        ("hears of readers", "egress", ["declare_subscriber"], subscriptions),
        ("answers", "ingress", ["declare_queryable", "reply"], answered),
        ("is asked", "egress", ["query"], answered),
        ("reads", "ingress", ["declare_subscriber"], in_cell["read"]),
        ("is told", "egress", ["put", "delete"], in_cell["read"]),
        ("asks", "ingress", ["query"], queried),
        ("is answered", "egress", ["reply"], queried),
        ("hears of servers", "egress", ["declare_queryable"], queried),
        ("is there", "ingress", ["liveliness_token"], own),
        ("watches", "ingress", ["liveliness_query", "declare_liveliness_subscriber"], everyone),
        ("sees who is there", "egress", ["liveliness_token", "reply"], everyone),
    ):
        if keys:
            yield {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
