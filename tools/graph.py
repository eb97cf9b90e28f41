"""Graph of services and topics of a cell as DOT, Mermaid or SVG.

In the SVG writers and clients are on the left, keys in the middle, readers and servers on the right. Every service is
on both sides in start order, so that data flows from left to right. Lines have the color of the service at their start.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from common.supervision.wiring import ServiceWiring


OUTSIDE = "zencell, you"  # client of requests that no service of the cell sends
SUPERVISOR = "supervisor"
PARAMETERS = "param/"  # served by every service, so not shown


@dataclass(frozen=True)
class Graph:
    """Services with the keys between them. `alive` is None while the cell is not up."""

    cell: str
    services: list[ServiceWiring]  # in start order
    kinds: dict[str, str]  # by key: stream, event, state, request; in the order of their writers or callers
    alive: frozenset[str] | None = None
    outside: list[str] = field(default_factory=list)  # requests that no service of the cell sends

    def is_lit(self, service: str) -> bool:
        """Return whether a service is ready, or the cell is not up."""
        return self.alive is None or service in self.alive


def graph_of(cell: str, services: list[ServiceWiring], alive: frozenset[str] | None = None) -> Graph:
    """Return the graph of a cell.

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
    keys += [key for service in services for key in service.reads]  # written by no service of this cell
    kinds: dict[str, str] = {}
    for key in keys:
        topic = next((each.topics[key] for each in services if key in each.topics), None) or find_topic(key)
        kinds[key] = topic.kind if topic else "event"
    return Graph(cell, services, kinds, alive, outside)


def names(graph: Graph) -> list[str]:
    """Return the names of the services."""
    return [service.name for service in graph.services]


DOT_SHAPES = {"stream": "ellipse", "event": "ellipse", "state": "ellipse", "request": "hexagon"}
DOT_FILLS = {"stream": "#e3effb", "event": "#e4f4e1", "state": "#fdf3d4", "request": "#efe4f7"}


def edges(graph: Graph) -> Iterator[tuple[str, str, bool, bool]]:
    """Yield start and end (a service or a key), whether it is a request, and whether the service is alive."""
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
    """Return the graph as Graphviz DOT."""
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
    """Return the graph as Mermaid, which GitHub draws in a ```mermaid block."""
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


ROW, GAP = 21.0, 13.0  # [px] height of a key, and gap between services on the left
LEFT, WIDE = 20.0, 176.0  # [px] position and width of services
KEYS, KEY_WIDE = 262.0, 216.0  # [px] position and width of keys
RIGHT = 760.0  # [px] position of the services on the right
TOP = 62.0  # [px] of the drawing proper
PORT = 8.0  # [px] least distance between two lines that end at one service
FILLS = {"stream": "#e3effb", "event": "#e4f4e1", "state": "#fdf3d4", "request": "#efe4f7"}
COLOURS = ("#1f77b4", "#d6620a", "#2a8a2a", "#c22f2f", "#7d58ad", "#8c564b", "#c14fa0", "#4d6a00", "#007d8c", "#5a5a5a",
           "#a07800", "#3b4cc0")


@dataclass(frozen=True)
class Row:
    """A key next to the service that writes or calls it."""

    service: str  # empty if no service of the cell does
    key: str
    y: float  # [px] of its middle


@dataclass(frozen=True)
class Box:
    """A service on one side."""

    service: str
    top: float  # [px]
    height: float  # [px]


def svg(graph: Graph) -> str:
    """Return the graph as an SVG document on white."""
    rows, writers, bottom = _left_side(graph)
    readers, bottom = _right_side(graph, rows, bottom)
    colours = {service.name: COLOURS[number % len(COLOURS)] for number, service in enumerate(graph.services)}
    width, height = RIGHT + WIDE + LEFT, bottom + 52
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}" height="{height:g}" '
        f'viewBox="0 0 {width:g} {height:g}" font-family="Helvetica, Arial, sans-serif" font-size="12.5">',
        f"<title>{escape(graph.cell)}: services and topics</title>",
        '<rect width="100%" height="100%" fill="white"/>',
        _text(LEFT, 26, f"{graph.cell}: services and topics", size=17, weight="bold"),
        _text(LEFT + WIDE / 2, 50, "writes, calls", anchor="middle", fill="#777"),
        _text(RIGHT + WIDE / 2, 50, "reads, serves", anchor="middle", fill="#777"),
    ]
    parts += _lines(graph, rows, readers, colours)
    parts += [_box(graph, box, LEFT, colours) for box in writers]
    parts += [_box(graph, box, RIGHT, colours) for box in readers]
    parts += [_key(graph, row) for row in rows]
    parts += _legend(graph, bottom + 30)
    return "\n".join([*parts, "</svg>", ""])


def _left_side(graph: Graph) -> tuple[list[Row], list[Box], float]:
    """Return the keys from top to bottom, the boxes of their writers and clients, and the bottom [px]."""
    groups = [(service.name, [*service.writes, *service.calls]) for service in graph.services]
    groups = [(name, keys) for name, keys in groups if keys]
    if graph.outside:
        groups.append((OUTSIDE, graph.outside))
    had = {key for _, keys in groups for key in keys}
    if orphans := [key for key in graph.kinds if key not in had]:
        groups.append(("", orphans))
    rows, boxes, y = [], [], TOP
    for name, keys in groups:
        boxes += [Box(name, y, ROW * len(keys))] if name else []
        rows += [Row(name, key, y + ROW * (number + 0.5)) for number, key in enumerate(keys)]
        y += ROW * len(keys) + GAP
    return rows, boxes, y - GAP


