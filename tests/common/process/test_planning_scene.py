from __future__ import annotations

import asyncio
import errno
import logging
import os
from pathlib import Path

import pytest

from common import topics
from common.errors import ConfigError, RemoteError
from common.kept_file import STATE_VARIABLE, KeptFile
from common.messages import CollisionObject, Header, PlanningScene, Pose, SceneEdit
from common.process.in_process import running_service
from common.process.planning_scene import SceneWriter
from common.transport.bus import Bus
from common.transport.local import LocalNetwork

SEEN = CollisionObject(id="ball", role="target", shape="sphere", dimensions=[0.03], pose=Pose())
POLE = SceneEdit(op="add", id="pole", shape="cylinder", dimensions=[0.02, 1.0], pose=Pose(), owner="anna")


async def keeper(bus: Bus, config: None) -> None:
    """Sees a ball, always the same."""
    out = SceneWriter(bus)
    await out.begin(PlanningScene(header=Header(stamp=1), objects=[SEEN]))
    await bus.ready()
    await asyncio.Event().wait()


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    return tmp_path


async def test_added_solid_stands_beside_what_is_perceived_and_is_there_again_after_a_restart(
    caplog: pytest.LogCaptureFixture
) -> None:
    net = LocalNetwork()
    bus = net.bus("tester", cell="test")
    scenes, edits = bus.reader(topics.PLANNING_SCENE), bus.client(topics.SCENE_EDIT)
    async with running_service(net, keeper, None, name="keeper"):
        assert [thing.id for thing in (await scenes.next()).objects] == ["ball"]
        assert (await edits.call(POLE, 5.0)).ids == ["added/pole"]
        assert [thing.id for thing in (await scenes.next()).objects] == ["ball", "added/pole"]
    with caplog.at_level(logging.WARNING, "keeper"):
        async with running_service(net, keeper, None, name="keeper"):
            assert [thing.id for thing in (await scenes.next()).objects] == ["ball", "added/pole"]
            assert (await edits.call(SceneEdit(op="remove", id="pole"), 5.0)).ids == []
            assert [thing.id for thing in (await scenes.next()).objects] == ["ball"]
    assert "solids from an earlier session: added/pole" in caplog.text


async def test_solid_that_cannot_be_kept_is_not_added(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: object, record: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(KeptFile, "save", full)
    net = LocalNetwork()
    bus = net.bus("tester", cell="test")
    async with running_service(net, keeper, None, name="keeper"):
        with pytest.raises(RemoteError, match=r"No space left on device.*nothing was changed") as told:
            await bus.client(topics.SCENE_EDIT).call(POLE, 5.0)
        assert told.value.code == "not_kept"
        assert [thing.id for thing in (await bus.reader(topics.PLANNING_SCENE).next()).objects] == ["ball"]


async def test_keeper_that_cannot_know_what_was_added_does_not_start(folder: Path) -> None:
    (folder / "test.keeper.added.json").write_text('{"solids": [{}]}')
    with pytest.raises(ConfigError, match=r"planning_scene: .*test.keeper.added.json.* cannot be read: it is damaged"):
        async with running_service(LocalNetwork(), keeper, None, name="keeper"):
            pytest.fail("it was let in")
