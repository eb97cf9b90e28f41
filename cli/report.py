"""A page about a recorded run."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli.recording import File
from common.errors import ConfigError, ZencellError
from common.terminal import echo

if TYPE_CHECKING:
    from common.application import Application
    from common.config import Cell
    from common.messages import JointState
    from common.recording.reading import Recording
    from common.reporting.gathering import Gathering
    from common.robot.model import RobotModel

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
        raise ConfigError("--output", output, "cannot be written: the folder does not exist")
    with Recording(path) as recording:
        text = page_of(recording, cell)
        if not recording.finished:
            echo(f"zencell: {_cut(recording)}", err=True)
    try:
        page_path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError("--output", str(page_path), f"cannot be written: {error.strerror}") from None
    echo(f"{page_path}: {len(text) / 1e6:.1f} MB")


def page_of(recording: Recording, cell: str | None = None) -> str:
    """The page of a recording.

    Raises:
        RecordingError: it is damaged, or says nothing about a run.
        ConfigError: `cell` is none.
    """
    from common.recording.decoding import Decoder
    from common.recording.sample import RecordingError
    from common.recording.writing import ABOUT, ENDED, RUN
    from common.reporting.fold import Fold
    from common.reporting.gathering import Gathering
    from common.reporting.page import Report, page

    about, run = recording.metadata(ABOUT), recording.metadata(RUN)
    notes: list[str] = []
    resolved = _cell_of(recording, cell, run, notes)
    robot = _robot_of(resolved, notes)
    speed, epoch = float(run.get("speed") or 1.0), int(run.get("epoch") or 0)
    gathered = Gathering()
    fold = Fold(
        recording.cell, _application_of(recording, resolved), robot=resolved.robot if resolved and robot else None,
        seed=int(run.get("seed") or 0), speed=speed, gathering=gathered,
        containers=list(resolved.world.containers) if resolved else (),
    )
    wanted = {topic.key: topic for topic in fold.topics}
    decoder = Decoder(topic.message for topic in fold.topics)
    for sample in recording.samples(lambda topic: topic in wanted):
        message = decoder.message(sample)
        if isinstance(message, wanted[sample.topic].message):
            since = epoch or sample.log_time
            now_ns = since + round((sample.log_time - since) * speed)
            fold.on(sample.topic, message, (sample.log_time - recording.start) * 1e-9, now_ns)
    if not (fold.status or gathered.joint_states or gathered.services):
        raise RecordingError(f"{recording.path}: says nothing about a run; "
                             "it needs a task's status, joint_states or supervisor/status")
    gathered.finish(recording.seconds)
    if not recording.finished:
        notes.append(_cut(recording))
    if decoder.skipped:
        notes.append("Not understood: " + ", ".join(f"{n} x {topic}" for topic, n in decoder.skipped.items()))
    fold.summary.restarts = {name: service.restarts for name, service in gathered.services.items() if service.restarts}
    names = robot.joint_names if robot else _arm_joints(gathered)
    ended = recording.metadata(ENDED)
    lost: dict[str, int] = {}
    for kind in ("dropped", "missed"):
        for key, count in (ended.get(kind) or {}).items():
            lost[key.partition("/")[2]] = lost.get(key.partition("/")[2], 0) + count
    return page(Report(
        recording.path.name, _facts(recording, about, run), fold.summary.as_dict(), gathered, _limits(robot),
        list(names), fold.figures, _tool(gathered, robot), notes, lost,
    ))


def _application_of(recording: Recording, cell: Cell | None) -> Application | None:
    """What was recorded was done for this; where the cell is not here, whose status was recorded."""
    from common.application import find_application
    from common.reporting.fold import application_in

    return find_application(cell.application) if cell is not None else application_in(list(recording.topics()))


def _cut(recording: Recording) -> str:
    return (f"{recording.path} was cut: the page shows what is whole; `zencell recover {recording.path}` makes a file "
            "of it that others can read")


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


def _tool(run: Gathering, robot: RobotModel | None) -> Any:
    """(n, 3) places of the tool centre point [m]."""
    import numpy as np

    places, last = [], -1.0
    for at, state in zip(run.joint_times, run.joint_states, strict=True) if robot is not None else ():
        if at - last >= TOOL_PERIOD:
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
