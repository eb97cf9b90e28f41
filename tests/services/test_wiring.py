"""What each service reads, writes and serves, seen by running it with a recorder in the place of the bus."""

from __future__ import annotations

import importlib

import pytest

from common import topics
from common.config import Surroundings, World, load_cell, service_config
from common.transport.wiring import Wiring, wiring

CELL = load_cell("panda")
SERVICES = list(CELL.services)
DECIDING = [name for name in SERVICES if name not in ("camera_simulator", "trajectory_executor")]


async def wired(name: str) -> Wiring:
    module = importlib.import_module(CELL.services[name].module)
    return await wiring(module.run, service_config(CELL, name, module.Config))


@pytest.mark.parametrize("name", DECIDING)
async def test_nothing_that_decides_reads_the_truth(name: str) -> None:
    assert not (await wired(name)).reads & {topics.SCENE_BALLS, topics.SCENE_OBJECTS}
    config = importlib.import_module(CELL.services[name].module).Config
    assert not [f for f, info in config.model_fields.items() if info.annotation is World]


async def test_the_camera_and_only_the_camera_reads_the_truth() -> None:
    readers = [name for name in SERVICES if topics.SCENE_BALLS in (await wired(name)).reads]
    assert readers == ["camera_simulator"]


async def test_the_camera_knows_the_truth_from_the_topic_alone() -> None:
    config = importlib.import_module("services.camera_simulator").Config
    assert World not in [info.annotation for info in config.model_fields.values()]


@pytest.mark.parametrize("name", SERVICES)
async def test_service_writes_and_serves_what_the_topic_table_says(name: str) -> None:
    found = await wired(name)
    shared = {"log", "counters"}
    assert {t.key for t in found.writes} - shared == {
        t.key for t in topics.all_topics().values() if t.kind != "request" and name in t.writers}
    assert {t.key for t in found.serves} == {
        t.key for t in topics.all_topics().values() if t.kind == "request" and name in t.writers}


async def test_every_topic_that_is_read_or_asked_is_written_or_served_by_a_service_of_the_cell() -> None:
    all_wired = [await wired(name) for name in SERVICES]
    written = set().union(*(w.writes for w in all_wired))
    served = set().union(*(w.serves for w in all_wired))
    for found in all_wired:
        assert found.reads <= written
        assert found.calls <= served


async def test_device_camera_has_the_wiring_of_the_simulated_one_but_for_the_truth() -> None:
    simulated = await wired("camera_simulator")
    module = importlib.import_module("services.camera_opencv")
    device = await wiring(module.run, module.Config(world=CELL.section(Surroundings), source="0"))
    assert device.writes == simulated.writes
    assert not device.reads
