"""What each service reads, writes and serves, recorded in place of the bus."""

from __future__ import annotations

import asyncio
import importlib
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from applications.pick_place.topics import SCENE_BALLS
from common import topics
from common.application import all_topics, applications, find_application
from common.config import Surroundings, World, load_cell, service_config
from common.errors import ConfigError
from common.planning.camera_obstacles import PointsOptions
from common.supervision.wiring import Wiring, owned_in, require_one_owner, wiring
from services import camera_opencv, motion_planner, program_runner, real_depth_camera, vision_detector

CELLS = {name: load_cell(name, ["services.viewer.port=0"]) for name in ("panda", "ur5", "sorting", "policy_panda")}
SERVICES = [(cell, name) for cell, loaded in CELLS.items() for name in loaded.services]
CAMERAS = {"panda": "camera_simulator", "ur5": "depth_camera", "sorting": "depth_camera",
           "policy_panda": "camera_simulator"}
PROGRAMS = load_cell(str(Path(__file__).parents[1] / "data" / "programs.yaml"))
VIEWER = "viewer"  # shows the truth on demand, and decides nothing
DECIDING = [(cell, name) for cell, name in SERVICES if name not in (*CAMERAS.values(), VIEWER, "trajectory_executor")]
TRUTH = {SCENE_BALLS, topics.SCENE_OBJECTS}


def config_class(cell: str, name: str) -> Any:
    return importlib.import_module(CELLS[cell].services[name].module).Config


def wiring_of(module: Any, config: Any) -> Wiring:
    return asyncio.run(wiring(module.run, config))


@cache
def wired(cell: str) -> dict[str, Wiring]:
    """Return the wiring of each service of a cell."""
    return {name: wiring_of(importlib.import_module(CELLS[cell].services[name].module),
                            service_config(CELLS[cell], name, config_class(cell, name)))
            for name in CELLS[cell].services}


@pytest.mark.parametrize(("cell", "name"), DECIDING)
def test_no_deciding_service_reads_the_ground_truth(cell: str, name: str) -> None:
    assert not wired(cell)[name].reads & TRUTH
    assert not [f for f, info in config_class(cell, name).model_fields.items() if info.annotation is World]


def test_program_runner_owns_its_keys_and_reads_no_ground_truth() -> None:
    found = wiring_of(program_runner, service_config(PROGRAMS, "program_runner", program_runner.Config))
    assert set(find_application("programming").topics_by_key.values()) < found.owns
    assert not found.reads & TRUTH


@pytest.mark.parametrize("cell", CELLS)
def test_only_camera_and_viewer_read_the_ground_truth_and_only_from_topics(cell: str) -> None:
    assert {name for name, found in wired(cell).items() if found.reads & TRUTH} == {CAMERAS[cell], VIEWER}
    assert World not in [info.annotation for info in config_class(cell, CAMERAS[cell]).model_fields.values()]


def test_every_known_topic_has_an_owner() -> None:
    owned = {topic for cell, name in SERVICES for topic in wired(cell)[name].owns}
    of_no_service = {topics.SUPERVISOR_STATUS, topics.LOG, topics.COUNTERS, topics.PARAMETERS, topics.MOTION_JOG,
                     topics.IO_STATE, topics.IO_SET, topics.IO_SENSED,  # no included cell has I/O
                     topics.RESERVE, topics.ARMS_STATUS, topics.CONVEYOR_STATE, topics.CONVEYOR_SET}  # arms, belts
    for each in applications():  # of other cells
        if all(each.name != cell.application for cell in CELLS.values()):
            of_no_service |= set(each.topics_by_key.values())
    assert owned == set(all_topics().values()) - of_no_service


@pytest.mark.parametrize("cell", CELLS)
def test_no_two_services_of_a_cell_own_one_key(cell: str) -> None:
    require_one_owner(wired(cell))
    assert {key: services for key, (_, services) in owned_in(wired(cell)).items() if len(services) != 1} == {}
    twice = {**wired(cell), "another": next(found for found in wired(cell).values() if found.serves)}
    with pytest.raises(ConfigError, match=r"services\.another: motion_planner has .* already.*as in topics: "):
        require_one_owner(twice)


@pytest.mark.parametrize("cell", CELLS)
def test_every_input_has_exactly_one_source(cell: str) -> None:
    written = [topic for found in wired(cell).values() for topic in found.writes]
    served = [topic for found in wired(cell).values() for topic in found.serves]
    by_others = {topics.SUPERVISOR_STATUS, topics.LOG, topics.COUNTERS, topics.MOTION_JOG}  # and by every service
    parameters = {topics.parameters_of(name) for name in CELLS[cell].services}  # served by the platform
    assert len(written) == len(set(written)) and len(served) == len(set(served))
    for name, found in wired(cell).items():
        assert name == VIEWER or found.reads <= set(written) | by_others
        assert found.calls <= set(served) | parameters


def test_real_cameras_are_wired_like_the_simulated_ones() -> None:
    color = camera_opencv.Config(world=CELLS["panda"].section(Surroundings), source="0")
    depth = real_depth_camera.Config(world=CELLS["ur5"].section(Surroundings), driver="realsense")
    for module, config, cell in ((camera_opencv, color, "panda"), (real_depth_camera, depth, "ur5")):
        found = wiring_of(module, config)
        assert found.writes == wired(cell)[CAMERAS[cell]].writes and not found.reads


def test_planner_with_points_reads_its_cameras() -> None:
    depth = {"depth": topics.DEPTH_CAMERA_DEPTH.key, "info": topics.DEPTH_CAMERA_INFO.key}
    cameras = [depth, {"points": "left/points"}]
    config = service_config(CELLS["ur5"], "motion_planner", motion_planner.Config)
    config = config.model_copy(update={"points": PointsOptions.model_validate({"cameras": cameras})})
    added = wiring_of(motion_planner, config).reads - wired("ur5")["motion_planner"].reads
    assert {topic.key for topic in added} == {topics.TF_STATIC.key, "left/points", *depth.values()}


def test_only_cells_with_a_camera_on_the_robot_read_tf() -> None:
    mounted = load_cell(str(Path(__file__).parents[1] / "data" / "hand_camera.yaml"))
    found = wiring_of(vision_detector, service_config(mounted, "vision_detector", vision_detector.Config))
    assert topics.TF in found.reads and topics.TF not in wired("panda")["vision_detector"].reads


def test_topics_of_a_cell_with_physics_are_known_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.mujoco.find_spec", lambda _: None)
    for name in ("trajectory_executor", "depth_camera"):
        config = service_config(CELLS["sorting"], name, config_class("sorting", name))
        assert wiring_of(importlib.import_module(f"services.{name}"), config) == wired("sorting")[name]
