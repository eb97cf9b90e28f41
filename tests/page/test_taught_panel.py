"""The panel of taught poses: what is offered, and that nothing which somebody taught is lost."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import viser
from page.taught_panel import SavedPosesPanel

from common.errors import ConfigError
from page.console import ActionQueue
from page.saved_poses import SavedPoses, load_taught, save_taught, taught_file

JOINTS = ["a", "b"]
TAKEN = ["goal marker", "home"]


@pytest.fixture(autouse=True)
def folder(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZENCELL_STATE", str(tmp_path))


def panel(server: viser.ViserServer) -> SavedPosesPanel:
    async def nowhere(_names: list[str]) -> None:
        pass

    return SavedPosesPanel(
        server.gui, ActionQueue(), "cell", JOINTS, lambda: np.array([1.0, 2.0]), lambda: None, nowhere, TAKEN)


def teach(taught: SavedPosesPanel, name: str) -> None:
    taught._set_name(name)
    taught._teach()


async def test_pose_in_the_file_whose_name_means_something_else_is_not_offered_twice(
    server: viser.ViserServer,
) -> None:
    save_taught(taught_file("cell"), SavedPoses(poses={name: {"a": 0.0, "b": 0.0} for name in ("bin", "home")}))
    taught = panel(server)
    assert taught.names == ["bin"]  # a page on which something is to be chosen from twice the same is blank
    with pytest.raises(ConfigError, match="means something else"):
        taught.positions("home")
    taught.show("")
    assert "not offered, for they mean something else: home" in taught._html.content
    taught._set_name("home")
    taught._forget()
    taught.show("")
    assert "not offered" not in taught._html.content and set(load_taught(taught_file("cell")).poses) == {"bin"}


async def test_what_another_page_taught_meanwhile_is_kept(server: viser.ViserServer) -> None:
    one, other = panel(server), panel(server)
    teach(one, "bin")
    teach(other, "box")
    assert set(load_taught(taught_file("cell")).poses) == set(other.names) == {"bin", "box"}
    one._set_name("bin")
    one._forget()
    assert set(load_taught(taught_file("cell")).poses) == {"box"}
    taught_file("cell").write_text("[")
    with pytest.raises(ConfigError, match="does not parse"):
        teach(one, "more")
