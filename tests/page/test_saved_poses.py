"""The file of saved poses, and its panel."""

from pathlib import Path

import numpy as np
import pytest
import viser

from common.config import check
from common.errors import ConfigError
from common.saved_poses import HEADER, SavedPoses, load_poses, poses_file, save_poses
from page.console import ActionQueue
from page.saved_poses import SavedPosesPanel

POSES = {"bin": {"a": 0.25, "b": -1.0}, "über der Kiste": {"b": 0.5, "a": 0.0}}
JOINTS = ["a", "b"]


@pytest.fixture(autouse=True)
def folder(state_folder: Path) -> Path:
    return state_folder


def test_saved_poses_are_read_again_in_the_order_of_the_joints() -> None:
    path = poses_file("cell")
    assert load_poses(path) == SavedPoses()
    save_poses(path, SavedPoses(poses=POSES))
    again = load_poses(path)
    assert again.poses == POSES and path.read_text(encoding="utf-8").startswith(HEADER)
    assert again.named("über der Kiste", JOINTS) == [0.0, 0.5]
    assert [each.name for each in path.parent.iterdir()] == [path.name]
    for name, joints, reason in (("box", JOINTS, "choices: bin"), ("bin", ["a"], "a robot with other joints")):
        with pytest.raises(ConfigError, match=reason):
            again.named(name, joints)


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


class Panel:
    """The panel of a page at the joint positions 1, 2; `goal marker` and `home` are reserved names."""

    def __init__(self, gui: viser.GuiApi) -> None:
        async def move(_names: list[str]) -> None:
            pass

        self.panel = SavedPosesPanel(gui, ActionQueue(), "cell", JOINTS, lambda: np.array([1.0, 2.0]), lambda: None,
                                     move, ["goal marker", "home"])

    def save(self, name: str) -> None:
        self.panel._set_name(name)
        self.panel._save()

    def delete(self, name: str) -> None:
        self.panel._set_name(name)
        self.panel._delete()

    @property
    def text(self) -> str:
        self.panel.show("")
        return self.panel._html.content


def saved() -> set[str]:
    return set(load_poses(poses_file("cell")).poses)


async def test_pose_with_a_reserved_name_is_hidden_and_can_be_deleted(gui: viser.GuiApi) -> None:
    save_poses(poses_file("cell"), SavedPoses(poses={name: {"a": 0.0, "b": 0.0} for name in ("bin", "home")}))
    page = Panel(gui)
    assert page.panel.names == ["bin"], "viser's page is blank with a duplicate choice"
    with pytest.raises(ConfigError, match="reserved"):
        page.panel.positions("home")
    assert "hidden, because the name is reserved: home" in page.text
    page.delete("home")
    assert "hidden" not in page.text and saved() == {"bin"}


async def test_poses_that_another_page_saved_meanwhile_remain(gui: viser.GuiApi) -> None:
    one, other = Panel(gui), Panel(gui)
    one.save("bin")
    other.save("box")
    assert saved() == set(other.panel.names) == {"bin", "box"}
    one.delete("bin")
    assert saved() == {"box"}
    poses_file("cell").write_text("[")
    with pytest.raises(ConfigError, match="does not parse"):
        one.save("more")
