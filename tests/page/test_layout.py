from __future__ import annotations

from pathlib import Path

import pytest

from common.application import find_application
from common.atomic_file import state_folder
from common.config import config_root
from common.errors import ConfigError
from page.layers import find_layers, layers_shown
from page.layout import TABS, Layout, Viewpoint, load_layout, save_layout


def test_layout_of_the_project_can_be_read_and_has_every_panel() -> None:
    layout = load_layout("", print)
    assert set(layout.tabs) == set(TABS)
    assert set(layout.viewpoints) == {"panda", "ur5"}
    assert layers_shown(layout.layers, find_layers(find_application("outlining")))["robot"]


def test_layout_that_is_saved_is_the_users_own_and_the_projects_stays_as_it_is(tmp_path: Path) -> None:
    before = (config_root() / "viewer.yaml").read_text()
    path = save_layout("", Layout(dark=False))
    assert path.is_relative_to(state_folder()) and not load_layout("", print).dark
    assert (config_root() / "viewer.yaml").read_text() == before


def test_without_a_home_the_projects_layout_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("none")))
    assert set(load_layout("", print).viewpoints) == {"panda", "ur5"}
    with pytest.raises(ConfigError, match="has no home"):
        save_layout("", Layout())


def test_saved_layout_reads_back(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    layout = Layout(tabs=["Log"], layers={"grid": False}, viewpoints={"panda": Viewpoint(position=(1, 2, 3))})
    assert save_layout(str(file), layout) == file
    assert load_layout(str(file), print) == layout
    assert list(tmp_path.iterdir()) == [file]


def test_tab_that_is_newer_than_a_saved_layout_appears_but_not_where_it_was_left_out_on_purpose(tmp_path: Path) -> None:
    file, older = tmp_path / "mine.yaml", [tab for tab in TABS if tab != "Time"]
    file.write_text(f"tabs: {older}\n")
    assert load_layout(str(file), print).tabs == [*older, "Time"]
    save_layout(str(file), Layout(tabs=older))
    assert load_layout(str(file), print).tabs == older
    file.write_text("tabs: [Log, Move]\n")
    assert load_layout(str(file), print).tabs == ["Log", "Move"]


def test_save_that_fails_leaves_the_file_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "mine.yaml"
    save_layout(str(file), Layout())
    before = file.read_text()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space"):
        save_layout(str(file), Layout(dark=False))
    assert file.read_text() == before and list(tmp_path.iterdir()) == [file]


def test_read_only_file_is_not_replaced(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    save_layout(str(file), Layout())
    file.chmod(0o444)
    with pytest.raises(PermissionError, match="read-only"):
        save_layout(str(file), Layout(dark=False))
    assert load_layout(str(file), print).dark


def test_project_without_a_layout_has_the_usual_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZENCELL_CONFIG", str(tmp_path))
    assert config_root() == tmp_path and load_layout("", print) == Layout()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tabs: [Cameras, Lottery]", r"tabs\.1: 'Lottery' must be 'Cameras', 'Health'"),
        ("panel_width: 3", "panel_width: 3 must be greater than or equal to 280"),
        ("colour: red", "colour: 'red' is not a parameter; choices: annotated_image"),
        ("viewpoints: {panda: {position: [0, 0, .nan]}}", "position"),
        ("[]", "must hold a mapping"),
    ],
)
def test_layout_that_can_not_be_used_names_the_file_the_field_and_what_would_do(
    tmp_path: Path, text: str, said: str
) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=said) as error:
        load_layout(str(file), print)
    assert "mine.yaml" in str(error.value)


@pytest.mark.parametrize("text", ["", "tabs: [Lottery]", "panel_width: 3", "tabs: [Log"])
def test_layout_of_ones_own_that_cannot_be_used_is_told_and_keeps_no_cell_down(text: str) -> None:
    save_layout("", Layout(dark=False)).write_text(text)
    told: list[str] = []
    assert set(load_layout("", told.append).viewpoints) == {"panda", "ur5"}, "the project's"
    assert len(told) == 1 and "viewer.yaml" in told[0]


def test_file_that_was_asked_for_must_be_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load_layout(str(tmp_path / "none.yaml"), print)


def test_tabs_stand_in_the_order_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(f"tabs: [{', '.join(reversed(TABS))}]")
    assert load_layout(str(file), print).tabs == list(reversed(TABS))
