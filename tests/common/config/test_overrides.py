"""`--set @FILE`: the values of a file in the shape of a cell."""

from __future__ import annotations

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


def test_the_values_of_a_file_stand_where_the_file_is_given(tmp_path: Path) -> None:
    given = file(tmp_path, "motion: {velocity_scaling: 0.5}\nservices:\n  vision_detector:\n"
                           "    hsv_red_lo1: [1, 2, 3]\n  camera_simulator: {}\n  scene_manager:\n")
    assert expanded(["seed=1", given, "seed=2"]) == [
        "seed=1", "motion.velocity_scaling=0.5", "services.vision_detector.hsv_red_lo1=[1, 2, 3]", "seed=2"]


def test_a_file_changes_what_it_names_and_the_last_word_counts(tmp_path: Path) -> None:
    given = file(tmp_path, "motion: {velocity_scaling: 0.5, planning_attempts: 7}\nworld: {count: 3}\n"
                           "pipeline: {validation_step: 0.02}\nservices: {vision_detector: {morph_kernel_px: 5}}\n")
    cell = load_cell("panda", [given, "motion.planning_attempts=9"])
    assert (cell.motion.velocity_scaling, cell.motion.planning_attempts, cell.motion.planning_time) == (0.5, 9, 10.0)
    assert (cell.world.count, cell.pipeline.validation_step) == (3, 0.02)
    assert [p.name for p in cell.pipeline.planners] == [p.name for p in load_cell("panda").pipeline.planners]
    assert cell.services["vision_detector"].parameters == {"morph_kernel_px": 5}
    assert cell.services["scene_manager"].parameters == {}


def test_names_in_a_file_stand_for_what_they_name(tmp_path: Path) -> None:
    given = file(tmp_path, "motion: {velocity_scaling: &half 0.5, acceleration_scaling: *half}\n")
    assert expanded([given]) == ["motion.velocity_scaling=0.5", "motion.acceleration_scaling=0.5"]


@pytest.mark.parametrize("value", [
    100_000 * "[", "2026-13-01", "&a [*a]", "!!bool x", "!!int ''", "!!timestamp x", f"1{200 * ':0'}.5",
    r'"\UFFFFFFFF"',
])
def test_a_value_that_is_none_is_refused(value: str) -> None:
    with pytest.raises(ConfigError, match=r"--set world\.count.*is not a YAML value"):
        parse_override(f"world.count={value}")


def test_a_whole_cell_file_can_be_given(tmp_path: Path) -> None:
    given = file(tmp_path, "world: w3\nrobot: panda\n")
    assert load_cell("panda", [given]).world == load_cell("panda", world="w3").world


def test_a_service_goes_by_the_last_part_of_its_module(tmp_path: Path) -> None:
    assert expanded([file(tmp_path, "services: {fakes.first: {placed: 3}}")]) == ["services.first.placed=3"]


@pytest.mark.parametrize(("text", "said"), [
    ("- 1\n", "must hold a mapping"), ("a: [1\nb: }", "does not parse at line 2"),
    ("made: 2026-13-01", "does not parse: month must be in 1..12"),
    ("a: " + 100_000 * "[", "does not parse at line 1, column 67: nested deeper than 64 levels"),
    ("a: " + 100_000 * "{b: ", "nested deeper than 64 levels"), ("a:\n  " + 100_000 * "- ", "nested deeper"),
    ("a: &a {b: *a}", "does not parse at line 1, column 11: 'a' contains itself"),
    ("a0: &a0 [0]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}]\n" for n in range(1, 1000)), "line 64, .* than 64 levels"),
    ("made: !!bool x", "does not parse: a value does not fit its tag"),
    ("".join(f"a{n}: &a{n} [{','.join(10 * [f'*a{n - 1}' if n else '0'])}]\n" for n in range(9)), "more than 1000000"),
])
def test_a_file_that_can_not_be_used_is_named(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        expanded([file(tmp_path, text)])
    with pytest.raises(ConfigError, match="no/where"):
        expanded(["@no/where.yaml"])


def test_what_a_file_names_wrongly_is_told_as_if_it_were_set(tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match="unknown service 'visoin_detector'"):
        load_cell("panda", [file(tmp_path, "services: {visoin_detector: {rate: 1}}")])
    with pytest.raises(ConfigError, match=r"motion.velocity_scaling: 7"):
        load_cell("panda", [file(tmp_path, "motion: {velocity_scaling: 7}")])


plain = st.recursive(
    st.one_of(st.booleans(), st.integers(-10**9, 10**9), st.floats(allow_nan=False), st.text()),
    lambda inner: st.one_of(st.lists(inner), st.dictionaries(st.text(min_size=1), inner)), max_leaves=8,
)


@given(plain)
def test_a_value_on_a_line_reads_back_as_itself(value: object) -> None:
    line = yaml_line(value)
    assert len(line.splitlines()) <= 1
    path, read = parse_override(f"a.b={line}")
    assert (path, read) == (["a", "b"], value)
    assert yaml.safe_load(line) == value
