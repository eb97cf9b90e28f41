"""Builds the HTML report of a recording: finds its cell, aggregates its messages, renders page.html."""

from __future__ import annotations

import json
import re
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from common.application import Application, ApplicationTopics, find_application
from common.config import load_cell, names_of
from common.errors import UnknownName, ZencellError
from common.messages import TaskStatus
from common.robot.model import RobotModel
from common.terminal import printable
from common.topics import Topic, general_key
from recording.report import charts
from recording.report.aggregator import RunAggregator, recorded_application
from recording.report.clips import clips
from recording.report.history import MOST_LINES, Event, RunHistory
from recording.sample import Decoder, RecordingError
from recording.writer import ABOUT

if TYPE_CHECKING:
    from common.config import Cell
    from common.messages import JointState
    from recording.reader import Recording, Run
    from recording.report.application import Figures
    from recording.report.clips import Clip
    from recording.sample import Sample

# Overrides in a recording that are applied: numbers or one word, which can name neither a file nor a module.
HARMLESS = re.compile(r"[\w.]{1,100}=([A-Za-z_]\w{0,60}|[-+0-9.eE, \[\]]{1,100})", re.ASCII)
STATUS_FIELDS = {"state", "started", "stage", "subject", "done", "total", "figures"}  # of every task's status
TOOL_PERIOD = 0.05  # [s] between positions of the tool that are shown

Array = npt.NDArray[np.float64]
Row = tuple[str | float | None, ...]  # of a table


@dataclass(frozen=True, eq=False)
class Report:
    """Content of a report.

    Attributes:
        name: of the recording.
        about: description of the recording and its run, by label.
        summary: figures of the run, as `zencell run --summary` writes them.
        run: history of the run.
        limits: of the arm's joints; None if unknown.
        names: of the arm's joints.
        application: figures class of the application.
        tool: (n, 3) path of the tool [m], empty if the robot is unknown.
        notes: what is missing in the report, and why.
        lost: messages that are not in the recording, by topic.
        clips: of what went wrong.
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
    clips: list[Clip]


def build_report(recording: Recording, cell: str | None = None) -> str:
    """Return the report of a recording as an HTML document without external resources.

    Raises:
        RecordingError: the recording is damaged, or has no messages of a run.
        ConfigError: `cell` is not a cell.
    """
    about, run = recording.metadata(ABOUT), recording.run
    notes: list[str] = []
    resolved = _cell_of(recording, cell, run, notes)
    robot = _robot_of(resolved, notes)
    history = RunHistory()
    aggregator = RunAggregator(
        recording.cell, _application_of(recording, resolved), robot=resolved.robot if resolved and robot else None,
        seed=run.seed or 0, speed=run.speed, history=history,
        containers=resolved.world.destinations if resolved else (),
        parameters=resolved.task_parameters if resolved else None,
    )
    skipped = _aggregate(recording, run, aggregator)
    if not (aggregator.status or history.joint_states or history.services):
        raise RecordingError(f"{recording.path}: has no messages of a run; "
                             "a report needs a task's status, joint_states or supervisor/status")
    history.finish(recording.seconds)
    if left := aggregator.summary.unexplained:
        places = ", ".join(f"({x:.3f}, {y:.3f}, {z:.3f})" for x, y, z in left)
        ended = history.tasks[-1].since
        history.losses.append(Event(ended, "DONE", f"but left at {places}: not reported by the task"))
    if not recording.finished:
        notes.append(truncated_note(recording))
    if skipped:
        notes.append("Unknown messages: " + ", ".join(f"{n} x {topic}" for topic, n in skipped.items()))
    aggregator.summary.restarts = {
        name: service.restarts for name, service in history.services.items() if service.restarts}
    names = robot.joint_names if robot else _arm_joints(history)
    lost = dict(Counter(recording.lost("dropped")) + Counter(recording.lost("missed")))
    return render(Report(
        recording.path.name, _about(recording, about, run), aggregator.summary.as_dict(), history, _limits(robot),
        list(names), aggregator.figures, _tool(history, robot), notes, lost, clips(recording, history),
    ))


def _aggregate(recording: Recording, run: Run, aggregator: RunAggregator) -> Counter[str]:
    """Feed all messages to the aggregator; return the number of unknown ones by topic."""
    wanted = {topic.key: topic for topic in aggregator.topics}
    decoder = Decoder(topic.message for topic in aggregator.topics)
    for sample in recording.samples(lambda topic: general_key(topic) in wanted):
        if wanted[general_key(sample.topic)].message is TaskStatus:  # of a task that is not installed
            decoder.custom[sample.message] = TaskStatus
        message = decoder.message(sample)
        if isinstance(message, wanted[general_key(sample.topic)].message):
            since = run.epoch or sample.log_time
            now_ns = since + round((sample.log_time - since) * run.speed)
            aggregator.on(sample.topic, message, (sample.log_time - recording.start) * 1e-9, now_ns)
    return decoder.skipped


def _application_of(recording: Recording, cell: Cell | None) -> Application | None:
    """Return the application of the cell; without a cell the one whose status was recorded.

    An application that is not installed is reported by what every task's status has.
    """
    if cell is not None:
        return find_application(cell.application)
    if (found := recorded_application(list(recording.topics()))) is not None:
        return found
    for key, (_, kind) in recording.topics().items():
        if kind == "state" and _is_task_status(next(recording.samples(key.__eq__), None)):
            return Application(topics=ApplicationTopics(status=Topic(key, TaskStatus, "state", "")))
    return None


def _is_task_status(sample: Sample | None) -> bool:
    """Return whether the recorded schema of a message has the fields of a task's status."""
    try:
        return sample is not None and set(json.loads(sample.schema)["properties"]) >= STATUS_FIELDS
    except (ValueError, TypeError, KeyError, RecursionError):
        return False


