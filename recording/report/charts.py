"""Charts of a report as SVG elements."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from recording.report.history import SAME_PLACE, RunHistory, Span

Array = npt.NDArray[np.float64]

MAX_POINTS = 1200  # of a line: more than the pixels of a page
STATE_COLORS = {"IDLE": "#c9ced6", "DONE": "#5fb35f", "ERROR": "#d64545"}  # of every task
MOTION_COLORS = {"succeeded": "#5d6a7a", "cancelled": "#e6a229", "aborted": "#d64545", "rejected": "#d64545",
                 "not ended": "#c9ced6"}
LINES = ("#2f7ed8", "#d64545", "#17a398", "#e6a229", "#8d6cc2", "#5d6a7a", "#b3528c", "#7a9a01")
MARKS = ("#e6a229", LINES[0], "#b3528c")
BAD, QUIET = "#d64545", "#8a94a3"
STYLE: Any = {  # matplotlib's type lists every name
    "svg.fonttype": "none", "font.family": "sans-serif", "font.size": 9, "axes.spines.top": False,
    "axes.spines.right": False, "axes.edgecolor": QUIET, "axes.labelcolor": "#3c4654", "xtick.color": "#3c4654",
    "ytick.color": "#3c4654", "axes.grid": True, "grid.color": "#e8ebef", "axes.axisbelow": True,
    "path.simplify": True, "path.simplify_threshold": 0.5, "legend.frameon": False, "text.parse_math": False,
}


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Names of the arm's joints and their limits: positions (dof,) [rad or m], velocities (dof,) [rad or m per s]."""

    names: list[str]
    lower: Array
    upper: Array
    velocity: Array


def timeline(run: RunHistory, state_colors: Mapping[str, str]) -> str:
    """Draw the states of task, motion and gripper and the restarts of processes over time.

    Args:
        run: history of the run.
        state_colors: of the task's own states; the others get default colors.
    """
    colors = {**STATE_COLORS, **state_colors}
    for k, state in enumerate(dict.fromkeys(span.label for span in run.tasks if span.label not in colors)):
        colors[state] = LINES[k % len(LINES)]
    rows: list[tuple[str, list[tuple[Span, str, str]]]] = [
        ("task", [(s, colors[s.label], s.label) for s in run.tasks]),
        ("motion", [(s, MOTION_COLORS.get(s.note, QUIET), s.note) for s in run.motions]),
        ("held", [(s, "#e6a229", "held") for s in [*run.held, *run.paused]]),
        ("gripper", [(s, "#b3528c", "holding") for s in run.holding]),
    ]
    rows = [row for row in rows if row[1] or row[0] != "held"]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10, 0.55 * len(rows) + 1.5), layout="constrained")
        axes = figure.subplots()
        handles: dict[str, Any] = {}
        for y, (_, spans) in enumerate(rows):
            for span, color, label in spans:
                width = max((span.until or span.since) - span.since, run.end / 2000)
                handles.setdefault(label, axes.barh(y, width, left=span.since, height=0.62, color=color, linewidth=0))
        names = [name for name, _ in rows]
        for event in run.restarts:
            handles.setdefault("restarted", axes.axvline(event.time, color=BAD, linewidth=1.5, linestyle="--"))
        if run.log:
            handles["warning or error"] = axes.scatter(
                [event.time for event in run.log], [len(rows) - 0.3] * len(run.log), marker="v", s=14, color=BAD
            )
        axes.set_yticks(range(len(rows)), names)
        axes.set_ylim(len(rows) - 0.1, -0.6)
        axes.set_xlim(0, max(run.end, 1e-3))
        axes.set_xlabel("time since the recording began [s]")
        axes.grid(axis="y", visible=False)
        figure.legend(handles.values(), handles.keys(), loc="outside upper left", ncols=9, fontsize=8,
                      handlelength=1.0, columnspacing=1.2)
        return svg(figure, "timeline")


def plans(planners: Sequence[str], milliseconds: Sequence[float], durations: Sequence[float]) -> str:
    """Draw the planning time of each plan by planner, and the duration of the planned motions."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10, 4.2), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True)
        for k, planner in enumerate(dict.fromkeys(planners)):
            chosen = [i for i, name in enumerate(planners) if name == planner]
            above.bar([i + 1 for i in chosen], [milliseconds[i] for i in chosen], color=LINES[k % len(LINES)],
                      label=planner)
        above.set_ylabel("planning [ms]")
        if planners:
            above.legend(fontsize=8, ncols=4, loc="upper left", bbox_to_anchor=(0, 1.2))
        below.bar(np.arange(len(durations)) + 1, durations, color=QUIET)
        below.set_ylabel("planned motion [s]")
        below.set_xlabel("plan")
        return svg(figure, "plans")


def latency(milliseconds: Sequence[float], marks: dict[str, float]) -> str:
    """Draw a histogram of frame ages with marks."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10, 2.8), layout="constrained")
        axes = figure.subplots()
        values = np.asarray(milliseconds, dtype=float)
        top = max(float(np.percentile(values, 99.5)), float(values.min()) + 1e-3)
        axes.hist(np.minimum(values, top), bins=60, color=LINES[0])
        for k, (name, value) in enumerate(marks.items()):
            axes.axvline(min(value, top), color=LINES[1 + k], linewidth=1.5, label=f"{name} {value:.1f} ms")
        axes.set_xlabel("age of the frame [ms]" + (f"; {(values > top).sum()} above" if (values > top).any() else ""))
        axes.set_ylabel("frames")
        axes.legend(fontsize=8)
        return svg(figure, "latency")


