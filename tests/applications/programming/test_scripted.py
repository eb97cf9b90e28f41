"""Exported scripts: each call is the step of the program."""

from __future__ import annotations

from typing import Any

import pytest

from applications.programming.editing import parsed
from applications.programming.model import STEPS, BaseStep
from applications.programming.scripted import Steps

FIELDS: dict[str, dict[str, Any]] = {
    "move": {"to": "home"}, "through": {"points": ["home"]}, "approach": {"to": "home"}, "retreat": {},
    "grip": {"width": "open"}, "output": {"signal": "clamp"}, "wait": {"seconds": 1.0},
    "until": {"force": 5.0}, "insert": {"depth": 0.02}, "python": {"function": "my:own"},
    "pick": {"kind": "part", "object": "part_1"}, "place": {"at": "home"},
}
IN_PYTHON = {"loop", "if", "call", "palletize"}  # a script has loops and functions of its own


def test_all_kinds_of_steps_are_covered() -> None:
    assert FIELDS.keys() | IN_PYTHON == set(STEPS)


@pytest.mark.parametrize("kind", FIELDS)
def test_call_of_a_script_is_the_step_of_the_program(kind: str) -> None:
    done: list[BaseStep] = []
    steps = Steps.__new__(Steps)
    steps._do = done.append  # type: ignore[method-assign]
    getattr(steps, kind)(**FIELDS[kind])
    assert done == [parsed({"step": kind, "id": kind, **FIELDS[kind]})]
