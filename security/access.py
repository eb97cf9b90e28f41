"""Who may do what on a cell's keys, found from what its services declare; all else is denied.

The rules are those of Zenoh's access control: a message is looked at where it enters the router (ingress) and where
it leaves it (egress), and a process is known by the common name of its certificate.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from common.application import all_topics
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

MESSAGES = [
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
]


class Declares(Protocol):
    """What a service has declared (common.supervision.wiring)."""

    reads: set[Topic[Any]]
    writes: set[Topic[Any]]
    serves: set[Request[Any, Any]]
    calls: set[Request[Any, Any]]


@dataclass
class Rights:
    """Key expressions, without the cell, and what may be done with them."""

    write: set[str] = field(default_factory=set)  # streams and events
    keep: set[str] = field(default_factory=set)  # states: written, and answered for
    read: set[str] = field(default_factory=set)
    get: set[str] = field(default_factory=set)  # states that are asked for; ** would be every request too
    serve: set[str] = field(default_factory=set)
    call: set[str] = field(default_factory=set)


def rights_of(service: str, declared: Declares) -> Rights:
    """What a service may do: what it declares, and what every service does."""
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
    """What every process may do, under keys of its own."""
    return Rights(write={of_service(LOG, service).key}, keep={of_service(COUNTERS, service).key})


def rights_of_supervisor() -> Rights:
    """What the supervisor of a cell may do: it writes the summary from all that it hears."""
    rights = _rights_of_each(SUPERVISOR)
    plain = {plain_key(topic) for topic in (LOG, COUNTERS)}  # of before, where it repeats what services say
    keep = {*rights.keep, SUPERVISOR_STATUS.key}
    return replace(rights, write=rights.write | plain, keep=keep, read={"**"}, get={"**"}, call={"**"})


def rights_of_recorder(services: Iterable[Rights] = ()) -> Rights:
    """What the recorder of a cell with these services may do: it hears everything and commands nothing."""
    return replace(_rights_of_each(RECORDER), read={"**"}, get=_states(services))


def rights_of_tools(services: Iterable[Rights] = ()) -> dict[str, Rights]:
    """What people's tools may do, in all cells behind a router, which have these services."""
    return {
        OPERATOR: Rights(write={MOTION_JOG.key}, read={"**"}, get={"**"}, call={"**"}),
        OBSERVER: Rights(read={"**"}, get=_states(services)),
    }


def _states(services: Iterable[Rights]) -> set[str]:
    # Not `**`: who may ask for every key may call every request, since both are the same to the router.
    known = {topic.expression for topic in all_topics().values() if topic.kind == "state"}
    return known.union(key for rights in services for key in rights.keep if general_key(key) == key)


def access_control(cells: Mapping[str, Mapping[str, Rights]]) -> dict[str, Any]:
    """The `access_control` section of a router's configuration.

    Args:
        cells: for each cell the rights of each of its processes.
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
    # The router of another host has let through only what its own rules allow.
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
    # A client sends only what the router has told it that somebody reads, and the router passes a later subscription on
    # as it was made: who reads `cell/**` would not be heard of under a key of this process.
    heard = ["**"] if written else []
    asked = sorted({*in_cell["get"], *in_cell["call"]})
    own = [alive_key(cell, process), *(serves_key(cell, key, process) for key in sorted(rights.serve))]
    own += [owns_key(cell, key, service=process) for key in sorted({*rights.write, *rights.keep, *rights.serve})]
    everyone = [f"{cell}/alive/*", f"{cell}/serves/**", f"{cell}/owns/**"]
    for name, flow, messages, keys in (
        ("writes", "ingress", ["put", "delete"], written),
        ("hears of readers", "egress", ["declare_subscriber"], heard),
        ("answers", "ingress", ["declare_queryable", "reply"], answered),
        ("is asked", "egress", ["query"], answered),
        ("reads", "ingress", ["declare_subscriber"], in_cell["read"]),
        ("is told", "egress", ["put", "delete"], in_cell["read"]),
        ("asks", "ingress", ["query"], asked),
        ("is answered", "egress", ["reply"], asked),
        ("hears of servers", "egress", ["declare_queryable"], asked),
        ("is there", "ingress", ["liveliness_token"], own),
        ("watches", "ingress", ["liveliness_query", "declare_liveliness_subscriber"], everyone),
        ("sees who is there", "egress", ["liveliness_token", "reply"], everyone),
    ):
        if keys:
            yield {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
