"""The Tuning tab: parameters of running services, built from their descriptions."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping
from typing import Any

import viser
import yaml
from pydantic import JsonValue, TypeAdapter

from common.config import parse_yaml
from common.errors import ConfigError
from common.messages import Parameter
from page.browser_values import INVALID, is_acceptable
from page.console import SLIDER_DEBOUNCE, Console, assign
from page.markup import Html, block, span
from page.status_text import USER_ERRORS, error_text

MIN_SLIDER_STEPS = 200
MIN_STEP = 1e-9  # of a slider
MAX_STEP_AT_ZERO = 10  # step of a slider around a value of 0
TYPING_DEBOUNCE = 0.8  # [s] without a key press, after which a text or number is sent

_JSON: TypeAdapter[JsonValue] = TypeAdapter(JsonValue)
HINT = "Parameters that may change while the cell runs. ● marks values that differ from the start of the cell."


class TuningPanel:
    """A folder of fields for each service and each section of the cell that has runtime parameters."""

    def __init__(
        self, gui: viser.GuiApi, tab: viser.GuiTabHandle | viser.GuiFolderHandle, console: Console
    ) -> None:
        """Build the panel in a tab; the console sends the changes."""
        self._gui, self._tab, self._console = gui, tab, console
        self._fields: dict[str, ParameterField] = {}
        self._folders: dict[str, viser.GuiFolderHandle] = {}
        with tab:
            self._note = Html(gui)
        self._report(HINT, "dim")

    def show(self, found: Mapping[str, list[Parameter]]) -> None:
        """Update from the parameters of each service; those of a service that does not respond remain."""
        services: dict[str, list[str]] = {}
        parameters: dict[str, Parameter] = {}
        for service, listed in found.items():
            for parameter in listed:
                if parameter.runtime:
                    services.setdefault(parameter.path, []).append(service)
                    parameters.setdefault(parameter.path, parameter)
        for path, parameter in parameters.items():
            field = self._fields.get(path)
            if field is not None and field.fits(parameter):
                field.services = services[path]
                field.show(parameter)
                continue
            if field is not None:
                field.handle.remove()
            self._fields[path] = self._add(parameter, services[path])

    def _add(self, parameter: Parameter, services: list[str]) -> ParameterField:
        group = group_of(parameter)
        if group not in self._folders:
            with self._tab:
                self._folders[group] = self._gui.add_folder(group.replace("_", " "), expand_by_default=False)
        with self._folders[group]:
            field = ParameterField(self._gui, parameter, services)
        self._console.on_change(field.handle, lambda value: self._set(field, value), "tune")
        return field

    async def _set(self, field: ParameterField, value: Any) -> None:
        """Send a value once the operator has finished changing it."""
        field.changes += 1
        change, field.pending = field.changes, True
        await asyncio.sleep(field.debounce)
        if change != field.changes:
            return
        path = field.parameter.path
        try:
            parsed = field.parse(value)
            await self._console.set_parameter(field.services, path, parsed)
        except USER_ERRORS as error:
            self._report(error_text(error), "bad")
            if change == field.changes:
                field.pending = False
                field.show(field.parameter)
            return
        self._report(f"{path} set to {parsed}", "good")
        if change == field.changes:
            field.pending = False
            field.parameter = field.parameter.model_copy(update={"value": parsed})

    def _report(self, message: str, kind: str) -> None:
        self._note.set(block(span(message, kind), "tuning", kind=kind))


class ParameterField:
    """The field of a parameter: a slider, checkbox, dropdown, number or text, according to its description.

    Attributes:
        parameter: newest known state.
        services: that have it.
        changes: number of changes by the operator.
        pending: whether a change was not sent yet.
    """

    def __init__(self, gui: viser.GuiApi, parameter: Parameter, services: list[str]) -> None:
        """Add the field at the current position of the GUI."""
        self.parameter = parameter
        self.services = services
        self.changes = 0
        self.pending = False
        self.as_yaml = False
        self._label = label_of(parameter)
        self.handle = self._add(gui, f"{parameter.description or self._label} ({parameter.path})")
        immediate = isinstance(self.handle, viser.GuiCheckboxHandle | viser.GuiDropdownHandle)
        is_slider = isinstance(self.handle, viser.GuiSliderHandle)
        self.debounce = 0.0 if immediate else SLIDER_DEBOUNCE if is_slider else TYPING_DEBOUNCE
        self._mark()

    def _add(self, gui: viser.GuiApi, hint: str) -> viser.GuiInputHandle[Any]:
        p, value = self.parameter, self.parameter.value
        if p.type == "boolean" and isinstance(value, bool):
            return gui.add_checkbox(self._label, value, hint=hint)
        if p.choices and value in p.choices:
            return gui.add_dropdown(self._label, p.choices, initial_value=str(value), hint=hint)
        if _is_number(p) and isinstance(value, int | float):
            is_integer = p.type == "integer"
            number: Any = int if is_integer else float
            low, high = (None if bound is None else number(bound) for bound in (p.minimum, p.maximum))
            step = step_of(p)
            if (low is not None and value < low) or (high is not None and value > high):
                low = high = step = None  # the service accepted this value
            if low is not None and high is not None and step is not None:
                return gui.add_slider(self._label, low, high, number(step), number(value), hint=hint)
            return gui.add_number(
                self._label, number(value), min=low, max=high, step=1 if is_integer else None, hint=hint)
        self.as_yaml = p.type != "string" or not isinstance(value, str)
        return gui.add_text(self._label, self._text(value), hint=hint)

    def _text(self, value: JsonValue) -> str:
        if not self.as_yaml:
            return str(value)
        if isinstance(value, float) and not math.isfinite(value):
            return INVALID
        text = str(yaml.safe_dump(value, default_flow_style=True, width=10_000))
        return text.removesuffix("\n").removesuffix("\n...")

    def parse(self, entered: Any) -> JsonValue:
        """Return the value that was entered.

        Raises:
            ConfigError: a text is not valid YAML.
        """
        if not self.as_yaml:
            return entered  # type: ignore[no-any-return]
        try:
            value: JsonValue = _JSON.validate_python(parse_yaml(entered))
        except (yaml.YAMLError, ValueError):  # an impossible date is a ValueError
            raise ConfigError(self.parameter.path, entered, "is not a YAML value") from None
        return value

    def show(self, parameter: Parameter) -> None:
        """Show the current value, unless the operator is changing it."""
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
        """Return whether this field can show a parameter; otherwise it has to be replaced."""
        return _form(self.parameter) == _form(parameter)


def _form(p: Parameter) -> tuple[object, ...]:
    """Return the properties of a parameter that determine its field."""
    kind = "number" if _is_number(p) else type(p.value).__name__
    return p.path, p.type, p.minimum, p.maximum, p.choices, kind, p.choices and p.value in p.choices


def _is_number(p: Parameter) -> bool:
    """Return whether a field for numbers can show the value of a parameter; text can show any value."""
    return p.type in ("number", "integer") and type(p.value) in (int, float) and is_acceptable(p.value)


def label_of(parameter: Parameter) -> str:
    """Return the label of a parameter: the end of its path, and the unit."""
    parts = parameter.path.split(".")
    name = " ".join(parts[2:] if parts[0] == "services" else parts[1:]).replace("_", " ")
    return f"{name} [{parameter.unit}]" if parameter.unit else name


def group_of(parameter: Parameter) -> str:
    """Return the folder of a parameter: its service, or its section of the cell."""
    parts = parameter.path.split(".")
    return parts[1] if parts[0] == "services" else parts[0]


def step_of(parameter: Parameter) -> float | None:
    """Return a round step for a slider; None without bounds, or if it would exceed a quarter of the value."""
    if parameter.minimum is None or parameter.maximum is None or parameter.maximum <= parameter.minimum:
        return None
    least = (parameter.maximum - parameter.minimum) / MIN_SLIDER_STEPS
    if least < MIN_STEP:
        return None
    step = 10 ** math.floor(math.log10(least))
    if parameter.type == "integer":
        step = max(1, step)
    sizes = [abs(v) for v in (parameter.value, parameter.default)
             if isinstance(v, int | float) and not isinstance(v, bool) and v]
    fine = step <= min(sizes) / 4 if sizes else step <= MAX_STEP_AT_ZERO
    return step if fine or parameter.type == "integer" else None
