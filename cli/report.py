"""A page about a recorded run."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli.recording import File
from common.applications.outlining.messages import OutlineStatus
from common.errors import ConfigError, ZencellError

if TYPE_CHECKING:
    from collections.abc import Callable

    from common.config import Cell
    from common.messages import JointState
    from common.recording.reading import Recording
    from common.reporting.gathering import Gathering
    from common.robot.model import RobotModel
    from common.supervision.summary import Summary

TOOL_PERIOD = 0.05  # [s] between places of the tool that are shown


def report(
    file: File,
    output: Annotated[str, typer.Option("-o", "--output", metavar="FILE.html", help="[beside the recording]")] = "",
    cell: Annotated[
        str | None, typer.Option("--cell", metavar="CELL", help="whose robot it was, if the recording's is not here")
    ] = None,
) -> None:
    """Write one page about a recorded run: timeline, plans, latency, joints, what was seen, and what went wrong."""
    from common.recording.reading import Recording

    path = Path(file)
    page_path = Path(output).expanduser() if output else path.with_suffix(".html")
    if page_path.suffix not in (".html", ".htm"):
        raise ConfigError("--output", output, "must end in .html")
    if not page_path.absolute().parent.is_dir():
        raise ConfigError("--output", output, "can not be written: the folder does not exist")
    with Recording(path) as recording:
        text = page_of(recording, cell)
        if not recording.finished:
            typer.echo(f"zencell: {_cut(recording)}", err=True)
    try:
        page_path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError("--output", str(page_path), f"can not be written: {error.strerror}") from None
    typer.echo(f"{page_path}: {len(text) / 1e6:.1f} MB")


def page_of(recording: Recording, cell: str | None = None) -> str:
    """The page of a recording.

    Raises:
        RecordingError: it is damaged, or says nothing about a run.
        ConfigError: `cell` is none.
    """
    from common.recording.decoding import Decoder
    from common.recording.sample import RecordingError
    from common.recording.writing import ABOUT, ENDED, RUN
    from common.reporting.page import Report, page

    about, run = recording.metadata(ABOUT), recording.metadata(RUN)
    notes: list[str] = []
    resolved = _cell_of(recording, cell, run, notes)
    listener = _Listener(recording, run, resolved)
    decoder = Decoder()
    for sample in recording.samples(lambda topic: topic in listener.routes):
        message = decoder.message(sample)
        if message is not None:
            listener.take(sample.topic, message, sample.log_time)
    gathered, summary = listener.gathered, listener.summary
    if not (listener.heard_task or gathered.joint_states or gathered.services):
        raise RecordingError(f"{recording.path}: says nothing about a run; "
                             "it needs a task's status, joint_states or supervisor/status")
    gathered.finish(recording.seconds)
    if not recording.finished:
        notes.append(_cut(recording))
    if decoder.skipped:
        notes.append("Not understood: " + ", ".join(f"{n} x {topic}" for topic, n in decoder.skipped.items()))
    summary.restarts = {name: service.restarts for name, service in gathered.services.items() if service.restarts}
    robot = _robot_of(resolved, notes)
    names = robot.joint_names if robot else _arm_joints(gathered)
    ended = recording.metadata(ENDED)
    lost: dict[str, int] = {}
    for kind in ("dropped", "missed"):
        for key, count in (ended.get(kind) or {}).items():
            lost[key.partition("/")[2]] = lost.get(key.partition("/")[2], 0) + count
    return page(Report(
        recording.path.name, _facts(recording, about, run), _figures(summary), gathered, _limits(robot), list(names),
        _tool(gathered, robot), _tool(gathered, robot, during="TRACING", period=0.0), notes, lost,
    ))


class _Listener:
    """Hands each message to whom it concerns, with times [s] since the recording began."""

    def __init__(self, recording: Recording, run: dict[str, Any], cell: Cell | None) -> None:
        from common import topics as t
        from common.applications.outlining import topics as outlining
        from common.applications.pick_place import topics as pick_place
        from common.reporting.gathering import Gathering
        from common.supervision.collector import STATUS_OF_TASK
        from common.supervision.summary import Summary
        from common.supervision.traced import Traced

        self._start = recording.start
        self._speed = float(run.get("speed") or 1.0)
        self._epoch = int(run.get("epoch") or 0)
        self.heard_task = False
        g = self.gathered = Gathering()
        s = self.summary = Summary(recording.cell, int(run.get("seed") or 0), self._speed)
        if cell is not None and STATUS_OF_TASK.get(cell.task) is outlining.OUTLINE_STATUS:
            s.traced = Traced(cell.robot)
        self.routes: dict[str, list[Callable[[float, Any], None]]] = {
            pick_place.PICK_PLACE_STATUS.key: [g.on_task, self._on_task],
            outlining.OUTLINE_STATUS.key: [g.on_task, self._on_task],
            t.MOTION_STATUS.key: [g.on_motion, lambda time, status: s.on_motion(status, time)],
            t.GRIPPER_STATE.key: [g.on_gripper],
            t.DISPLAY_TRAJECTORY.key: [g.on_trajectory],
            t.JOINT_STATES.key: [g.on_joints, lambda _, state: s.traced.on_joints(state) if s.traced else None],
            pick_place.DETECTED_OBJECTS.key: [g.on_detections],
            pick_place.VALIDATED_TARGETS.key: [self._on_targets],
            pick_place.REJECTED_TARGETS.key: [g.on_rejections, lambda _, message: s.rejected.add(message.rejected)],
            t.PLANNING_SCENE.key: [g.on_scene],
            pick_place.SCENE_BALLS.key: [g.on_truth, self._on_balls],
            t.SCENE_OBJECTS.key: [g.on_objects, lambda _, truth: s.traced.on_truth(truth) if s.traced else None],
            outlining.CONTOUR_PATH.key: [g.on_contour, self._on_path],
            t.SUPERVISOR_STATUS.key: [g.on_services],
            t.LOG.key: [g.on_log],
            t.COUNTERS.key: [g.on_counters],
        }

    def take(self, topic: str, message: Any, log_time: int) -> None:
        """One message that came at a wall time [ns]."""
        for route in self.routes[topic]:
            route((log_time - self._start) * 1e-9, message)

    def _on_task(self, _time: float, status: Any) -> None:
        self.heard_task = True
        self.summary.on_status(status)

    def _on_balls(self, _time: float, balls: Any) -> None:
        self.summary.truth = balls

    def _on_targets(self, time: float, targets: Any) -> None:
        age = self._age_ms(time, targets.header.stamp)
        self.gathered.on_targets(time, targets, age)
        self.summary.on_latency(age)

    def _on_path(self, time: float, path: Any) -> None:
        if path.header.stamp and not path.given:
            self.gathered.on_picture(self._age_ms(time, path.header.stamp))
        if self.summary.traced:
            self.summary.traced.on_path(path)

    def _age_ms(self, time: float, stamp: int) -> float:
        """Wall time [ms] since a stamp of cell time was taken."""
        log_time = self._start + time * 1e9
        epoch = self._epoch or log_time
        cell_time = epoch + (log_time - epoch) * self._speed
        return (cell_time - stamp) / self._speed * 1e-6


def _cut(recording: Recording) -> str:
    return (f"{recording.path} was cut: the page shows what is whole; `zencell recover {recording.path}` makes a file "
            "of it that others can read")


def _figures(summary: Summary) -> dict[str, Any]:
    """The summary; of an outline whose robot is not known, what the task told of it."""


    figures, status = summary.as_dict(), summary.status
    if isinstance(status, OutlineStatus) and "outline" not in figures:
        told = status.model_dump(include={"object", "points", "fraction", "length_m", "closed"})
        figures["outline"] = {**told, "deviation_mm": None, "tracking_mm": None}
    return figures


def _cell_of(recording: Recording, given: str | None, run: dict[str, Any], notes: list[str]) -> Cell | None:
    """The cell that was recorded, as far as its files are here."""
    from common.config import load_cell

    if given is not None:
        return load_cell(given)
    world, overrides = run.get("world") or None, tuple(run.get("overrides") or ())
    try:
        return load_cell(recording.cell, overrides, world=world)
    except ZencellError as error:
        first = error
    try:
        found = load_cell(recording.cell)
    except ZencellError:
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
    from common.reporting.figures import JointLimits

    if robot is None:
        return None
    return JointLimits(list(robot.joint_names), robot.lower, robot.upper, robot.velocity)


def _arm_joints(run: Gathering) -> list[str]:
    """Joints that are recorded, without those of fingers, where no robot file says which they are."""
    first: JointState | None = run.joint_states[0] if run.joint_states else None
    return [name for name in first.name if "finger" not in name and "knuckle" not in name] if first else []


def _tool(run: Gathering, robot: RobotModel | None, during: str = "", period: float = TOOL_PERIOD) -> Any:
    """(n, 3) places of the tool centre point [m], all or those of a state of the task."""
    import numpy as np

    places, last = [], -1.0
    spans = [(span.since, span.until or run.end) for span in run.tasks if span.label == during]
    for at, state in zip(run.joint_times, run.joint_states, strict=True) if robot is not None else ():
        wanted = not during or any(since <= at <= until for since, until in spans)
        if wanted and at - last >= period:
            q = robot.order(state.name, state.position) if robot is not None else None
            if q is not None:
                places.append(robot.fk(q)[:3, 3])  # type: ignore[union-attr]
                last = at
    return np.array(places).reshape(-1, 3)


def _facts(recording: Recording, about: dict[str, Any], run: dict[str, Any]) -> dict[str, str]:
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(recording.start * 1e-9))
    facts = {"recorded": f"{when}, {recording.seconds:.1f} s", "seed": str(run.get("seed", "not told")),
             "speed": f"{float(run.get('speed') or 1.0):g}"}
    if run.get("world"):
        facts["world"] = str(run["world"])
    if run.get("overrides"):
        facts["set"] = ", ".join(str(text) for text in run["overrides"])
    versions = about.get("versions")
    if isinstance(versions, dict) and "zencell" in versions:
        facts["zencell"] = str(versions["zencell"])
    return facts
