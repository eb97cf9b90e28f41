"""Tunable parameters are read where they are used, so a change takes effect at once."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import pytest

from applications.outlining.topics import OutlinePoints
from common import topics
from common.config import Cell, Parameters, World, load_cell, service_config
from common.config.tunables import Leaf, apply, checked, leaves, tunable_sections
from common.messages import Interlock, PlanRequest, PoseGoal, StopRequest
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose, tool_down
from common.sim.interface import GraspTolerances
from common.sim.kinematic import KinematicWorld
from common.transport.bus import Bus
from tests.applications.outlining.outline_double import OutlineDouble
from tests.applications.pick_place.cell_double import CellDouble
from tests.services.watched_reading import Watch
from tests.simulated.visited import SimulatedCell

CELLS = {name: load_cell(name) for name in ("panda", "ur5")}


def config_of(service: str) -> Parameters:
    cell = next(cell for cell in CELLS.values() if service in cell.services)
    return service_config(cell, service, importlib.import_module(cell.services[service].module).Config)


def tunable_leaves(service: str) -> dict[str, Leaf]:
    return {path: leaf for path, leaf in leaves(config_of(service), service).items() if leaf.runtime}


def change(parameters: Parameters, **values: Any) -> None:
    apply(checked(parameters, "it", {f"services.it.{name}": value for name, value in values.items()}))


# --- parameters that are read only in rare situations ---


def test_more_retries_take_effect() -> None:
    cell = CellDouble([(0.40, -0.30)], max_retries=0)
    cell.slips = 3
    cell.until("close")
    change(cell.task.p, max_retries=3)
    cell.until("DONE")
    assert (cell.contained, cell.task.status.retries) == (1, 3)


def test_abandoned_objects_are_retried_after_a_parameter_change() -> None:
    cell = CellDouble([(0.40, -0.30), (0.47, -0.30)])
    change(cell.task.p, **{"hand.min_clearance": 0.05, "grace": 600.0})
    steps(cell, 20)
    reasons = [rejection.reason for rejection in cell.task.status.skipped]
    assert reasons == ["its neighbors leave no room for the fingers at any yaw"] * 2
    change(cell.task.p, **{"hand.min_clearance": 0.003})
    cell.until("DONE")
    assert cell.contained == 2


def steps(cell: CellDouble | OutlineDouble, count: int) -> None:
    for _ in range(count):
        cell.step()


def test_changed_grace_period_takes_effect_while_waiting() -> None:
    empty, unreachable = CellDouble([], empty=600.0), CellDouble([(0.7, 0.4)], grace=600.0)
    unreachable.unreachable = [(0.7, 0.4)]
    for cell, parameter in ((empty, "empty"), (unreachable, "grace")):
        steps(cell, 50)
        assert cell.task.status.state == "IDLE"
        change(cell.task.p, **{parameter: 1.0})
        cell.step()
        assert cell.task.status.state == "DONE"


def test_shorter_time_limit_stops_a_running_motion() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("pre-grasp")
    change(cell.task.p, goal_timeout=0.05)
    steps(cell, 2)
    assert "took longer than 0.05 s" in cell.task.status.message


@pytest.mark.parametrize(("make", "stage"), [
    (lambda: CellDouble([(0.40, -0.30)], obstacle_patience=600.0), "pre-grasp"),
    (lambda: OutlineDouble(obstacle_patience=600.0), "trace")])
def test_shorter_obstacle_patience_takes_effect(make: Callable[[], Any], stage: str) -> None:
    cell = make()
    cell.until(stage)
    obstacle = Interlock(kind="held", by="scene_monitor", reason="a mug obstructs", since=1)
    cell.motion = cell.motion.model_copy(update={
        "held": True, "held_by": ["scene_monitor"], "interlocks": [obstacle]})
    steps(cell, 50)
    assert cell.task.running is not None
    change(cell.task.p, obstacle_patience=1.0)
    assert any(isinstance(asked, StopRequest) for asked in cell.step())
    assert "a mug obstructs" in cell.task.status.message


def test_lower_failure_limit_takes_effect() -> None:
    cell = CellDouble([(0.40, -0.30)], max_failures=1000)
    cell.unplannable = lambda request: "no_path" if request.stage == "home" else ""
    change(cell.task.p, goal_timeout=0.05, max_failures=2)
    cell.until("ERROR", most=100)
    assert "that makes 2 failures in a row" in cell.task.status.message


@pytest.mark.parametrize("camera_on", [True, False])
def test_changed_selection_timeout_takes_effect_while_waiting(camera_on: bool) -> None:
    cell = OutlineDouble(selection_timeout=0.0, picture_timeout=0.0)
    cell.path = OutlinePoints(message="no object is chosen") if camera_on else None
    steps(cell, 200)
    assert cell.status.state == "SELECTING"
    change(cell.task.p, **{"selection_timeout" if camera_on else "picture_timeout": 1.0})
    cell.step()
    assert cell.status.state == "ERROR"


def test_shorter_overtime_stops_a_running_trace() -> None:
    cell = OutlineDouble()
    cell.until("trace")
    change(cell.task.p, overtime=1e-3)
    cell.arrival += 100
    cell.until("ERROR")
    assert "took longer than 1 s" in cell.status.message


def test_simulated_grasps_use_current_tolerances() -> None:
    tolerances = GraspTolerances()
    world = KinematicWorld(World(balls=[(0.5, 0.0)]), tolerances=tolerances)
    near = tool_down(0.5, 0.015, 0.03)
    assert world.obstruction(near, 0.08) == 0.0  # 5 mm into a finger
    change(tolerances, sideways=0.01)
    assert world.obstruction(near, 0.08) == pytest.approx(0.06)
    world.tick(1.0, near, 0.06, True)
    for time, release in ((1.1, 0.02), (1.2, 0.005)):
        change(tolerances, release=release)
        world.tick(time, near, 0.07, False)
        assert bool(world.held) == (release == 0.02)


RARE = {f"services.{service}.{name}" for service, names in {  # those with a test above, or of faults
    "smart_pick_place": ("max_retries", "grace", "empty", "goal_timeout", "max_failures", "obstacle_patience"),
    "contour_tracer": ("obstacle_patience", "overtime", "picture_timeout", "selection_timeout"),
    "trajectory_executor": ("grasp_tolerances.sideways", "grasp_tolerances.release"),
}.items() for name in names}


# --- every parameter of every service ---


@pytest.mark.slow
@pytest.mark.parametrize(("cell", "overrides"), [("panda", ["world.count=1"]), ("ur5", [])])
def test_every_tunable_parameter_is_read_while_the_cell_works(cell, overrides, monkeypatch):
    watch = Watch(monkeypatch)

    def watched(loaded: Cell, service: str, kind: type[Parameters]) -> Parameters:
        config = service_config(loaded, service, kind)
        watch.add(config, service)
        return config

    async def begin(_: SimulatedCell, bus: Bus) -> None:
        watch.begin()
        home = CELLS[cell].robot.named_poses["home"]
        goal = PoseGoal(pose=matrix_to_pose(RobotModel.load(CELLS[cell].robot).fk(home)))
        request = PlanRequest(id="usual", start=home, goal=goal, straight=True)  # unlike tasks, without a planning time
        await bus.client(topics.MOTION_PLAN).call(request, 60.0)

    monkeypatch.setattr("lab.processes.service_config", watched)
    SimulatedCell(cell, overrides, visit=begin)
    assert sorted(watch.tunable - watch.read - RARE) == []


@pytest.mark.parametrize("path", sorted(RARE))
def test_rarely_read_parameter_shares_a_model_with_frequent_ones(path: str) -> None:
    """So the test above shows that the service works with that model itself, and not with a copy."""
    owners = {p: leaf.owner for p, leaf in tunable_leaves(path.split(".")[1]).items()}
    assert [p for p, owner in owners.items() if owner is owners[path] and p not in RARE]


@pytest.mark.parametrize("cell", CELLS)
def test_section_with_tunable_parameters_belongs_to_one_service_of_the_cell(cell: str) -> None:
    sections = [path for name in CELLS[cell].services for path in tunable_sections(type(config_of(name)))]
    assert sorted(sections) == sorted(set(sections)) == ["motion", "pipeline"]
