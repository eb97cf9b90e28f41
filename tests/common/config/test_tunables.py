"""Parameters of a service: what is said of them, and what a change is checked for."""

from __future__ import annotations

from typing import Literal

import pytest
from pydantic import Field, model_validator

from common.config import Motion, Number, Parameters, Pipeline, Run, Tunable, load_cell
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


def config() -> Config:
    return Config(run=Run(cell="test"), motion=Motion(velocity_scaling=0.5), must=3)


def change(c: Config, **values: object) -> list[str]:
    changes = checked(c, "it", {path.replace("__", "."): value for path, value in values.items()})
    said = [str(one) for one in changes]
    apply(changes)
    return said


def refusal(c: Config, values: dict[str, object]) -> tuple[str, str]:
    before = values_of(c, "it")
    with pytest.raises(Refused) as caught:
        checked(c, "it", values)
    assert values_of(c, "it") == before
    assert "\n" not in str(caught.value)
    return caught.value.code, str(caught.value)


def test_every_parameter_is_described_by_what_its_field_says() -> None:
    found = {p.path: p for p in describe(config(), "it")}
    own = ["low", "high", "mode", "point", "wait", "file", "source", "must", "inner.near"]
    assert list(found) == [f"services.it.{name}" for name in own] + [f"motion.{name}" for name in Motion.model_fields]
    high, mode, near = (found[f"services.it.{name}"] for name in ("high", "mode", "inner.near"))
    assert (high.type, high.minimum, high.maximum, high.default, high.runtime) == ("integer", 1, 9, 5, True)
    assert (mode.type, mode.choices, mode.value) == ("string", ["fast", "slow"], "fast")
    assert (near.type, near.minimum, near.maximum, near.unit, near.default) == ("number", 0, 1, "m", 0.2)
    assert found["services.it.point"].type == "list" and found["services.it.point"].value == [0.0, 1.0]
    assert not found["services.it.file"].runtime
    assert (found["motion.velocity_scaling"].value, found["motion.velocity_scaling"].default) == (0.5, 0.2)


def test_units_are_read_from_descriptions_and_ranges_are_none() -> None:
    units = {p.path.rpartition(".")[2]: p.unit for p in describe(config(), "it")}
    assert (units["low"], units["point"], units["wait"]) == ("", "m", "s")


def test_a_value_that_had_to_be_given_is_its_own_default() -> None:
    (must,) = [p for p in describe(config(), "it") if p.path == "services.it.must"]
    assert (must.value, must.default, must.changed) == (3, 3, False)


def test_what_a_service_was_started_with_tells_what_was_changed() -> None:
    c = config()
    started = values_of(c, "it")
    change(c, services__it__low=2)
    assert [p.path for p in describe(c, "it", started) if p.changed] == ["services.it.low"]
    change(c, services__it__low=1)
    assert not [p for p in describe(c, "it", started) if p.changed]


def test_secrets_are_neither_shown_nor_set() -> None:
    assert "services.it.secret" not in leaves(config(), "it")
    assert refusal(config(), {"services.it.secret": "x"})[0] == "unknown_parameter"


def test_a_change_is_made_in_place_and_said_with_old_and_new() -> None:
    c = config()
    motion, inner = c.motion, c.inner
    said = change(c, services__it__inner__near=0.3, motion__velocity_scaling=0.25, services__it__point=[2, 3])
    assert sorted(said) == ["motion.velocity_scaling: 0.5 -> 0.25", "services.it.inner.near: 0.2 -> 0.3",
                            "services.it.point: [0.0, 1.0] -> [2.0, 3.0]"]
    assert c.motion is motion and c.inner is inner
    assert (motion.velocity_scaling, inner.near, c.point) == (0.25, 0.3, (2.0, 3.0))


def test_nothing_changes_before_apply_nor_where_the_value_is_the_same() -> None:
    c = config()
    assert checked(c, "it", {"services.it.low": 1}) == []
    assert len(checked(c, "it", {"services.it.low": 2})) == 1
    assert c.low == 1


def test_one_bad_value_refuses_all() -> None:
    code, said = refusal(config(), {"services.it.low": 2, "services.it.high": 10})
    assert code == "bad_value"
    assert said == "services.it.high: 10 must be less than 10 (integer, > 0, < 10)"


@pytest.mark.parametrize(("values", "said"), [
    ({"services.it.mode": "medium"}, "services.it.mode: 'medium' must be 'fast' or 'slow'"),
    ({"services.it.inner.near": 0}, "services.it.inner.near: 0 must be greater than 0 (number, > 0, <= 1)"),
    ({"motion.velocity_scaling": 1.5}, "motion.velocity_scaling: 1.5 must be less than or equal to 1"),
    ({"services.it.low": "many"}, "services.it.low: 'many' must be a valid integer"),
    ({"services.it.low": 7}, "services.it: low 7 is above high 5"),
    ({"services.it.wait": float("nan")}, "services.it.wait: nan must be finite"),
    ({"services.it.point": [1.0]}, "services.it.point.1"),
])
def test_a_bad_value_is_refused_with_path_value_and_what_would_do(values: dict[str, object], said: str) -> None:
    code, message = refusal(config(), values)
    assert code == "bad_value"
    assert message.startswith(said)


def test_values_that_fit_only_together_are_set_together() -> None:
    c = config()
    change(c, services__it__low=7, services__it__high=8)
    assert (c.low, c.high) == (7, 8)


def test_what_needs_a_restart_says_how() -> None:
    code, said = refusal(config(), {"services.it.low": 2, "services.it.file": "a.png"})
    assert code == "needs_restart"
    assert said == "services.it.file: needs a restart: zencell up CELL --set services.it.file=a.png"


def test_a_parameter_that_is_not_there_is_refused_with_the_choices() -> None:
    for path in ("services.it.hihg", "services.it.inner", "services.other.low", "run.seed"):
        code, said = refusal(config(), {path: 1})
        assert code == "unknown_parameter" and "choices: " in said and "services.it.high" in said
    assert "did you mean 'services.it.high'?" in refusal(config(), {"services.it.hihg": 1})[1]


def test_sections_go_by_what_a_cell_calls_them() -> None:
    assert [section_path(kind) for kind in (Motion, Pipeline, World, Surroundings)] == [
        "motion", "pipeline", "world", "world"]


def test_bounds_are_written_as_people_write_them() -> None:
    fields = Config.model_fields
    assert [bounds_of(fields[name]) for name in ("low", "high", "mode")] == [">= 0", "> 0, < 10", ""]


def test_a_service_has_a_copy_of_its_sections() -> None:
    from common.config import service_config

    class Mover(Parameters):
        motion: Motion

    cell = load_cell("panda")
    apply(checked(service_config(cell, "mover", Mover), "mover", {"motion.velocity_scaling": 0.9}))
    assert cell.motion.velocity_scaling == service_config(cell, "mover", Mover).motion.velocity_scaling == 0.2


@pytest.mark.parametrize("value", [True, "1"])
@pytest.mark.parametrize("path", ["services.it.wait", "services.it.high", "motion.velocity_scaling"])
def test_neither_a_truth_nor_a_text_is_a_number(path: str, value: object) -> None:
    code, told = refusal(config(), {path: value})
    assert code == "bad_value" and told.startswith(f"{path}: {value!r} must be a number")
