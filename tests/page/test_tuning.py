"""Fields of the Tuning tab for parameters."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import viser

from common.config import load_cell, service_config
from common.config.tunables import describe
from common.errors import ConfigError
from common.messages import Parameter
from page.tuning import ParameterField, group_of, label_of
from services import vision_detector

Make = Callable[..., ParameterField]


def parameter(**fields: Any) -> Parameter:
    return Parameter.model_validate({"path": "services.a.b", "value": 1.0, "type": "number", "runtime": True, **fields})


@pytest.fixture
def make(gui: viser.GuiApi) -> Iterator[Make]:
    """Make a field for a parameter; all fields are removed at the end."""
    made: list[ParameterField] = []

    def make_field(found: Parameter | None = None, **fields: Any) -> ParameterField:
        made.append(ParameterField(gui, found or parameter(**fields), ["a"]))
        return made[-1]

    yield make_field
    for field in made:
        field.handle.remove()


@pytest.mark.parametrize(("fields", "kind"), [
    ({"value": True, "type": "boolean"}, viser.GuiCheckboxHandle),
    ({"value": "red", "type": "string", "choices": ["red", "green"]}, viser.GuiDropdownHandle),
    ({"value": "any", "type": "string"}, viser.GuiTextHandle),
    ({"value": 0.5, "minimum": 0, "maximum": 1}, viser.GuiSliderHandle),
    ({"value": 3, "type": "integer", "minimum": 1, "maximum": 9}, viser.GuiSliderHandle),
    ({"value": 0.5, "minimum": 0}, viser.GuiNumberHandle),
    ({"value": 0.01, "minimum": 0, "maximum": 1e6}, viser.GuiNumberHandle),  # a slider would be too coarse
    ({"value": 5.0, "minimum": 0, "maximum": 1}, viser.GuiNumberHandle),  # out of its bounds
    ({"value": [1, 2], "type": "list"}, viser.GuiTextHandle),
    ({"value": None, "type": "number"}, viser.GuiTextHandle),
])
def test_field_fits_the_type_of_the_parameter(make: Make, fields: dict[str, Any], kind: type[object]) -> None:
    assert type(make(**fields).handle) is kind


def test_every_parameter_of_a_real_service_gets_a_field_with_its_bounds(make: Make) -> None:
    config = service_config(load_cell("panda"), "vision_detector", vision_detector.Config)
    tunable = [p for p in describe(config, "vision_detector") if p.runtime]
    assert tunable
    for listed in tunable:
        handle = make(listed).handle
        if isinstance(handle, viser.GuiSliderHandle):
            assert (handle.min, handle.max) == (listed.minimum, listed.maximum)


def test_label_has_the_unit_and_a_mark_for_a_changed_value(make: Make) -> None:
    found = parameter(path="services.vision_detector.blob.min_area", unit="px^2")
    assert label_of(found) == "blob min area [px^2]" and group_of(found) == "vision_detector"
    assert label_of(parameter(path="motion.velocity_scaling")) == "velocity scaling"
    assert group_of(parameter(path="motion.velocity_scaling")) == "motion"
    field = make(found)
    for changed, label in ((True, "● blob min area [px^2]"), (False, "blob min area [px^2]")):
        field.show(found.model_copy(update={"changed": changed}))
        assert field.handle.label == label


def test_new_value_is_shown_if_it_fits_and_the_operator_is_not_changing_it(make: Make) -> None:
    field = make(value=0.5, minimum=0, maximum=1)
    for field.pending, value in ((True, 0.5), (False, 0.7)):
        field.show(parameter(value=0.7, minimum=0, maximum=1))
        assert field.handle.value == value
    assert field.fits(parameter(value=1, minimum=0, maximum=1))
    assert not any(field.fits(parameter(value=other, minimum=0, maximum=1)) for other in ("high", None, [1.0], True))
    chosen = make(value="red", type="string", choices=["red", "green"])
    assert not chosen.fits(parameter(value="blue", type="string", choices=["red", "green"]))


def test_list_is_entered_as_yaml_and_text_as_it_is(make: Make) -> None:
    listed = make(value=[1, 2], type="list")
    assert listed.handle.value == "[1, 2]" and listed.parse("[3, 4]") == [3, 4]
    with pytest.raises(ConfigError, match=r"services\.a\.b: '\[3, ' is not a YAML value"):
        listed.parse("[3, ")
    assert make(value="a", type="string").parse("[3, ") == "[3, "
