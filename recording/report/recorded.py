"""The page about a recorded run: its cell is found as far as it is here, and what was said in it is folded."""

from __future__ import annotations

import re
import time
from collections import Counter
from typing import TYPE_CHECKING, Any

from common.errors import UnknownName, ZencellError

if TYPE_CHECKING:
    from common.application import Application
    from common.config import Cell
    from common.messages import JointState
    from common.robot.model import RobotModel
    from recording.reading import Recording, Run
    from recording.report.gathering import Gathering

# An override that a recording tells and that is taken: numbers or one word, which names no file and no module.
HARMLESS = re.compile(r"[\w.]{1,100}=([A-Za-z_]\w{0,60}|[-+0-9.eE, \[\]]{1,100})", re.ASCII)
TOOL_PERIOD = 0.05  # [s] between places of the tool that are shown


def page_of(recording: Recording, cell: str | None = None) -> str:
    """The page of a recording.

    Raises:
        RecordingError: it is damaged, or says nothing about a run.
        ConfigError: `cell` is none.
    """
    from common.topics import general_key
    from recording.decoding import Decoder
    from recording.report.film import films
    from recording.report.fold import Fold
    from recording.report.gathering import Event, Gathering
    from recording.report.page import Report, page
    from recording.sample import RecordingError
    from recording.writing import ABOUT

    about, run = recording.metadata(ABOUT), recording.run
    notes: list[str] = []
    resolved = _cell_of(recording, cell, run, notes)
    robot = _robot_of(resolved, notes)
    gathered = Gathering()
    fold = Fold(
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
    from recording.report.fold import application_in

    return find_application(cell.application) if cell is not None else application_in(list(recording.topics()))


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
    from recording.report.figures import JointLimits

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
