"""The layout of the page: default, saved by the user, and invalid."""

from pathlib import Path
from unittest.mock import Mock

import pytest

from common.application import find_application
from common.atomic_file import state_folder
from common.config import config_root
from common.errors import ConfigError
from page.layers import find_layers, shown_layers
from page.layout import TABS, Layout, Viewpoint, load_layout, save_layout

CELLS = {"panda", "ur5"}  # with a viewpoint in the default layout


def test_layout_is_saved_for_the_user_and_the_default_is_unchanged() -> None:
    layout, before = load_layout("", print), (config_root() / "viewer.yaml").read_text()
    assert set(layout.tabs) == set(TABS) and set(layout.viewpoints) == CELLS
    assert shown_layers(layout.layers, find_layers(find_application("outlining")))["robot"]
    path = save_layout("", Layout(dark=False))
    assert path.is_relative_to(state_folder()) and not load_layout("", print).dark
    assert (config_root() / "viewer.yaml").read_text() == before


def test_default_layout_without_a_home_or_a_layout_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setattr(Path, "home", Mock(side_effect=RuntimeError("none")))
    assert set(load_layout("", print).viewpoints) == CELLS
    with pytest.raises(ConfigError, match="home"):
        save_layout("", Layout())
    monkeypatch.setenv("ZENCELL_CONFIG", str(tmp_path))
    assert config_root() == tmp_path and load_layout("", print) == Layout()


def test_saved_layout_is_read_again_and_a_failed_save_leaves_it_unchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "mine.yaml"
    layout = Layout(tabs=["Log"], layers={"grid": False}, viewpoints={"panda": Viewpoint(position=(1, 2, 3))})
    assert save_layout(str(file), layout) == file
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", Mock(side_effect=OSError(28, "No space left on device")))
        with pytest.raises(OSError, match="No space"):
            save_layout(str(file), Layout(dark=False))
    file.chmod(0o444)
    with pytest.raises(PermissionError, match="read-only"):
        save_layout(str(file), Layout(dark=False))
    assert load_layout(str(file), print) == layout and list(tmp_path.iterdir()) == [file]


def test_tab_newer_than_a_saved_layout_is_added_unless_it_was_removed_on_purpose(tmp_path: Path) -> None:
    file, older = tmp_path / "mine.yaml", [tab for tab in TABS if tab != "Time"]
    file.write_text(f"tabs: {older}\n")
    assert load_layout(str(file), print).tabs == [*older, "Time"]
    save_layout(str(file), Layout(tabs=older))
    assert load_layout(str(file), print).tabs == older
    for tabs in (["Log", "Move"], list(reversed(TABS))):
        file.write_text(f"tabs: {tabs}\n")
        assert load_layout(str(file), print).tabs == tabs


@pytest.mark.parametrize(("text", "message"), [
    ("tabs: [Cameras, Lottery]", r"tabs\.1: 'Lottery' must be 'Move', 'Cameras'"),
    ("panel_width: 3", "panel_width: 3 must be greater than or equal to 280"),
    ("colour: red", "colour: 'red' is not a parameter; choices: annotated_image"),
    ("viewpoints: {panda: {position: [0, 0, .nan]}}", "position"),
    ("[]", "must hold a mapping"),
])
def test_invalid_layout_is_rejected_with_file_field_and_choices(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message) as error:
        load_layout(str(file), print)
    assert "mine.yaml" in str(error.value)
    with pytest.raises(ConfigError, match="cannot be read"):
        load_layout(str(tmp_path / "none.yaml"), print)


@pytest.mark.parametrize("text", ["", "tabs: [Lottery]", "panel_width: 3", "tabs: [Log"])
def test_invalid_layout_of_the_user_causes_a_warning_only(text: str) -> None:
    save_layout("", Layout(dark=False)).write_text(text)
    warnings: list[str] = []
    assert set(load_layout("", warnings.append).viewpoints) == CELLS
    assert len(warnings) == 1 and "viewer.yaml" in warnings[0]
