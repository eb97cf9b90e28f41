"""The page of a report: one HTML document that asks nobody for anything."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from common.terminal import printable
from recording.report import figures
from recording.report.application import Figures
from recording.report.film import Film
from recording.report.gathering import MOST_LINES, Gathering

Array = npt.NDArray[np.float64]

Row = tuple[str | float | None, ...]  # of a table


@dataclass(frozen=True, eq=False)
class Report:
    """All that a page shows.

    Attributes:
        name: of the recording.
        about: what the recording says about its making and its run, by name.
        summary: the figures of the run, as `zencell run --summary` writes them.
        run: what was gathered.
        limits: of the arm's joints; None when they are not known.
        names: of the arm's joints.
        application: what the application says of the run.
        tool: (n, 3) way of the tool [m], empty when the robot is not known.
        notes: what is missing in the report, and why.
        lost: messages that did not get into the recording, by topic.
        films: of what went wrong.
    """

    name: str
    about: dict[str, str]
    summary: dict[str, Any]
    run: Gathering
    limits: figures.JointLimits | None
    names: list[str]
    application: Figures
    tool: Array
    notes: list[str]
    lost: dict[str, int]
    films: list[Film]


def page(report: Report) -> str:
    """The document: page.html with what is told of the run."""
    run, plans = report.run, report.summary["plans"]
    latencies = run.latencies
    marks = {name: float(np.percentile(latencies, q)) for name, q in (("median", 50), ("99 %", 99)) if latencies}
    times, positions, velocities = run.joints(report.names)
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )
    text = environment.get_template("page.html").render(
        vars(report), facts=report.application.facts(report.summary), most_lines=MOST_LINES,
        timeline=figures.timeline(run, report.application.STATE_COLORS),
        picture=report.application.picture(run, report.tool),
        plans=_plans(plans, run.trajectories), trajectories=run.trajectories,
        plans_figure=lambda: figures.plans(
            [plan["planner"] for plan in plans], [1e3 * plan["seconds"] for plan in plans],
            [seconds for _, seconds in run.trajectories],
        ),
        latencies=latencies, latency_marks=marks, latency_figure=lambda: figures.latency(latencies, marks),
        joints=_joints(report, positions, velocities),
        joints_figure=lambda: figures.joints(times, positions, velocities, report.names, report.limits),
        problems=_problems(run), services=_services(run), lost={k: n for k, n in report.lost.items() if n},
        log=[(event.time, event.level, event.what, event.note) for event in run.log],
    )
    return printable(text, keep="\n\t")


def _plans(plans: list[dict[str, Any]], trajectories: list[tuple[float, float]]) -> list[Row]:
    paired = trajectories if len(plans) == len(trajectories) else [(None, None)] * len(plans)
    return [
        (k, at, plan["planner"], 1e3 * plan["seconds"], plan["attempts"], plan["fraction"], lasts)
        for k, (plan, (at, lasts)) in enumerate(zip(plans, paired, strict=True), 1)
    ]


def _joints(report: Report, positions: Array, velocities: Array) -> list[Row]:
    rows: list[Row] = []
    for k, name in enumerate(report.names if len(positions) else ()):
        q, v = positions[:, k], velocities[:, k]
        fastest = float(np.nanmax(np.abs(v))) if np.isfinite(v).any() else None
        row: Row = (name, q.min(), q.max(), "not told" if fastest is None else fastest)
        if report.limits is not None:
            low, high, most = report.limits.lower[k], report.limits.upper[k], report.limits.velocity[k]
            row += (f"{low:.3f} to {high:.3f}", most, None if fastest is None else 100 * fastest / most)
        rows.append(row)
    return rows


def _problems(run: Gathering) -> list[Row]:
    """What went wrong: when [s], what, where and why, in the order of time."""
    rows: list[tuple[float, str, str, str]] = []
    for what, places in (("rejected", run.rejections), ("given up", run.skipped.values())):
        rows += [(p.time, what, "({:.3f}, {:.3f}, {:.3f})".format(*p.position), p.label) for p in places]
    for motion in run.motions:
        if motion.note not in ("succeeded", "not ended"):
            why = filter(None, (motion.message or motion.error, f"[{motion.source}]" if motion.source else ""))
            rows.append((motion.until or motion.since, f"motion {motion.note}", motion.label, " ".join(why)))
    rows += [(span.since, "task failed", span.note, "see the log below") for span in run.tasks if span.label == "ERROR"]
    rows += [(event.time, "started again", event.what, event.note) for event in run.restarts]
    rows += [(event.time, "lost, by truth", event.what, event.note) for event in run.losses]
    rows.sort(key=lambda row: row[0])
    return [*rows]


def _services(run: Gathering) -> list[Row]:
    rows: list[Row] = []
    for name in {**run.services, **run.counters}:
        service, counted = run.services.get(name), run.counters.get(name)
        told = (service.state, service.ready_seconds, service.restarts) if service else ("", None, None)
        lost = [sum(getattr(counted, kind).values()) if counted else 0 for kind in ("dropped", "invalid", "overflow")]
        rows.append((name, *told, *lost))
    return rows