def truncated_note(recording: Recording) -> str:
    """Return the note about an unfinished recording."""
    flaw = recording.flaw if recording.layout.holes else "truncated"
    return (f"{recording.path} is {flaw}; the report shows its complete chunks; to make a file that other programs "
            f"can read: zencell recover {recording.path}")


def _cell_of(recording: Recording, selected: str | None, run: Run, notes: list[str]) -> Cell | None:
    """Return the recorded cell if its files are installed; no file that only the recording names is read."""
    if selected is not None:
        return load_cell(selected)
    reason: object = None
    if run.world and run.world not in names_of("worlds"):
        reason = f"a file named in a recording is not read: world {run.world!r}"
    elif foreign := next((text for text in run.overrides if not HARMLESS.fullmatch(text)), None):
        reason = f"a file named in a recording is not read: {foreign!r} may name one"
    elif recording.cell in names_of("cells"):
        try:
            return load_cell(recording.cell, run.overrides, world=run.world or None)
        except ZencellError as error:
            reason = error
    try:
        if recording.cell not in names_of("cells"):
            raise UnknownName("cell", recording.cell, names_of("cells"))
        found = load_cell(recording.cell)
    except ZencellError as error:
        notes.append(f"Joint limits and the path of the tool are missing, since the cell is not installed "
                     f"({reason or error}); name it with --cell.")
        return None
    notes.append(f"The robot is that of the installed cell, without the overrides of the run: {reason}")
    return found


def _robot_of(cell: Cell | None, notes: list[str]) -> RobotModel | None:
    if cell is None:
        return None
    try:
        return RobotModel.load(cell.robot)
    except ZencellError as error:
        notes.append(f"Joint limits and the path of the tool are missing: {error}")
        return None


def _limits(robot: RobotModel | None) -> charts.JointLimits | None:
    if robot is None:
        return None
    return charts.JointLimits(list(robot.joint_names), robot.lower, robot.upper, robot.velocity)


def _arm_joints(run: RunHistory) -> list[str]:
    """Return the recorded joints without those of fingers, for an unknown robot."""
    first: JointState | None = run.joint_states[0] if run.joint_states else None
    return [name for name in first.name if "finger" not in name and "knuckle" not in name] if first else []


def _tool(run: RunHistory, robot: RobotModel | None) -> Array:
    """Return the (n, 3) path of the tool centre point [m]."""
    positions: list[Array] = []
    last = -1.0
    if robot is not None:
        for at, state in zip(run.joint_times, run.joint_states, strict=True):
            if at - last >= TOOL_PERIOD and (q := robot.order(state.name, state.position)) is not None:
                positions.append(robot.fk(q)[:3, 3])
                last = at
    return np.array(positions).reshape(-1, 3)


