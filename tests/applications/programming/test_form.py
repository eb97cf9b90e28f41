"""The fields of each kind of step, in the units of the page."""

from __future__ import annotations

from typing import Any

import pytest

from applications.programming import editing
from applications.programming.editing import EditRefused
from applications.programming.form import Known, fields_of, new_step
from applications.programming.model import STEPS
from common.errors import ConfigError

KNOWN = Known(poses=["home", "bin"], signals=["door", "clamp"], outputs=["clamp"], programs=["other"],
              joints=[0.1, 0.2], position=(0.4, 0.0, 0.3), scales=[57.29577951308232, 1000.0])


def made(kind: str, known: Known = KNOWN) -> dict[str, Any]:
    return {**new_step(kind, known), "id": "one"}


def labels(step: dict[str, Any]) -> dict[str, Any]:
    return {each.label: each.shown for each in fields_of(step, KNOWN) if not each.common}


@pytest.mark.parametrize("kind", STEPS)
def test_every_kind_of_step_starts_valid_and_its_shown_values_are_its_values(kind: str) -> None:
    step = made(kind)
    assert str(editing.parsed(step))
    shown = {each.path: each.shown for each in fields_of(step, KNOWN)}
    for each in fields_of(step, KNOWN):
        again = {name: value for name, value in {**step, **each.values(step, each.shown)}.items() if value is not None}
        editing.parsed(again)
        assert {other.path: other.shown for other in fields_of(again, KNOWN)} == shown, each.label


@pytest.mark.parametrize(("step", "label", "entered", "expected"), [
    ({"step": "approach", "to": "home"}, "Distance [mm]", "120", {"distance": 0.12}),
    ({"step": "approach", "to": "home"}, "Distance [mm]", "", {"distance": None}),
    ({"step": "move", "to": "home"}, "Speed [%]", "25", {"speed": 0.25}),
    ({"step": "move", "to": "home"}, "Pose", "bin", {"to": {"name": "bin"}}),
    ({"step": "move", "to": "home"}, "To", "displacement", {"to": {"by": [0.0, 0.0, 0.05]}}),
    ({"step": "move", "to": {"joints": [0.0, 0.0]}}, "Joints [°, mm]", "90; 250",
     {"to": {"joints": [90 / 57.29577951308232, 0.25]}}),
    ({"step": "move", "to": {"position": [0, 0, 0]}}, "Position [mm]", (1.0, 2.0, 3.0),
     {"to": {"position": [0.001, 0.002, 0.003]}}),
    ({"step": "move", "to": "home"}, "Requires", "door: true, clamp: off",
     {"requires": {"door": True, "clamp": False}}),
    ({"step": "move", "to": "home"}, "Touch", "cube1, bin", {"touch": ["cube1", "bin"]}),
    ({"step": "grip", "width": "open"}, "Width [mm]", "42", {"width": 0.042}),
    ({"step": "grip", "width": "open"}, "Width [mm]", "close", {"width": "close"}),
    ({"step": "grip", "width": "open"}, "Holds", "on", {"holds": True}),
    ({"step": "output", "signal": "clamp"}, "Value", "off", {"value": False}),
    ({"step": "output", "signal": "clamp"}, "Value", "5e-1", {"value": 0.5}),
    ({"step": "wait", "seconds": 1.0}, "Wait for", "a signal",
     {"seconds": None, "for": {"signal": "door"}, "timeout": None}),
    ({"step": "loop", "count": 2, "steps": []}, "Repeat", "without end", {"count": None, "while": None}),
    ({"step": "through", "points": ["home", "bin"]}, "Pose", "bin", {"points": [{"name": "bin"}, "bin"]}),
    ({"step": "python", "function": "a:b"}, "Arguments", "count: 3", {"arguments": {"count": 3}}),
])
def test_entered_value_becomes_the_value_of_the_file(
    step: dict[str, Any], label: str, entered: Any, expected: dict[str, Any]
) -> None:
    (field,) = [each for each in fields_of({**step, "id": "one"}, KNOWN) if each.label == label]
    values = field.values(step, entered)
    assert values == expected
    editing.parsed({name: value for name, value in {**step, "id": "one", **values}.items() if value is not None})


@pytest.mark.parametrize(("kind", "label", "entered", "reason"), [
    ("move", "Joints [°, mm]", "1, 2, 3", "must be 2 numbers, not 3"),
    ("move", "Joints [°, mm]", "1, two", "must be numbers, separated by commas"),
    ("move", "Requires", "}: [", "cannot be read"),
    ("move", "Touch", "&a [*a]", "cannot be read"),
    ("grip", "Width [mm]", "!!python/object/apply:os.system [ls]", "cannot be read"),
])
def test_value_that_cannot_be_read_is_refused_with_one_line(kind: str, label: str, entered: str, reason: str) -> None:
    step = made(kind)
    (field,) = [each for each in fields_of(step, KNOWN) if each.label == label]
    with pytest.raises(ConfigError, match=reason) as refused:
        field.values(step, entered)
    assert "\n" not in str(refused.value)


def test_only_the_fields_of_the_chosen_alternative_are_shown() -> None:
    assert labels({"step": "move", "to": "home", "id": "one"}) == {
        "To": "named pose", "Pose": "home", "Straight": False}
    assert labels({"step": "move", "to": {"position": [0.4, 0, 0.1]}, "id": "one"}) == {
        "To": "tool pose", "Position [mm]": (400.0, 0.0, 100.0), "Roll, pitch, yaw [°]": (180.0, 0.0, 0.0),
        "Straight": False}
    assert labels({"step": "wait", "for": {"signal": "door"}, "id": "one"}) == {
        "Wait for": "a signal", "For": "signal", "Signal": "door", "Value": True, "Above": "", "Below": "",
        "Timeout [s]": "10"}


def test_step_for_which_the_cell_has_nothing_is_not_offered() -> None:
    for kind, reason in (
            ("output", "no outputs"), ("call", "no other programs"), ("move", "joint positions are unknown")):
        with pytest.raises(EditRefused, match=reason):
            new_step(kind, Known())
