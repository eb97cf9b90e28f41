"""`--set @FILE`: the values of a file in the shape of a cell."""

from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from common.config import expanded, load_cell, parse_override, yaml_line
from common.errors import ConfigError, UnknownName


def file(folder: Path, text: str) -> str:
    path = folder / "given.yaml"
    path.write_text(text)
    return f"@{path}"


@pytest.mark.parametrize(("text", "overrides"), [
    ("motion: {velocity_scaling: 0.5}\nservices:\n  vision_detector:\n    hsv_red_lo1: [1, 2, 3]\n"
     "  camera_simulator: {}\n  scene_manager:\n",
     ["motion.velocity_scaling=0.5", "services.vision_detector.hsv_red_lo1=[1, 2, 3]"]),
    ("motion: {velocity_scaling: &half 0.5, acceleration_scaling: *half}\n",
     ["motion.velocity_scaling=0.5", "motion.acceleration_scaling=0.5"]),
    ("services: {fakes.first: {placed: 3}}", ["services.first.placed=3"]),
], ids=["nested values", "YAML aliases", "service named by its module"])
def test_file_is_replaced_by_its_values_in_place(tmp_path: Path, text: str, overrides: list[str]) -> None:
    assert expanded(["seed=1", file(tmp_path, text), "seed=2"]) == ["seed=1", *overrides, "seed=2"]


def test_file_changes_only_its_values_and_later_overrides_win(tmp_path: Path) -> None:
    given = file(tmp_path, "motion: {velocity_scaling: 0.5, planning_attempts: 7}\nworld: {count: 3}\n"
                           "pipeline: {validation_step: 0.02}\nservices: {vision_detector: {morph_kernel_px: 5}}\n")
    cell = load_cell("panda", [given, "motion.planning_attempts=9"])
    assert (cell.motion.velocity_scaling, cell.motion.planning_attempts, cell.motion.planning_time) == (0.5, 9, 10.0)
    assert (cell.world.count, cell.pipeline.validation_step) == (3, 0.02)
    assert [p.name for p in cell.pipeline.planners] == [p.name for p in load_cell("panda").pipeline.planners]
    assert cell.services["vision_detector"].parameters == {"morph_kernel_px": 5}
    assert cell.services["scene_manager"].parameters == {}


def test_complete_cell_file_can_be_given(tmp_path: Path) -> None:
    given = file(tmp_path, "world: w3\nrobot: panda\n")
    assert load_cell("panda", [given]).world == load_cell("panda", world="w3").world


@pytest.mark.parametrize("value", [
    100_000 * "[", "2026-13-01", "&a [*a]", "!!bool x", "!!int ''", "!!timestamp x", f"1{200 * ':0'}.5",
    r'"\UFFFFFFFF"',
])
def test_invalid_yaml_value_is_refused(value: str) -> None:
    with pytest.raises(ConfigError, match=r"--set world\.count.*is not a YAML value"):
        parse_override(f"world.count={value}")


@pytest.mark.parametrize(("text", "reason"), [
    ("- 1\n", "must hold a mapping"), ("a: [1\nb: }", "does not parse at line 2"),
    ("made: 2026-13-01", "does not parse: month must be in 1..12"),
    ("a: " + 100_000 * "[", "does not parse at line 1, column 67: nested deeper than 64 levels"),
    ("a: " + 100_000 * "{b: ", "nested deeper than 64 levels"), ("a:\n  " + 100_000 * "- ", "nested deeper"),
    ("a: &a {b: *a}", "does not parse at line 1, column 11: 'a' contains itself"),
    ("a0: &a0 [0]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}]\n" for n in range(1, 1000)), "line 64, .* than 64 levels"),
    ("made: !!bool x", "does not parse: a value does not fit its tag"),
    ("".join(f"a{n}: &a{n} [{','.join(10 * [f'*a{n - 1}' if n else '0'])}]\n" for n in range(9)), "more than 1000000"),
])
def test_unusable_file_is_refused_with_the_position(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        expanded([file(tmp_path, text)])


def test_missing_file_and_wrong_names_or_values_in_a_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no/where"):
        expanded(["@no/where.yaml"])
    with pytest.raises(UnknownName, match="unknown service 'visoin_detector'"):
        load_cell("panda", [file(tmp_path, "services: {visoin_detector: {rate: 1}}")])
    with pytest.raises(ConfigError, match=r"motion.velocity_scaling: 7"):
        load_cell("panda", [file(tmp_path, "motion: {velocity_scaling: 7}")])


plain = st.recursive(
    st.one_of(st.booleans(), st.integers(-10**9, 10**9), st.floats(allow_nan=False), st.text()),
    lambda inner: st.one_of(st.lists(inner), st.dictionaries(st.text(min_size=1), inner)), max_leaves=8,
)


@given(plain)
def test_value_written_on_one_line_is_parsed_as_the_same_value(value: object) -> None:
    line = yaml_line(value)
    assert len(line.splitlines()) <= 1
    assert parse_override(f"a.b={line}") == (["a", "b"], value)
    assert yaml.safe_load(line) == value
