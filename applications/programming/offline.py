"""Check and rehearse a program without a running cell: the planner is called as a library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from applications.programming.export import script
from applications.programming.files import BadProgram, ProgramFile, load_all, load_program
from applications.programming.flow import Flow
from applications.programming.rehearsal import Rehearser, static_problems
from applications.programming.targets import Cell
from common import messages as m
from common.atomic_file import state_folder
from common.config import Cell as CellConfig
from common.config import Surroundings, find_file, load_cell, read_yaml, yaml_line
from common.errors import ConfigError
from common.planning.pipeline import PlanningPipeline
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose
from common.saved_poses import load_poses, poses_file
from common.scene.fixtures import fixed_objects
from common.tasks.stages import View

RUNNER = "program_runner"


def is_program(path: str) -> bool:
    """Return whether a file has steps, as a program, and no services, as a cell."""
    file = Path(path).expanduser()
    if file.suffix not in (".yaml", ".yml") or not file.is_file():
        return False
    try:
        tree = read_yaml(file)
    except ConfigError:
        return False
    return "steps" in tree and "services" not in tree


def cell_of(file: ProgramFile, given: str | None) -> str:
    """Return the cell in which a program runs: the given one, else that of the program. Raises ConfigError."""
    if given:
        return given
    if not file.program.cell:
        raise ConfigError("cell", ..., f"is missing in {file.path}: add `cell: NAME`, or use --cell NAME")
    if file.program.cell.endswith((".yaml", ".yml")):
        return str((file.path.parent / file.program.cell).resolve())
    return file.program.cell


def load_single(cell: str, overrides: tuple[str, ...] = ()) -> CellConfig:
    """Return a cell with one robot. Raises ConfigError and UnknownName."""
    loaded = load_cell(cell, overrides)
    if loaded.robots:
        raise ConfigError("cell", cell, f"has several robots ({', '.join(loaded.robots)}), and a program moves "
                          "one: use a cell of one robot")
    return loaded


def overrides_for(file: ProgramFile, cell: str, others: tuple[str, ...] = ()) -> tuple[list[str], Path]:
    """Return the overrides that make a cell run a program instead of its task, and the file of the progress.

    Raises:
        BadProgram: a program that it calls is invalid or missing.
        ConfigError, UnknownName: the cell is not valid.
    """
    load_all(file)
    loaded = load_single(cell, others)
    progress = state_folder() / "programs" / f"{loaded.name}.{file.name}.json"
    runner: dict[str, Any] = {"program": str(file.path.resolve()), "progress": str(progress)}
    services: dict[str, Any] = read_yaml(find_file("cells", cell))["services"]
    by_name = {str(key).rpartition(".")[2]: key for key in services}
    own = next((name for name, entry in loaded.services.items() if entry.kind == RUNNER), "")
    if own:
        return [f"services.{own}.{name}={value}" for name, value in runner.items()] + ["autostart=false"], progress
    services = {key: value or {} for key, value in services.items() if key != by_name.get(loaded.task)}
    return [f"services={yaml_line({**services, RUNNER: runner})}", "application=programming", f"task={RUNNER}",
            "autostart=false"], progress


def rehearse(path: Path, cell: str | None, overrides: tuple[str, ...] = (), *, everything: bool = False) -> Rehearser:
    """Plan a program from the home pose in the fixed surroundings of a cell.

    Args:
        path: of the program.
        cell: name or path; default: that of the program.
        overrides: of the cell.
        everything: also plan steps that are not reached.

    Raises:
        BadProgram: the file is invalid.
        ConfigError, UnknownName: the cell is not valid.
    """
    file = load_program(path)
    flow = Flow(load_all(file), file.name)
    loaded = load_single(cell_of(file, cell), overrides)
    robot = RobotModel.load(loaded.robot)
    around = loaded.section(Surroundings)
    assert isinstance(around, Surroundings)
    scene = m.PlanningScene(header=m.Header(frame_id="world"), objects=fixed_objects(around))
    pipeline = PlanningPipeline(robot, loaded.motion, loaded.pipeline, seed=loaded.run.seed)
    q = list(loaded.robot.named_poses["home"])
    gripper = loaded.robot.gripper
    view = View(0.0, scene=scene, q=q, tcp=matrix_to_pose(robot.fk(q)),
                gripper=m.GripperState(width=gripper.max_width if gripper is not None else 0.0))
    rehearser = Rehearser(flow, cell_with(loaded, robot), loaded.io, view, loaded.motion.planning_time)
    planning = rehearser.run(flow.start, everything=everything)
    try:
        request = next(planning)
        while True:
            request = planning.send(pipeline.plan(request, rehearser.scene, q))
    except StopIteration:
        return rehearser


def cell_with(loaded: CellConfig, robot: RobotModel) -> Cell:
    """Return what stages depend on in a cell."""
    return Cell(robot, loaded.robot.gripper, loaded.grasp, lambda: load_poses(poses_file(loaded.name)))


def report(rehearser: Rehearser) -> list[str]:
    """Return the steps of a dry run in lines: seconds, and what is not known."""
    lines, files = [], rehearser.flow.files
    for item in rehearser.result.steps:
        line = files[item.program].lines.get(item.step, 0)
        time = "      ?" if item.seconds is None else f"{item.seconds:6.2f}s"
        note = item.problem or item.unknown
        where = f"{item.program}:{line}"
        lines.append(f"{time}  {where:<16} {item.kind:<9} {item.step:<14} {note}".rstrip())
    return lines


def problems(rehearser: Rehearser, *, certain: bool = False) -> list[str]:
    """Return the problems of a dry run in lines with file, line and step; each step once.

    Args:
        rehearser: at the end of the dry run.
        certain: only those that end the program, whatever it meets on its way.
    """
    found: dict[str, None] = {}
    for item in rehearser.result.steps:
        file = rehearser.flow.files[item.program]
        may_succeed = item.unknown or file.steps[item.step].on_failure == "continue"
        if item.problem and not (certain and may_succeed):
            found[f"{file.path}:{file.lines.get(item.step, 0)}: {item.step}: {item.problem}"] = None
    return list(found)


def require_no_problems(rehearser: Rehearser, *, certain: bool = False) -> None:
    """Raise all problems of a dry run; arguments as of `problems`. Raises BadProgram."""
    if found := problems(rehearser, certain=certain):
        raise BadProgram(found)


def exported(path: Path, cell: str | None) -> str:
    """Return a program as a Python script over the client; arguments and errors as of `rehearse`.

    Raises:
        BadProgram: a pose of the program is unknown.
    """
    file = load_program(path)
    files, name = load_all(file), cell_of(file, cell)
    loaded = load_single(name)
    stages = cell_with(loaded, RobotModel.load(loaded.robot))
    found = [f"{each.path}:{each.lines.get(step.id, 0)}: {step.id}: {problem}" for each in files.values()
             for step, problem in static_problems(each, stages, loaded.io)]
    if found:
        raise BadProgram(found)
    return script(files, file.name, name)
