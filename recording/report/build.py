"""The page about a recorded run: its cell is found as far as it is here, and what was said in it is folded."""

from __future__ import annotations

import re
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from common.errors import UnknownName, ZencellError
from common.terminal import printable
from recording.report import charts
from recording.report.application import Figures
from recording.report.clips import Clip
from recording.report.history import MOST_LINES, Event, RunHistory

if TYPE_CHECKING:
    from common.application import Application
    from common.config import Cell
    from common.messages import JointState
    from common.robot.model import RobotModel
    from recording.reader import Recording, Run


# An override that a recording tells and that is taken: numbers or one word, which names no file and no module.
HARMLESS = re.compile(r"[\w.]{1,100}=([A-Za-z_]\w{0,60}|[-+0-9.eE, \[\]]{1,100})", re.ASCII)
TOOL_PERIOD = 0.05  # [s] between places of the tool that are shown


def build_report(recording: Recording, cell: str | None = None) -> str:
    """The page of a recording.

    Raises:
        RecordingError: it is damaged, or says nothing about a run.
        ConfigError: `cell` is none.
    """
    from common.topics import general_key
    from recording.report.aggregator import RunAggregator
    from recording.report.clips import films
    from recording.sample import Decoder, RecordingError
    from recording.writer import ABOUT

    about, run = recording.metadata(ABOUT), recording.run
    notes: list[str] = []
    resolved = _cell_of(recording, cell, run, notes)
    robot = _robot_of(resolved, notes)
    gathered = RunHistory()
    fold = RunAggregator(
        recording.cell, _application_of(recording, resolved), robot=resolved.robot if resolved and robot else None,
        seed=run.seed or 0, speed=run.speed, gathering=gathered,
        containers=list(resolved.world.containers) if resolved else (),
    )
    wanted = {topic.key: topic for topic in fold.topics}
    decoder = Decoder(topic.message for topic in fold.topics)
    for sample in recording.samples(lambda topic: general_key(topic) in wanted):
        message = decoder.message(sample)
        if isinstance(message, wanted[general_key(sample.topic)].message):
            since = run.epoch or sample.log_time
            now_ns = since + round((sample.log_time - since) * run.speed)
            fold.on(sample.topic, message, (sample.log_time - recording.start) * 1e-9, now_ns)
    if not (fold.status or gathered.joint_states or gathered.services):
        raise RecordingError(f"{recording.path}: says nothing about a run; "
                             "it needs a task's status, joint_states or supervisor/status")
    gathered.finish(recording.seconds)
    if left := fold.summary.unexplained:
        places = ", ".join(f"({x:.3f}, {y:.3f}, {z:.3f})" for x, y, z in left)
        ended = gathered.tasks[-1].since
        gathered.losses.append(Event(ended, "DONE", f"but left at {places}: not among what was rejected"))
    if not recording.finished:
        notes.append(cut(recording))
    if decoder.skipped:
        notes.append("Not understood: " + ", ".join(f"{n} x {topic}" for topic, n in decoder.skipped.items()))
    fold.summary.restarts = {name: service.restarts for name, service in gathered.services.items() if service.restarts}
    names = robot.joint_names if robot else _arm_joints(gathered)
    lost = dict(Counter(recording.lost("dropped")) + Counter(recording.lost("missed")))
    return page(Report(
        recording.path.name, _facts(recording, about, run), fold.summary.as_dict(), gathered, _limits(robot),
        list(names), fold.figures, _tool(gathered, robot), notes, lost, films(recording, gathered),
    ))


def _application_of(recording: Recording, cell: Cell | None) -> Application | None:
    """What was recorded was done for this; where the cell is not here, whose status was recorded."""
    from common.application import find_application
    from recording.report.aggregator import recorded_application

    return find_application(cell.application) if cell is not None else recorded_application(list(recording.topics()))


def cut(recording: Recording) -> str:
    """What is said of a recording that was not finished."""
    return (f"{recording.path} was cut: the page shows what is whole; `zencell recover {recording.path}` makes a file "
            "of it that others can read")