def _about(recording: Recording, about: dict[str, Any], run: Run) -> dict[str, str]:
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(recording.start * 1e-9))
    facts = {"recorded": f"{when}, {recording.seconds:.1f} s", "speed": f"{run.speed:g}",
             "seed": "unknown" if run.seed is None else str(run.seed)}
    if run.world:
        facts["world"] = run.world
    if run.overrides:
        facts["set"] = ", ".join(run.overrides)
    versions = about.get("versions")
    if isinstance(versions, dict) and "zencell" in versions:
        facts["zencell"] = str(versions["zencell"])
    return facts


# --- rendering --------------------------------------------------------------------------------------------------------


def render(report: Report) -> str:
    """Return page.html filled with a report."""
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
        plans=_plan_rows(plans, run.trajectories), trajectories=run.trajectories,
        plans_figure=lambda: charts.plans(
            [plan["planner"] for plan in plans], [1e3 * plan["seconds"] for plan in plans],
            [seconds for _, seconds in run.trajectories],
        ),
        latencies=latencies, latency_marks=marks, latency_figure=lambda: charts.latency(latencies, marks),
        joints=_joint_rows(report, positions, velocities),
        joints_figure=lambda: charts.joints(times, positions, velocities, report.names, report.limits),
        problems=_problem_rows(run), services=_service_rows(run), lost={k: n for k, n in report.lost.items() if n},
        signals=[(event.time, event.what, event.note) for event in run.signals[:MOST_LINES]],
        log=[(event.time, event.level, event.what, event.note) for event in run.log],
    )
    return printable(text, keep="\n\t")


def _plan_rows(plans: list[dict[str, Any]], trajectories: list[tuple[float, float]]) -> list[Row]:
    paired = trajectories if len(plans) == len(trajectories) else [(None, None)] * len(plans)
    return [
        (k, at, plan["planner"], 1e3 * plan["seconds"], plan["attempts"], plan["fraction"], duration)
        for k, (plan, (at, duration)) in enumerate(zip(plans, paired, strict=True), 1)
    ]


def _joint_rows(report: Report, positions: Array, velocities: Array) -> list[Row]:
    rows: list[Row] = []
    for k, name in enumerate(report.names if len(positions) else ()):
        q, v = positions[:, k], velocities[:, k]
        fastest = float(np.nanmax(np.abs(v))) if np.isfinite(v).any() else None
        row: Row = (name, q.min(), q.max(), "unknown" if fastest is None else fastest)
        if report.limits is not None:
            low, high, most = report.limits.lower[k], report.limits.upper[k], report.limits.velocity[k]
            row += (f"{low:.3f} to {high:.3f}", most, None if fastest is None else 100 * fastest / most)
        rows.append(row)
    return rows


def _problem_rows(run: RunHistory) -> list[Row]:
    """Return what went wrong in order of time: when [s], what, where and why."""
    rows: list[tuple[float, str, str, str]] = []
    for what, marks in (("rejected", run.rejections), ("skipped", run.skipped.values())):
        rows += [(p.time, what, "({:.3f}, {:.3f}, {:.3f})".format(*p.position), p.label) for p in marks]
    for motion in run.motions:
        if motion.note not in ("succeeded", "not ended"):
            why = filter(None, (motion.message or motion.error, f"[{motion.source}]" if motion.source else ""))
            rows.append((motion.until or motion.since, f"motion {motion.note}", motion.label, " ".join(why)))
    rows += [(span.since, "task failed", span.note, "see the log below") for span in run.tasks if span.label == "ERROR"]
    rows += [(event.time, "restarted", event.what, event.note) for event in run.restarts]
    rows += [(event.time, "lost, by truth", event.what, event.note) for event in run.losses]
    rows.sort(key=lambda row: row[0])
    return [*rows]


def _service_rows(run: RunHistory) -> list[Row]:
    rows: list[Row] = []
    for name in {**run.services, **run.counters}:
        service, counted = run.services.get(name), run.counters.get(name)
        state = (service.state, service.ready_seconds, service.restarts) if service else ("", None, None)
        lost = [sum(getattr(counted, kind).values()) if counted else 0 for kind in ("dropped", "invalid", "overflow")]
        rows.append((name, *state, *lost))
    return rows
