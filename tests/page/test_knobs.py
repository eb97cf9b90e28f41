from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import viser

from common.config import load_cell, service_config
from common.config.tunables import describe
from common.errors import ConfigError
from common.messages import Parameter
from page.server import close_server, make_server
from page.tuning import Knob, group_of, label_of, step_of
from services import vision_detector


@pytest.fixture(scope="module")
def gui() -> Iterator[viser.GuiApi]:
    server = make_server("127.0.0.1", 0)
    yield server.gui
    close_server(server)


def parameter(**fields: Any) -> Parameter:
    return Parameter.model_validate({"path": "services.a.b", "value": 1.0, "type": "number", "runtime": True, **fields})


@pytest.mark.parametrize(
    ("fields", "kind"),
    [
        ({"value": True, "type": "boolean"}, viser.GuiCheckboxHandle),
        ({"value": "red", "type": "string", "choices": ["red", "green"]}, viser.GuiDropdownHandle),
        ({"value": "any", "type": "string"}, viser.GuiTextHandle),
        ({"value": 0.5, "minimum": 0, "maximum": 1}, viser.GuiSliderHandle),
        ({"value": 3, "type": "integer", "minimum": 1, "maximum": 9}, viser.GuiSliderHandle),
        ({"value": 0.5, "minimum": 0}, viser.GuiNumberHandle),
        ({"value": 0.01, "minimum": 0, "maximum": 1e6}, viser.GuiNumberHandle),  # a slider would be too coarse
        ({"value": 5.0, "minimum": 0, "maximum": 1}, viser.GuiNumberHandle),  # nor can it stand beside its bounds
        ({"value": [1, 2], "type": "list"}, viser.GuiTextHandle),
        ({"value": None, "type": "number"}, viser.GuiTextHandle),
    ],
)
def test_knob_is_made_for_what_the_parameter_is(gui: viser.GuiApi, fields: dict[str, Any], kind: type[object]) -> None:
    knob = Knob(gui, parameter(**fields), ["a"])
    assert type(knob.handle) is kind
    knob.handle.remove()


def test_every_parameter_of_a_real_service_gets_a_knob_with_its_bounds(gui: viser.GuiApi) -> None:
    config = service_config(load_cell("panda"), "vision_detector", vision_detector.Config)
    tunable = [p for p in describe(config, "vision_detector") if p.runtime]
    assert tunable
    for listed in tunable:
        knob = Knob(gui, listed, ["vision_detector"])
        if isinstance(knob.handle, viser.GuiSliderHandle):
            assert (knob.handle.min, knob.handle.max) == (listed.minimum, listed.maximum)
        knob.handle.remove()


def test_label_has_the_unit_and_a_mark_when_it_was_changed(gui: viser.GuiApi) -> None:
    found = parameter(path="services.vision_detector.blob.min_area", unit="px^2")
    assert label_of(found) == "blob min area [px^2]" and group_of(found) == "vision_detector"
    assert label_of(parameter(path="motion.velocity_scaling")) == "velocity scaling"
    assert group_of(parameter(path="motion.velocity_scaling")) == "motion"
    knob = Knob(gui, found, ["vision_detector"])
    knob.show(found.model_copy(update={"changed": True}))
    assert knob.handle.label == "● blob min area [px^2]"
    knob.show(found)
    assert knob.handle.label == "blob min area [px^2]"
    knob.handle.remove()


def test_value_from_elsewhere_is_shown_unless_the_person_is_changing_it(gui: viser.GuiApi) -> None:
    knob = Knob(gui, parameter(value=0.5, minimum=0, maximum=1), ["a"])
    knob.pending = True
    knob.show(parameter(value=0.7, minimum=0, maximum=1))
    assert knob.handle.value == 0.5
    knob.pending = False
    knob.show(parameter(value=0.7, minimum=0, maximum=1))
    assert knob.handle.value == 0.7
    knob.handle.remove()


def test_knob_that_can_not_show_a_value_is_not_asked_to(gui: viser.GuiApi) -> None:
    knob = Knob(gui, parameter(value=0.5, minimum=0, maximum=1), ["a"])
    assert knob.fits(parameter(value=1, minimum=0, maximum=1))
    for odd in ("high", None, [1.0], True):
        assert not knob.fits(parameter(value=odd, minimum=0, maximum=1))
    chosen = Knob(gui, parameter(value="red", type="string", choices=["red", "green"]), ["a"])
    assert not chosen.fits(parameter(value="blue", type="string", choices=["red", "green"]))
    for made in (knob, chosen):
        made.handle.remove()


def test_lists_are_given_as_yaml_and_text_as_it_is(gui: viser.GuiApi) -> None:
    listed = Knob(gui, parameter(value=[1, 2], type="list"), ["a"])
    assert listed.handle.value == "[1, 2]" and listed.read("[3, 4]") == [3, 4]
    with pytest.raises(ConfigError, match=r"services\.a\.b: '\[3, ' is not a YAML value"):
        listed.read("[3, ")
    text = Knob(gui, parameter(value="a", type="string"), ["a"])
    assert text.read("[3, ") == "[3, "
    for knob in (listed, text):
        knob.handle.remove()


@pytest.mark.parametrize(
    ("fields", "step"),
    [
        ({"minimum": 0, "maximum": 1}, 0.001), ({"minimum": 0, "maximum": 1000, "value": 60}, 1),
        ({"minimum": 1, "maximum": 9, "type": "integer", "value": 2}, 1), ({"minimum": 0}, None),
        ({"minimum": 1, "maximum": 1}, None), ({"minimum": 0, "maximum": 1000, "value": 0.5}, None),
    ],
)
def test_step_is_round_and_fine_enough(fields: dict[str, Any], step: float | None) -> None:
    assert step_of(parameter(**fields)) == pytest.approx(step)