def _cell_of(recording: Recording, given: str | None, run: Run, notes: list[str]) -> Cell | None:
    """The cell that was recorded, as far as its files are here: none is read that only the recording names."""
    from common.config import load_cell, names_of

    if given is not None:
        return load_cell(given)
    first: object = None
    if run.world and run.world not in names_of("worlds"):
        first = f"no file is read that a recording names, as world {run.world!r}"
    elif foreign := next((text for text in run.overrides if not HARMLESS.fullmatch(text)), None):
        first = f"no file is read that a recording names, as {foreign!r} may do"
    elif recording.cell in names_of("cells"):
        try:
            return load_cell(recording.cell, run.overrides, world=run.world or None)
        except ZencellError as error:
            first = error
    try:
        if recording.cell not in names_of("cells"):
            raise UnknownName("cell", recording.cell, names_of("cells"))
        found = load_cell(recording.cell)
    except ZencellError as error:
        first = first or error
        notes.append(f"Limits and the way of the tool are not shown, since the cell is not here ({first}); "
                     "name it with --cell.")
        return None
    notes.append(f"The robot is that of the cell as it is here, without what was set for the run: {first}")
    return found


def _robot_of(cell: Cell | None, notes: list[str]) -> RobotModel | None:
    if cell is None:
        return None
    from common.robot.model import RobotModel

    try:
        return RobotModel.load(cell.robot)
    except ZencellError as error:
        notes.append(f"Limits and the way of the tool are not shown: {error}")
        return None


def _limits(robot: RobotModel | None) -> Any:
    if robot is None:
        return None
    return charts.JointLimits(list(robot.joint_names), robot.lower, robot.upper, robot.velocity)


def _arm_joints(run: RunHistory) -> list[str]:
    """Joints that are recorded, without those of fingers, where no robot file says which they are."""
    first: JointState | None = run.joint_states[0] if run.joint_states else None
    return [name for name in first.name if "finger" not in name and "knuckle" not in name] if first else []


def _tool(run: RunHistory, robot: RobotModel | None) -> Any:
    """(n, 3) places of the tool centre point [m]."""
    places, last = [], -1.0
    for at, state in zip(run.joint_times, run.joint_states, strict=True) if robot is not None else ():
        if at - last >= TOOL_PERIOD:
            q = robot.order(state.name, state.position) if robot is not None else None
            if q is not None:
                places.append(robot.fk(q)[:3, 3])  # type: ignore[union-attr]
                last = at
    return np.array(places).reshape(-1, 3)


def _facts(recording: Recording, about: dict[str, Any], run: Run) -> dict[str, str]:
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(recording.start * 1e-9))
    facts = {"recorded": f"{when}, {recording.seconds:.1f} s", "speed": f"{run.speed:g}",
             "seed": "not told" if run.seed is None else str(run.seed)}
    if run.world:
        facts["world"] = run.world
    if run.overrides:
        facts["set"] = ", ".join(run.overrides)
    versions = about.get("versions")
    if isinstance(versions, dict) and "zencell" in versions:
        facts["zencell"] = str(versions["zencell"])
    return facts


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
    run: RunHistory
    limits: charts.JointLimits | None
    names: list[str]
    application: Figures
    tool: Array
    notes: list[str]
    lost: dict[str, int]
    films: list[Clip]


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
        timeline=charts.timeline(run, report.application.STATE_COLORS),
        picture=report.application.picture(run, report.tool),
        plans=_plans(plans, run.trajectories), trajectories=run.trajectories,
        plans_figure=lambda: charts.plans(
            [plan["planner"] for plan in plans], [1e3 * plan["seconds"] for plan in plans],
            [seconds for _, seconds in run.trajectories],
        ),
        latencies=latencies, latency_marks=marks, latency_figure=lambda: charts.latency(latencies, marks),
        joints=_joints(report, positions, velocities),
        joints_figure=lambda: charts.joints(times, positions, velocities, report.names, report.limits),
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


def _problems(run: RunHistory) -> list[Row]:
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


def _services(run: RunHistory) -> list[Row]:
    rows: list[Row] = []
    for name in {**run.services, **run.counters}:
        service, counted = run.services.get(name), run.counters.get(name)
        told = (service.state, service.ready_seconds, service.restarts) if service else ("", None, None)
        lost = [sum(getattr(counted, kind).values()) if counted else 0 for kind in ("dropped", "invalid", "overflow")]
        rows.append((name, *told, *lost))
    return rows
