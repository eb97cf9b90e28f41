"""What a parameter is turned with on the page: a slider, tick, list, number or text, made from its description."""

from __future__ import annotations

import math
from typing import Any

import viser
import yaml
from pydantic import JsonValue

from common.errors import ConfigError
from common.messages import Parameter
from common.viewer.desk import assign

SLIDER_STEPS = 200  # at least; a slider that moves coarser than a quarter of the value is of no use
COARSE = 10  # a slider's step about a value of 0
TYPING = 0.8  # [s] after the last letter a text or number is sent
SLIDING = 0.15  # [s] after a slider came to rest


class Knob:
    """One parameter on the page.

    Attributes:
        parameter: as it was heard of last.
        services: that have it.
        turned: how often the person changed it.
        pending: whether what the person gave is still on its way.
    """

    def __init__(self, gui: viser.GuiApi, parameter: Parameter, services: list[str]) -> None:
        """Put it where the GUI stands."""
        self.parameter = parameter
        self.services = services
        self.turned = 0
        self.pending = False
        self.as_text = False
        self._label = label_of(parameter)
        self.handle = self._make(gui, f"{parameter.description or self._label} ({parameter.path})")
        immediate = isinstance(self.handle, viser.GuiCheckboxHandle | viser.GuiDropdownHandle)
        self.patience = 0.0 if immediate else SLIDING if isinstance(self.handle, viser.GuiSliderHandle) else TYPING
        self._mark()

    def _make(self, gui: viser.GuiApi, hint: str) -> viser.GuiInputHandle[Any]:
        p, value = self.parameter, self.parameter.value
        if p.type == "boolean" and isinstance(value, bool):
            return gui.add_checkbox(self._label, value, hint=hint)
        if p.choices and value in p.choices:
            return gui.add_dropdown(self._label, p.choices, initial_value=str(value), hint=hint)
        if p.type in ("number", "integer") and isinstance(value, int | float):
            whole = p.type == "integer"
            number: Any = int if whole else float
            low, high = (None if bound is None else number(bound) for bound in (p.minimum, p.maximum))
            step = step_of(p)
            if (low is not None and value < low) or (high is not None and value > high):
                low = high = step = None  # its service must know
            if low is not None and high is not None and step is not None:
                return gui.add_slider(self._label, low, high, number(step), number(value), hint=hint)
            return gui.add_number(self._label, number(value), min=low, max=high, step=1 if whole else None, hint=hint)
        self.as_text = p.type != "string" or not isinstance(value, str)
        return gui.add_text(self._label, self._text(value), hint=hint)

    def _text(self, value: JsonValue) -> str:
        if not self.as_text:
            return str(value)
        text = str(yaml.safe_dump(value, default_flow_style=True, width=10_000))
        return text.removesuffix("\n").removesuffix("\n...")

    def read(self, given: Any) -> JsonValue:
        """The value that was given with it.

        Raises:
            ConfigError: a text that can not be read.
        """
        if not self.as_text:
            return given  # type: ignore[no-any-return]
        try:
            return yaml.safe_load(given)  # type: ignore[no-any-return]
        except yaml.YAMLError:
            raise ConfigError(self.parameter.path, given, "is not a YAML value") from None

    def show(self, parameter: Parameter) -> None:
        """Show the value that a parameter has now, unless the person is just changing it."""
        self.parameter = parameter
        if self.pending:
            return
        value = self._text(parameter.value) if isinstance(self.handle, viser.GuiTextHandle) else parameter.value
        if value is not None and value != self.handle.value:
            assign(self.handle, value)
        self._mark()

    def _mark(self) -> None:
        label = f"● {self._label}" if self.parameter.changed else self._label
        if self.handle.label != label:
            self.handle.label = label

    def fits(self, parameter: Parameter) -> bool:
        """Whether it can show that parameter; else another has to be made."""
        return _form(self.parameter) == _form(parameter)


def _form(p: Parameter) -> tuple[object, ...]:
    """What of a parameter decides what it is turned with."""
    kind = "number" if isinstance(p.value, int | float) and not isinstance(p.value, bool) else type(p.value).__name__
    return p.path, p.type, p.minimum, p.maximum, p.choices, kind, p.choices and p.value in p.choices


def label_of(parameter: Parameter) -> str:
    """What a parameter is called on the page: the end of its path in words, and the unit."""
    parts = parameter.path.split(".")
    name = " ".join(parts[2:] if parts[0] == "services" else parts[1:]).replace("_", " ")
    return f"{name} [{parameter.unit}]" if parameter.unit else name


def group_of(parameter: Parameter) -> str:
    """Under which heading a parameter stands: its service, or its section of the cell."""
    parts = parameter.path.split(".")
    return parts[1] if parts[0] == "services" else parts[0]


def step_of(parameter: Parameter) -> float | None:
    """A round step for a slider between the bounds; None when a slider would be too coarse or there are no bounds."""
    if parameter.minimum is None or parameter.maximum is None or parameter.maximum <= parameter.minimum:
        return None
    step = 10 ** math.floor(math.log10((parameter.maximum - parameter.minimum) / SLIDER_STEPS))
    if parameter.type == "integer":
        step = max(1, step)
    sizes = [abs(v) for v in (parameter.value, parameter.default)
             if isinstance(v, int | float) and not isinstance(v, bool) and v]
    fine = step <= min(sizes) / 4 if sizes else step <= COARSE
    return step if fine or parameter.type == "integer" else None
