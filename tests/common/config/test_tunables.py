"""Parameters of a service: their descriptions, and the checks of a change."""

from __future__ import annotations

from typing import Literal

import pytest
from pydantic import Field, model_validator

from common.config import Motion, Number, Parameters, Pipeline, Run, Tunable, load_cell, service_config
from common.config.tunables import apply, bounds_of, checked, describe, leaves, section_path, values_of
from common.config.world import Surroundings, World
from common.errors import Refused


class Inner(Parameters):
    near: Tunable[float] = Field(0.1, gt=0, le=1, description="least distance [m]")


class Config(Parameters):
    run: Run
    motion: Motion
    low: Tunable[int] = Field(1, ge=0, description="lower end [0..9]")
    high: Tunable[int] = Field(5, gt=0, lt=10)
    mode: Tunable[Literal["fast", "slow"]] = "fast"
    point: Tunable[tuple[Number, Number]] = Field((0.0, 1.0), description="where [m], world")
    wait: Tunable[float] = Field(2.0, description="before it gives up [s, wall time]")
    file: str = ""
    source: str | int = Field("auto", description="of pictures")
    secret: Tunable[str] = Field("", repr=False)
    must: int
    inner: Inner = Inner(near=0.2)

    @model_validator(mode="after")
    def _ordered(self) -> Config:
        if self.low > self.high:
            raise ValueError(f"low {self.low} is above high {self.high}")
        return self


@pytest.fixture
def config() -> Config:
    return Config(run=Run(cell="test"), motion=Motion(velocity_scaling=0.5), must=3)


def change(config: Config, **values: object) -> list[str]:
    """Change parameters of the service `it`; return the log lines."""
    changes = checked(config, "it", {path.replace("__", "."): value for path, value in values.items()})
    lines = [str(one) for one in changes]
    apply(changes)
    return lines


def test_parameters_are_described_by_their_fields(config: Config) -> None:
    found = {p.path: p for p in describe(config, "it")}
    own = ["low", "high", "mode", "point", "wait", "file", "source", "must", "inner.near"]
    assert list(found) == [f"services.it.{name}" for name in own] + [f"motion.{name}" for name in Motion.model_fields]
    low, high, mode, near, point, wait, must, file = (found[f"services.it.{name}"] for name in (
        "low", "high", "mode", "inner.near", "point", "wait", "must", "file"))
    assert (high.type, high.minimum, high.maximum, high.default, high.runtime) == ("integer", 1, 9, 5, True)
    assert (mode.type, mode.choices, mode.value) == ("string", ["fast", "slow"], "fast")
    assert (near.type, near.minimum, near.maximum, near.unit, near.default) == ("number", 0, 1, "m", 0.2)
    assert (point.type, point.value, point.unit) == ("list", [0.0, 1.0], "m")
    assert (wait.unit, low.unit, file.runtime) == ("s", "", False), "a range is no unit"
    assert (must.value, must.default, must.changed) == (3, 3, False), "a required value is its own default"
    assert (found["motion.velocity_scaling"].value, found["motion.velocity_scaling"].default) == (0.5, 0.2)
    assert [bounds_of(Config.model_fields[name]) for name in ("low", "high", "mode")] == [">= 0", "> 0, < 10", ""]


def test_changed_parameters_are_those_that_differ_from_the_start(config: Config) -> None:
    started = values_of(config, "it")
    change(config, services__it__low=2)
    assert [p.path for p in describe(config, "it", started) if p.changed] == ["services.it.low"]
    change(config, services__it__low=1)
    assert not [p for p in describe(config, "it", started) if p.changed]


def test_change_is_made_in_place_by_apply_and_described_with_old_and_new_value(config: Config) -> None:
    motion, inner = config.motion, config.inner
    assert checked(config, "it", {"services.it.low": 1}) == []
    assert len(checked(config, "it", {"services.it.low": 2})) == 1 and config.low == 1
    lines = change(config, services__it__inner__near=0.3, motion__velocity_scaling=0.25, services__it__point=[2, 3])
    assert sorted(lines) == ["motion.velocity_scaling: 0.5 -> 0.25", "services.it.inner.near: 0.2 -> 0.3",
                             "services.it.point: [0.0, 1.0] -> [2.0, 3.0]"]
    assert config.motion is motion and config.inner is inner
    assert (motion.velocity_scaling, inner.near, config.point) == (0.25, 0.3, (2.0, 3.0))
    change(config, services__it__low=7, services__it__high=8)  # valid only together
    assert (config.low, config.high) == (7, 8)


@pytest.mark.parametrize(("code", "values", "message"), [
    ("bad_value", {"services.it.low": 2, "services.it.high": 10},
     "services.it.high: 10 must be less than 10 (integer, > 0, < 10)"),
    ("bad_value", {"services.it.mode": "medium"}, "services.it.mode: 'medium' must be 'fast' or 'slow'"),
    ("bad_value", {"services.it.inner.near": 0},
     "services.it.inner.near: 0 must be greater than 0 (number, > 0, <= 1)"),
    ("bad_value", {"motion.velocity_scaling": 1.5}, "motion.velocity_scaling: 1.5 must be less than or equal to 1"),
    ("bad_value", {"services.it.low": "many"}, "services.it.low: 'many' must be a valid integer"),
    ("bad_value", {"services.it.low": 7}, "services.it: low 7 is above high 5"),
    ("bad_value", {"services.it.wait": float("nan")}, "services.it.wait: nan must be a finite number"),
    ("bad_value", {"services.it.point": [1.0]}, "services.it.point.1"),
    *(("bad_value", {path: value}, f"{path}: {value!r} must be a number") for value in (True, "1")
      for path in ("services.it.wait", "services.it.high", "motion.velocity_scaling")),
    ("needs_restart", {"services.it.low": 2, "services.it.file": "a.png"},
     "services.it.file: needs a restart: zencell up CELL --set services.it.file=a.png"),
    ("unknown_parameter", {"services.it.hihg": 1},
     "unknown parameter of it 'services.it.hihg' (did you mean 'services.it.high'?); choices: "),
    *(("unknown_parameter", {path: 1}, f"unknown parameter of it '{path}'")
      for path in ("services.it.secret", "services.it.inner", "services.other.low", "run.seed")),
])
def test_invalid_change_is_refused_and_changes_nothing(config: Config, code: str, values, message: str) -> None:
    before = values_of(config, "it")
    with pytest.raises(Refused) as refused:
        checked(config, "it", values)
    line = str(refused.value)
    assert refused.value.code == code and line.startswith(message) and "\n" not in line
    assert values_of(config, "it") == before
    assert "services.it.secret" not in leaves(config, "it")


def test_sections_have_the_names_of_the_cell_file() -> None:
    assert [section_path(kind) for kind in (Motion, Pipeline, World, Surroundings)] == [
        "motion", "pipeline", "world", "world"]


def test_service_has_a_copy_of_its_sections() -> None:
    class Mover(Parameters):
        motion: Motion

    cell = load_cell("panda")
    apply(checked(service_config(cell, "mover", Mover), "mover", {"motion.velocity_scaling": 0.9}))
    assert cell.motion.velocity_scaling == service_config(cell, "mover", Mover).motion.velocity_scaling == 0.2