def joints(times: Array, positions: Array, velocities: Array, names: Sequence[str], limits: JointLimits | None) -> str:
    """Draw positions and velocities of each joint over time with their limits."""
    chosen = thinned(times, velocities)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10, 1.15 * len(names) + 0.8), layout="constrained")
        grid = figure.subplots(len(names), 2, sharex=True, squeeze=False)
        for k, name in enumerate(names):
            for column, values in enumerate((positions[:, k], velocities[:, k])):
                axes: Axes = grid[k][column]
                axes.plot(times[chosen], values[chosen], color=LINES[0], linewidth=1.0)
                if limits is not None:
                    low, high = ((limits.lower[k], limits.upper[k]) if column == 0
                                 else (-limits.velocity[k], limits.velocity[k]))
                    for limit in (low, high):
                        axes.axhline(limit, color=BAD, linewidth=0.9, linestyle="--")
                    axes.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low))
                if column == 0:
                    axes.set_ylabel(_short(name), rotation=0, ha="right", va="center")
        grid[0][0].set_title("position [rad or m]", fontsize=9)
        grid[0][1].set_title("speed [rad/s or m/s]", fontsize=9)
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
        return svg(figure, "joints")


def top_view(run: RunHistory, tool: Array, marks: Mapping[str, Mapping[tuple[int, int], int]]) -> str:
    """Draw the work area from above, as seen from the robot: +x up, +y to the left.

    Args:
        run: history of the run.
        tool: (n, 3) path of the tool [m].
        marks: further positions by label, in steps of `SAME_PLACE`; later labels are smaller and drawn on top.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.5, 6.5), layout="constrained")
        axes = figure.subplots()
        for solid in run.footprints.values():
            axes.fill(solid.corners[:, 1], solid.corners[:, 0], facecolor=(*solid.color, 0.18),
                      edgecolor=(*solid.color, 0.7), linewidth=0.8)
        if len(tool):
            axes.plot(tool[:, 1], tool[:, 0], color=QUIET, linewidth=0.6, alpha=0.8, label="path of the tool")
        for k, (label, places) in enumerate(marks.items()):
            x, y = (np.array(list(places), dtype=float) * SAME_PLACE).T
            axes.scatter(y, x, s=34 / 4**k, color=MARKS[k % len(MARKS)], label=label, linewidths=0)
        for crosses, marker, color, label in ((run.rejections, "x", BAD, "rejected"),
                                              (run.picks, "+", "#17a398", "picked")):
            if crosses:
                axes.scatter([p.position[1] for p in crosses], [p.position[0] for p in crosses], marker=marker,
                             s=70, color=color, linewidths=1.8, label=label)
        if truth := run.truth.objects:
            axes.scatter([p.position[1] for p in truth], [p.position[0] for p in truth], s=200,
                         facecolors="none", edgecolors="#3c4654", linewidths=0.8, label="truth at the end")
        from_above(figure, axes)
        return svg(figure, "top_view")


def thinned(times: Array, values: Array) -> npt.NDArray[np.intp]:
    """Return indices of at most about `MAX_POINTS` samples that include the extremes of each column."""
    if len(times) <= MAX_POINTS:
        return np.arange(len(times))
    step = -(-len(times) // MAX_POINTS)
    selected = set(range(0, len(times), step)) | {len(times) - 1}
    for column in values.T:
        if np.isfinite(column).any():
            selected |= {int(np.nanargmax(column)), int(np.nanargmin(column))}
    return np.array(sorted(selected))


def svg(figure: Figure, name: str) -> str:
    """Return the figure as an `svg` element without ids, so that a page can contain several."""
    text = StringIO()
    with mpl.rc_context({"svg.hashsalt": name}):
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    body = text.getvalue()
    body = body[body.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    return re.sub(r' id="[A-Za-z]\w*_\d+"', "", body).strip()


def from_above(figure: Figure, axes: Axes) -> None:
    """Orient the axes as seen from the robot: +x up, +y to the left."""
    axes.set_aspect("equal")
    axes.invert_xaxis()
    axes.set_xlabel("y [m]")
    axes.set_ylabel("x [m]")
    handles, labels = axes.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    if unique:
        figure.legend(unique.values(), unique.keys(), fontsize=8, loc="outside lower center", ncols=7)


def _short(name: str) -> str:
    return re.sub(r"^[a-z]+_(?=joint\d)|_joint$", "", name)