def _right_side(graph: Graph, rows: list[Row], bottom: float) -> tuple[list[Box], float]:
    """Return the boxes of readers and servers, spread over the height of the keys, and the bottom [px]."""
    ports = {service.name: len(_ending_at(graph, service.name, rows)) for service in graph.services}
    heights = {name: max(ROW, PORT * (count + 1)) for name, count in ports.items() if count}
    free = bottom - TOP - sum(heights.values())
    gap = max(GAP, free / max(1, len(heights) - 1)) if len(heights) > 1 else GAP
    boxes, y = [], TOP
    for name, height in heights.items():
        boxes.append(Box(name, y, height))
        y += height + gap
    return boxes, max(bottom, y - gap)


def _ending_at(graph: Graph, service: str, rows: list[Row]) -> list[Row]:
    """Return the rows with a line to a service, from top to bottom."""
    wire_service = next(each for each in graph.services if each.name == service)
    return [row for row in rows if row.key in wire_service.reads or row.key in wire_service.serves]


def _lines(graph: Graph, rows: list[Row], readers: list[Box], colours: dict[str, str]) -> list[str]:
    parts = []
    for row in rows:
        if row.service:
            parts.append(_line(graph, row, (LEFT + WIDE, row.y), (KEYS, row.y), colours, row.service))
    for box in readers:
        ending = _ending_at(graph, box.service, rows)
        for number, row in enumerate(ending):
            y = box.top + box.height * (number + 1) / (len(ending) + 1)
            parts.append(_line(graph, row, (KEYS + KEY_WIDE, row.y), (RIGHT, y), colours, box.service))
    return parts


def _line(
    graph: Graph, row: Row, start: tuple[float, float], end: tuple[float, float], colours: dict[str, str], other: str
) -> str:
    """Return a curve with horizontal ends and an arrow head."""
    lit = all(name in ("", OUTSIDE) or graph.is_lit(name) for name in (row.service, other))
    colour = colours.get(row.service, "#888") if lit else "#c4c4c4"
    asked = graph.kinds[row.key] == "request"
    dashes = ' stroke-dasharray="6 3"' if asked else ' stroke-dasharray="2 3"' if not lit else ""
    (x0, y0), (x1, y1) = start, (end[0] - 6, end[1])
    bend = (x1 - x0) * 0.5
    head = f"M{x1:.1f},{y1 - 3.5:.1f} L{x1 + 6:.1f},{y1:.1f} L{x1:.1f},{y1 + 3.5:.1f} Z"
    return (
        f'<path d="M{x0:.1f},{y0:.1f} C{x0 + bend:.1f},{y0:.1f} {x1 - bend:.1f},{y1:.1f} {x1:.1f},{y1:.1f}" '
        f'fill="none" stroke="{colour}" stroke-width="1.4"{dashes}/><path d="{head}" fill="{colour}"/>'
    )


def _box(graph: Graph, box: Box, x: float, colours: dict[str, str]) -> str:
    lit = box.service == OUTSIDE or graph.is_lit(box.service)
    colour = colours.get(box.service, "#888") if lit else "#aaa"
    dashes = "" if lit else ' stroke-dasharray="5 4"'
    alive = lit and graph.alive is not None and box.service != OUTSIDE
    return (
        f'<rect x="{x:g}" y="{box.top + 1:.1f}" width="{WIDE:g}" height="{box.height - 2:.1f}" rx="4" '
        f'fill="{"#eefaf0" if alive else "#fafafa"}" stroke="{colour}" stroke-width="1.8"{dashes}/>'
        + _text(x + WIDE / 2, box.top + box.height / 2 + 4.5, box.service, anchor="middle", weight="bold",
                fill="#222" if lit else "#999")
    )


def _key(graph: Graph, row: Row) -> str:
    kind = graph.kinds[row.key]
    corner = 2 if kind == "request" else ROW / 2 - 2
    return (
        f'<rect x="{KEYS:g}" y="{row.y - ROW / 2 + 2:.1f}" width="{KEY_WIDE:g}" height="{ROW - 4:g}" rx="{corner:g}" '
        f'fill="{FILLS[kind]}" stroke="#999" stroke-width="0.8"/>'
        + _text(KEYS + KEY_WIDE / 2, row.y + 4.2, row.key, anchor="middle")
    )


def _legend(graph: Graph, y: float) -> list[str]:
    parts, x = [], LEFT
    for kind, fill in FILLS.items():
        parts.append(f'<rect x="{x:g}" y="{y - 10:.1f}" width="26" height="13" '
                     f'rx="{2 if kind == "request" else 6}" fill="{fill}" stroke="#999" stroke-width="0.8"/>')
        parts.append(_text(x + 32, y + 1, kind, fill="#555"))
        x += 104
    note = "the cell is not up" if graph.alive is None else "green: alive; dashed and grey: not alive"
    parts.append(_text(RIGHT + WIDE, y + 1, note, anchor="end", fill="#555"))
    return parts


def _text(x: float, y: float, text: str, *, anchor: str = "start", fill: str = "#222", size: float = 0,
          weight: str = "") -> str:
    style = (f' font-size="{size:g}"' if size else "") + (f' font-weight="{weight}"' if weight else "")
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{fill}"{style}>{escape(text)}</text>'
