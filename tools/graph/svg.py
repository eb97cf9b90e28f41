"""A graph of services and topics as SVG: who writes or asks on the left, keys between, who reads or answers right.

Every service stands on both sides, in start order, so that data flows from left to right and a line on the left never
crosses another. Lines have the colour of the service that they come from.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

from tools.graph.drawing import OUTSIDE, Graph

ROW, GAP = 21.0, 13.0  # [px] of a key, and between the services on the left
LEFT, WIDE = 20.0, 176.0  # [px] where the boxes of services begin, and how wide they are
KEYS, KEY_WIDE = 262.0, 216.0  # [px] where the keys begin, and how wide they are
RIGHT = 760.0  # [px] where the services on the right begin
TOP = 62.0  # [px] of the drawing proper
PORT = 8.0  # [px] between two lines that end at one service, at least
FILLS = {"stream": "#e3effb", "event": "#e4f4e1", "state": "#fdf3d4", "request": "#efe4f7"}
COLOURS = ("#1f77b4", "#d6620a", "#2a8a2a", "#c22f2f", "#7d58ad", "#8c564b", "#c14fa0", "#4d6a00", "#007d8c", "#5a5a5a",
           "#a07800", "#3b4cc0")


@dataclass(frozen=True)
class Row:
    """A key beside the service that writes or asks it."""

    service: str  # "" when nobody in the cell does
    key: str
    y: float  # [px] of its middle


@dataclass(frozen=True)
class Box:
    """A service on one side."""

    service: str
    top: float  # [px]
    height: float  # [px]


def svg(graph: Graph) -> str:
    """The graph as an SVG document of its own, on white."""
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
        _text(LEFT + WIDE / 2, 50, "writes, asks", anchor="middle", fill="#777"),
        _text(RIGHT + WIDE / 2, 50, "reads, answers", anchor="middle", fill="#777"),
    ]
    parts += _lines(graph, rows, readers, colours)
    parts += [_box(graph, box, LEFT, colours) for box in writers]
    parts += [_box(graph, box, RIGHT, colours) for box in readers]
    parts += [_key(graph, row) for row in rows]
    parts += _legend(graph, bottom + 30)
    return "\n".join([*parts, "</svg>", ""])


def _left_side(graph: Graph) -> tuple[list[Row], list[Box], float]:
    """The keys from top to bottom, the boxes of those who write or ask them, and where they end."""
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
    """The boxes of those who read or answer, spread over the height of the keys; and where all of it ends."""
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
    """The rows from which a line goes to a service, from top to bottom."""
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
    """A curve that leaves and arrives level, with an arrow's head."""
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
    said = "the cell is not up" if graph.alive is None else "green: alive; dashed and grey: not alive"
    parts.append(_text(RIGHT + WIDE, y + 1, said, anchor="end", fill="#555"))
    return parts


def _text(x: float, y: float, text: str, *, anchor: str = "start", fill: str = "#222", size: float = 0,
          weight: str = "") -> str:
    style = (f' font-size="{size:g}"' if size else "") + (f' font-weight="{weight}"' if weight else "")
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{fill}"{style}>{escape(text)}</text>'
