"""The file of saved poses, and its panel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import viser

from common.config import check
from common.errors import ConfigError
from page.console import ActionQueue
from page.saved_poses import HEADER, SavedPoses, SavedPosesPanel, load_poses, poses_file, save_poses

POSES = {"bin": {"a": 0.25, "b": -1.0}, "über der Kiste": {"b": 0.5, "a": 0.0}}
JOINTS = ["a", "b"]
RESERVED = ["goal marker", "home"]


@pytest.fixture(autouse=True)
def folder(state_folder: Path) -> Path:
    return state_folder


def saved() -> set[str]:
    return set(load_poses(poses_file("cell")).poses)


def test_saved_poses_are_read_again_in_the_order_of_the_joints() -> None:
    path = poses_file("cell")
    assert load_poses(path) == SavedPoses()
    save_poses(path, SavedPoses(poses=POSES))
    again = load_poses(path)
    assert again.poses == POSES and path.read_text(encoding="utf-8").startswith(HEADER)
    assert again.named("über der Kiste", JOINTS) == [0.0, 0.5]
    assert [each.name for each in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize(("name", "joints", "reason"), [
    ("box", JOINTS, "choices: bin"), ("bin", ["a"], "a robot with other joints")])
def test_unknown_pose_or_other_joints_are_rejected(name: str, joints: list[str], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        SavedPoses(poses=POSES).named(name, joints)


@pytest.mark.parametrize("name", ["", " a", "a, b", "x" * 41, "a\nb"])
def test_name_that_cannot_be_part_of_a_sequence_is_rejected(name: str) -> None:
    with pytest.raises(ConfigError):
        check(SavedPoses, {"poses": {name: {"a": 0.0}}}, "pose")


@pytest.mark.parametrize("text", ["poses: 3", "poses: {bin: {a: .nan}}", "[", "other: {}"])
def test_invalid_file_is_rejected_by_its_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "cell.poses.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="poses"):
        load_poses(path)


def panel_of(gui: viser.GuiApi) -> SavedPosesPanel:
    async def move(_names: list[str]) -> None:
        pass

    return SavedPosesPanel(
        gui, ActionQueue(), "cell", JOINTS, lambda: np.array([1.0, 2.0]), lambda: None, move, RESERVED)


def save(panel: SavedPosesPanel, name: str) -> None:
    panel._set_name(name)
    panel._save()


def delete(panel: SavedPosesPanel, name: str) -> None:
    panel._set_name(name)
    panel._delete()


async def test_pose_with_a_reserved_name_is_hidden_and_can_be_deleted(gui: viser.GuiApi) -> None:
    save_poses(poses_file("cell"), SavedPoses(poses={name: {"a": 0.0, "b": 0.0} for name in ("bin", "home")}))
    panel = panel_of(gui)
    assert panel.names == ["bin"]  # a dropdown with a duplicate choice makes viser's page blank
    with pytest.raises(ConfigError, match="reserved"):
        panel.positions("home")
    panel.show("")
    assert "hidden, because the name is reserved: home" in panel._html.content
    delete(panel, "home")
    panel.show("")
    assert "hidden" not in panel._html.content and saved() == {"bin"}


async def test_poses_that_another_page_saved_meanwhile_remain(gui: viser.GuiApi) -> None:
    one, other = panel_of(gui), panel_of(gui)
    save(one, "bin")
    save(other, "box")
    assert saved() == set(other.names) == {"bin", "box"}
    delete(one, "bin")
    assert saved() == {"box"}
    poses_file("cell").write_text("[")
    with pytest.raises(ConfigError, match="does not parse"):
        save(one, "more")
