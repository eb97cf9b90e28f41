"""SavedPoses poses in their file."""

from __future__ import annotations

from pathlib import Path

import pytest

from common.config import check
from common.errors import ConfigError
from page.saved_poses import HEADER, SavedPoses, load_taught, save_taught, taught_file

POSES = {"bin": {"a": 0.25, "b": -1.0}, "über der Kiste": {"b": 0.5, "a": 0.0}}


def test_what_was_taught_is_read_again_and_named_in_the_order_of_the_joints() -> None:
    path = taught_file("cell")
    assert load_taught(path) == SavedPoses()
    save_taught(path, SavedPoses(poses=POSES))
    again = load_taught(path)
    assert again.poses == POSES and path.read_text(encoding="utf-8").startswith(HEADER)
    assert again.named("über der Kiste", ["a", "b"]) == [0.0, 0.5]
    assert [each.name for each in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize(("name", "joints", "why"), [
    ("box", ["a", "b"], "choices: bin"), ("bin", ["a"], "another arm")])
def test_pose_that_there_is_not_is_refused_by_name(name: str, joints: list[str], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        SavedPoses(poses=POSES).named(name, joints)


@pytest.mark.parametrize("name", ["", " a", "a, b", "x" * 41, "a\nb"])
def test_name_that_cannot_stand_in_a_row_of_waypoints_is_refused(name: str) -> None:
    with pytest.raises(ConfigError):
        check(SavedPoses, {"poses": {name: {"a": 0.0}}}, "pose")


@pytest.mark.parametrize("text", ["poses: 3", "poses: {bin: {a: .nan}}", "[", "other: {}"])
def test_file_that_holds_something_else_is_refused_by_its_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "cell.poses.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="poses"):
        load_taught(path)
