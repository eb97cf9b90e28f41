"""The page of a report: one HTML document that asks nobody for anything."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

from common.reporting import figures
from common.reporting.application import Figures
from common.reporting.gathering import MOST_LINES, Gathering

Array = npt.NDArray[np.float64]

_CSS = """
:root { color-scheme: light; --ink: #1d2733; --quiet: #5d6a7a; --line: #e1e5ea; --bad: #b42323; --good: #2c7a2c; }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); margin: 0 auto; max-width: 68rem; padding: 1.5rem; }
h1 { font-size: 1.6rem; margin: 0; } h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
p { margin: .4rem 0; } .quiet { color: var(--quiet); } .bad { color: var(--bad); } .good { color: var(--good); }
.facts { display: grid; grid-template-columns: repeat(auto-fill, minmax(9.5rem, 1fr)); gap: .7rem; margin: 1rem 0; }
.facts div { border: 1px solid var(--line); border-radius: .5rem; padding: .5rem .7rem; }
.facts dt { color: var(--quiet); font-size: .8rem; } .facts dd { margin: 0; font-size: 1.15rem; font-weight: 600; }
table { border-collapse: collapse; width: 100%; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .25rem .6rem; border-bottom: 1px solid var(--line); vertical-align: top; }
th { color: var(--quiet); font-weight: 500; } td.number, th.number { text-align: right; white-space: nowrap; }
svg { max-width: 100%; height: auto; overflow: visible; }
details summary { cursor: pointer; color: var(--quiet); margin: .5rem 0; }
.scroll { overflow-x: auto; }
"""


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


def page(report: Report) -> str:
    """The document."""
    picture = report.application.picture(report.run, report.tool)
    sections = [
        ("summary", "", _head(report)),
        ("timeline", "Timeline", figures.timeline(report.run, report.application.STATE_COLORS)),
        *([picture] if picture is not None else []),
        ("plans", "Plans", _plans(report)),
        ("latency", "From the picture to what was seen in it", _latency(report)),
        ("joints", "Joints", _joints(report)),
        ("problems", "What was rejected and what failed", _problems(report)),
        ("services", "Processes", _services(report)),
        ("log", "Warnings and errors", _log(report.run)),
    ]
    body = "\n".join(
        f'<section id="{name}">{f"<h2>{title}</h2>" if title else ""}{content}</section>'
        for name, title, content in sections if content
    )
    title = f"{report.summary['cell']}: {report.summary['state']} - {report.name}"
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_CSS}</style></head>\n<body>\n{body}\n</body></html>\n"
    )


def _head(report: Report) -> str:
    s, seconds = report.summary, report.summary["seconds"]
    state = {"DONE": "good", "ERROR": "bad"}.get(s["state"], "quiet")
    facts = report.application.facts(s)
    facts += [("task", _seconds(seconds["task"])), ("moving", _seconds(seconds["moving"])),
              ("planning", f"{_seconds(seconds['planning'])} in {len(s['plans'])} plans"),
              ("failures, retries", f"{s['failures']}, {s['retries']}")]
    if s["frame_to_target_ms"]["p50"] is not None:
        facts.append(("frame to target", f"{s['frame_to_target_ms']['p50']:.1f} ms (median)"))
    restarts = sum(s["restarts"].values())
    facts.append(("started again", f"{restarts} x" if restarts else "nothing"))
    about = "; ".join(f"{escape(name)} {escape(value)}" for name, value in report.about.items())
    cells = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in facts)
    notes = "".join(f'<p class="bad">{escape(note)}</p>' for note in report.notes)
    return (f'<h1>{escape(s["cell"])}: <span class="{state}">{escape(s["state"])}</span></h1>'
            f'<p class="quiet">{escape(report.name)}; {about}</p>{notes}<dl class="facts">{cells}</dl>')


def _plans(report: Report) -> str:
    made, trajectories = report.summary["plans"], report.run.trajectories
    if not made and not trajectories:
        return "<p>Nothing was planned.</p>"
    durations = [seconds for _, seconds in trajectories]
    paired = len(made) == len(trajectories)
    rows = [
        (str(k + 1), _number(trajectories[k][0], 2) if paired else "", plan["planner"],
         _number(1e3 * plan["seconds"], 1), str(plan["attempts"]), f"{plan['fraction']:.2f}",
         _number(trajectories[k][1], 2) if paired else "")
        for k, plan in enumerate(made)
    ]
    head = ("plan", "at [s]", "planner", "planning [ms]", "attempts", "fraction", "motion [s]")
    picture = figures.plans([p["planner"] for p in made], [1e3 * p["seconds"] for p in made], durations)
    unpaired = "" if paired else (f"<p class=quiet>{len(trajectories)} trajectories were published and {len(made)} "
                                  "plans are told of by the task: they are not matched.</p>")
    return f"{picture}{unpaired}{_details('all plans', _table(head, rows, numbers=(0, 1, 3, 4, 5, 6)))}"


def _latency(report: Report) -> str:
    values = report.run.latencies
    if not values:
        return "<p>No frame led to anything that was recorded.</p>"
    marks = {name: float(np.percentile(values, q)) for name, q in (("median", 50), ("99 %", 99))}
    text = ", ".join(f"{name} {value:.1f} ms" for name, value in marks.items())
    frames = "1 frame" if len(values) == 1 else f"{len(values)} frames"
    return f"{figures.latency(values, marks)}<p>{frames}: {text}, at most {max(values):.1f} ms.</p>"


def _joints(report: Report) -> str:
    times, positions, velocities = report.run.joints(report.names)
    if not len(times):
        return "<p>No joint states of this arm were recorded.</p>"
    rows = []
    for k, name in enumerate(report.names):
        q, v = positions[:, k], velocities[:, k]
        fastest = float(np.nanmax(np.abs(v))) if np.isfinite(v).any() else None
        row = [name, _number(float(q.min()), 3), _number(float(q.max()), 3),
               _number(fastest, 3) if fastest is not None else "not told"]
        if report.limits is not None:
            low, high, most = report.limits.lower[k], report.limits.upper[k], report.limits.velocity[k]
            row += [f"{low:.3f} to {high:.3f}", _number(float(most), 3),
                    f"{fastest / most:.0%}" if fastest is not None else ""]
        rows.append(row)
    head = ["joint", "least [rad]", "most [rad]", "fastest [rad/s]"]
    head += ["limits [rad]", "limit [rad/s]", "of the limit"] if report.limits is not None else []
    picture = figures.joints(times, positions, velocities, report.names, report.limits)
    return f"{picture}<div class=scroll>{_table(head, rows, numbers=range(1, len(head)))}</div>"


def _problems(report: Report) -> str:
    run = report.run
    rows = [(_number(p.time, 2), "rejected", _place(p.position), p.label) for p in run.rejections]
    rows += [(_number(p.time, 2), "given up", _place(p.position), p.label) for p in run.skipped.values()]
    rows += [(_number(o.until or o.since, 2), f"motion {o.note}", o.label,
              " ".join(part for part in (o.message or o.error, f"[{o.source}]" if o.source else "") if part))
             for o in run.motions if o.note not in ("succeeded", "not ended")]
    rows += [(_number(s.since, 2), "task failed", s.note, "see the log below") for s in run.tasks if s.label == "ERROR"]
    rows += [(_number(e.time, 2), "started again", e.what, e.note) for e in run.restarts]
    if not rows:
        return "<p>Nothing.</p>"
    rows.sort(key=lambda row: float(row[0]))
    left_out = f"<p class=quiet>{len(rows) - MOST_LINES} more are left out.</p>" if len(rows) > MOST_LINES else ""
    return _table(("at [s]", "what", "where", "why"), rows[:MOST_LINES], numbers=(0,)) + left_out


def _services(report: Report) -> str:
    run, rows = report.run, []
    for name in [*run.services, *(name for name in run.counters if name not in run.services)]:
        service, counted = run.services.get(name), run.counters.get(name)
        lost = [sum(getattr(counted, kind).values()) if counted else 0 for kind in ("dropped", "invalid", "overflow")]
        ready = service.ready_seconds if service else None
        rows.append((name, service.state if service else "", _number(ready, 2) if ready is not None else "",
                     str(service.restarts) if service else "", *(str(value) for value in lost)))
    if not rows:
        return "<p>Nothing is known of the processes.</p>"
    head = ("process", "at the end", "ready after [s]", "restarts", "superseded", "invalid", "overflow")
    lost_text = ", ".join(f"{escape(topic)} {count}" for topic, count in report.lost.items() if count)
    lost_line = f"<p>Not in the recording: {lost_text}.</p>" if lost_text else ""
    return (f"{_table(head, rows, numbers=range(2, 7))}<p class=quiet>Superseded: a newer message of a stream came "
            f"before one was read, which is as it should be. Counted since the last start.</p>{lost_line}")


def _log(run: Gathering) -> str:
    if not run.log:
        return "<p>None.</p>"
    rows = [(_number(e.time, 2), e.level, e.what, e.note) for e in run.log]
    more = f"<p class=quiet>{run.lines_left_out} more are left out.</p>" if run.lines_left_out else ""
    return _table(("at [s]", "level", "service", "message"), rows, numbers=(0,)) + more


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], numbers: Iterable[int] = ()) -> str:
    right = set(numbers)

    def cells(tag: str, values: Sequence[str]) -> str:
        return "".join(f'<{tag}{" class=number" if k in right else ""}>{escape(value)}</{tag}>'
                       for k, value in enumerate(values))

    lines = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f"<table><thead><tr>{cells('th', head)}</tr></thead><tbody>{lines}</tbody></table>"


def _details(title: str, content: str) -> str:
    return f"<details><summary>{escape(title)}</summary>{content}</details>"


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}"


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.1f} s"


def _place(position: tuple[float, float, float]) -> str:
    return f"({position[0]:.3f}, {position[1]:.3f}, {position[2]:.3f})"
