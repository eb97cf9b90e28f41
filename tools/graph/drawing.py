"""Services and topics of a cell as a picture: DOT and Mermaid as text; SVG is beside this."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from common.supervision.wiring import ServiceWiring

OUTSIDE = "zencell, you"  # who sends the requests that no service of the cell sends
SUPERVISOR = "supervisor"
PARAMETERS = "param/"  # served by every service, and so no news


@dataclass(frozen=True)
class Graph:
    """A cell as services with the keys between them. `alive` is None while the cell is not up."""

    cell: str
    services: list[ServiceWiring]  # in start order
    kinds: dict[str, str]  # by key: stream, event, state, request; in the order of their writers or callers
    alive: frozenset[str] | None = None
    outside: list[str] = field(default_factory=list)  # requests that no service of the cell sends

    def is_lit(self, service: str) -> bool:
        """Whether a service is ready; while the cell is not up, all look the same."""
        return self.alive is None or service in self.alive


def graph_of(cell: str, services: list[ServiceWiring], alive: frozenset[str] | None = None) -> Graph:
    """The graph of a cell's wire_service services.

    Args:
        cell: its name.
        services: in start order.
        alive: the services that are ready, when the cell is up.
    """
    from common.application import find_topic
    from common.supervision.wiring import ServiceWiring
    from common.topics import SUPERVISOR_STATUS

    services = [replace(each, calls=[key for key in each.calls if not key.startswith(PARAMETERS)]) for each in services]
    if any(SUPERVISOR_STATUS.key in each.reads for each in services):
        services.append(ServiceWiring(SUPERVISOR, "", writes=[SUPERVISOR_STATUS.key]))
    called = {key for service in services for key in service.calls}
    outside = [key for service in services for key in service.serves if key not in called]
    keys = [key for service in services for key in (*service.writes, *service.calls)] + outside
    keys += [key for service in services for key in service.reads]  # written by nobody in this cell
    kinds: dict[str, str] = {}
    for key in keys:
        topic = next((each.topics[key] for each in services if key in each.topics), None) or find_topic(key)
        kinds[key] = topic.kind if topic else "event"
    return Graph(cell, services, kinds, alive, outside)


def names(graph: Graph) -> list[str]:
    """The services of a graph."""
    return [service.name for service in graph.services]


DOT_SHAPES = {"stream": "ellipse", "event": "ellipse", "state": "ellipse", "request": "hexagon"}
DOT_FILLS = {"stream": "#e3effb", "event": "#e4f4e1", "state": "#fdf3d4", "request": "#efe4f7"}


def edges(graph: Graph) -> Iterator[tuple[str, str, bool, bool]]:
    """From, to, whether a request goes there, and whether all of it is alive; each end a service or a key."""
    for service in graph.services:
        lit = graph.is_lit(service.name)
        for key in service.writes:
            yield service.name, f"key {key}", False, lit
        for key in service.reads:
            yield f"key {key}", service.name, False, lit
        for key in service.calls:
            yield service.name, f"key {key}", True, lit
        for key in service.serves:
            yield f"key {key}", service.name, True, lit
    for key in graph.outside:
        yield OUTSIDE, f"key {key}", True, True


def dot(graph: Graph) -> str:
    """The graph as Graphviz DOT: `dot -Tsvg`."""
    lines = [
        f"digraph {json.dumps(graph.cell)} {{", "  rankdir=LR;", '  node [fontname="sans-serif", fontsize=11];',
        '  edge [color="#666666", arrowsize=0.7];',
    ]
    for service in graph.services:
        style = "filled,bold" if graph.is_lit(service.name) else "dashed"
        lines.append(f"  {json.dumps(service.name)} [shape=box, style={json.dumps(style)}, fillcolor=white];")
    if graph.outside:
        lines.append(f"  {json.dumps(OUTSIDE)} [shape=plaintext];")
    for key, kind in graph.kinds.items():
        lines.append(f"  {json.dumps(f'key {key}')} [label={json.dumps(key)}, shape={DOT_SHAPES[kind]}, style=filled, "
                     f'fillcolor="{DOT_FILLS[kind]}"];')
    for start, end, asked, lit in edges(graph):
        marks = ", ".join(mark for mark, there in (("style=dashed", asked or not lit), ('color="#bbbbbb"', not lit))
                          if there)
        lines.append(f"  {json.dumps(start)} -> {json.dumps(end)}{f' [{marks}]' if marks else ''};")
    return "\n".join([*lines, "}", ""])


def mermaid(graph: Graph) -> str:
    """The graph as Mermaid: what GitHub draws in a ```mermaid block."""
    ids = {service.name: f"s{number}" for number, service in enumerate(graph.services)}
    ids |= {f"key {key}": f"k{number}" for number, key in enumerate(graph.kinds)}
    ids[OUTSIDE] = "you"
    lines = ["flowchart LR"]
    for service in graph.services:
        lines.append(f'  {ids[service.name]}["{service.name}"]:::{"alive" if graph.is_lit(service.name) else "gone"}')
    if graph.outside:
        lines.append(f'  you(["{OUTSIDE}"])')
    for key, kind in graph.kinds.items():
        opened, closed = ("{{", "}}") if kind == "request" else ("([", "])")
        lines.append(f'  {ids[f"key {key}"]}{opened}"{key}"{closed}:::{kind}')
    for start, end, asked, lit in edges(graph):
        lines.append(f"  {ids[start]} {'-.->' if asked or not lit else '-->'} {ids[end]}")
    lines += [f"  classDef {kind} fill:{fill},stroke:#888,color:#222" for kind, fill in DOT_FILLS.items()]
    lines += ["  classDef alive fill:#fff,stroke:#222,stroke-width:2px,color:#222",
              "  classDef gone fill:#f6f6f6,stroke:#aaa,stroke-dasharray:4 3,color:#888"]
    return "\n".join([*lines, ""])
