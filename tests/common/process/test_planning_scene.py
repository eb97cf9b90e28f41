"""A scene writer publishes added solids with the perceived scene, and only those that are safe in its file."""

import asyncio
import errno
import logging
import os
from pathlib import Path

import pytest

from common import topics
from common.atomic_file import STATE_VARIABLE, AtomicFile
from common.errors import ConfigError, RemoteError
from common.messages import CollisionObject, Header, PlanningScene, Pose, SceneEdit
from common.process.in_process import running_service
from common.process.planning_scene import SceneWriter
from common.transport.bus import Bus, Reader
from common.transport.local import LocalNetwork

SEEN = CollisionObject(id="ball", role="target", shape="sphere", dimensions=[0.03], pose=Pose())
POLE = SceneEdit(op="add", id="pole", shape="cylinder", dimensions=[0.02, 1.0], pose=Pose(), owner="anna")
TIMEOUT = 30.0  # [s] only a failing test waits that long


async def writer(bus: Bus, config: None) -> None:
    """Publish a scene with one ball."""
    await SceneWriter(bus).begin(PlanningScene(header=Header(stamp=1), objects=[SEEN]))
    await bus.ready()
    await asyncio.Event().wait()


async def next_ids(scenes: Reader[PlanningScene]) -> list[str]:
    return [each.id for each in (await scenes.next()).objects]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    return tmp_path


async def test_added_solid_is_published_with_the_perceived_scene_also_after_a_restart(caplog) -> None:
    net = LocalNetwork()
    bus = net.bus("tester", cell="test")
    scenes, edits = bus.reader(topics.PLANNING_SCENE), bus.client(topics.SCENE_EDIT)
    async with running_service(net, writer, None, name="writer"):
        assert await next_ids(scenes) == ["ball"]
        assert (await edits.call(POLE, TIMEOUT)).ids == ["added/pole"]
        assert await next_ids(scenes) == ["ball", "added/pole"]
    with caplog.at_level(logging.WARNING, "writer"):
        async with running_service(net, writer, None, name="writer"):
            assert await next_ids(scenes) == ["ball", "added/pole"]
            assert (await edits.call(SceneEdit(op="remove", id="pole"), TIMEOUT)).ids == []
            assert await next_ids(scenes) == ["ball"]
    assert "solids from an earlier session: added/pole" in caplog.text


async def test_solid_is_not_added_if_it_cannot_be_saved(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: object, record: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(AtomicFile, "save", full)
    net = LocalNetwork()
    bus = net.bus("tester", cell="test")
    async with running_service(net, writer, None, name="writer"):
        with pytest.raises(RemoteError, match=r"No space left on device.*was not made") as refused:
            await bus.client(topics.SCENE_EDIT).call(POLE, TIMEOUT)
        assert refused.value.code == "not_kept"
        assert await next_ids(bus.reader(topics.PLANNING_SCENE)) == ["ball"]


async def test_service_does_not_start_if_its_added_solids_cannot_be_read(folder: Path) -> None:
    (folder / "test.writer.added.json").write_text('{"solids": [{}]}')
    with pytest.raises(ConfigError, match=r"planning_scene: .*test.writer.added.json.* cannot be read: it is damaged"):
        async with running_service(LocalNetwork(), writer, None, name="writer"):
            pytest.fail("it has started")
