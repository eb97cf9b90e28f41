"""What each service reads, writes and serves, recorded in place of the bus."""

from __future__ import annotations

import importlib

import pytest

from applications.pick_place.topics import SCENE_BALLS
from common import topics
from common.application import all_topics
from common.config import Surroundings, World, load_cell, service_config
from common.errors import ConfigError
from common.supervision.wiring import Wiring, owned_in, require_one_owner, wiring

CELLS = {name: load_cell(name, ["services.viewer.port=0"]) for name in ("panda", "ur5")}
SERVICES = [(cell, name) for cell, loaded in CELLS.items() for name in loaded.services]
CAMERAS = ("camera_simulator", "depth_camera")
SHOWING = "viewer"  # shows the truth on a tick, and decides nothing
DECIDING = [(cell, name) for cell, name in SERVICES if name not in (*CAMERAS, SHOWING, "trajectory_executor")]
TRUTH = {SCENE_BALLS, topics.SCENE_OBJECTS}


async def wired(cell: str, name: str) -> Wiring:
    module = importlib.import_module(CELLS[cell].services[name].module)
    return await wiring(module.run, service_config(CELLS[cell], name, module.Config))


@pytest.mark.parametrize(("cell", "name"), DECIDING)
async def test_no_deciding_service_reads_the_ground_truth(cell: str, name: str) -> None:
    assert not (await wired(cell, name)).reads & TRUTH
    config = importlib.import_module(CELLS[cell].services[name].module).Config
    assert not [f for f, info in config.model_fields.items() if info.annotation is World]


@pytest.mark.parametrize(("cell", "camera"), list(zip(CELLS, CAMERAS, strict=True)))
async def test_only_camera_and_page_read_the_ground_truth(cell: str, camera: str) -> None:
    readers = [name for name in CELLS[cell].services if (await wired(cell, name)).reads & TRUTH]
    assert set(readers) == {camera, SHOWING}


@pytest.mark.parametrize("camera", CAMERAS)
async def test_camera_gets_the_ground_truth_from_the_topic(camera: str) -> None:
    config = importlib.import_module(f"services.{camera}").Config
    assert World not in [info.annotation for info in config.model_fields.values()]


async def test_every_known_topic_has_an_owner() -> None:
    owned = {topic for cell, name in SERVICES for topic in (await wired(cell, name)).owns}
    of_no_service = {topics.SUPERVISOR_STATUS, topics.LOG, topics.COUNTERS, topics.PARAMETERS, topics.MOTION_JOG}
    assert owned == set(all_topics().values()) - of_no_service


@pytest.mark.parametrize("cell", CELLS)
async def test_no_two_services_of_a_cell_own_one_key(cell: str) -> None:
    wirings = {name: await wired(cell, name) for name in CELLS[cell].services}
    require_one_owner(wirings)
    assert {key: services for key, (_, services) in owned_in(wirings).items() if len(services) != 1} == {}
    twice = {**wirings, "another": next(found for found in wirings.values() if found.serves)}
    with pytest.raises(ConfigError, match=r"services\.another: motion_planner has .* already.*as in topics: "):
        require_one_owner(twice)


@pytest.mark.parametrize("cell", CELLS)
async def test_every_input_has_exactly_one_source(cell: str) -> None:
    all_wired = [await wired(cell, name) for name in CELLS[cell].services]
    written = [topic for found in all_wired for topic in found.writes]
    served = [topic for found in all_wired for topic in found.serves]
    by_others = {topics.SUPERVISOR_STATUS, topics.LOG, topics.COUNTERS, topics.MOTION_JOG}  # and by everybody
    parameters = {topics.parameters_of(name) for name in CELLS[cell].services}  # not served by the services themselves
    assert len(written) == len(set(written)) and len(served) == len(set(served))
    for name, found in zip(CELLS[cell].services, all_wired, strict=True):
        if name != SHOWING:  # which shows whatever there is
            assert found.reads <= set(written) | by_others
        assert found.calls <= set(served) | parameters


async def test_device_camera_is_wired_like_the_simulated_one() -> None:
    simulated = await wired("panda", "camera_simulator")
    module = importlib.import_module("services.camera_opencv")
    section = CELLS["panda"].section(Surroundings)
    device = await wiring(module.run, module.Config(world=section, source="0"))
    assert device.writes == simulated.writes
    assert not device.reads
