"""The form of the chosen step on the page: one element per field, with the reason below it why a value is refused."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import viser

from applications.programming.form import FormField
from page.console import Console, assign
from page.markup import Html, block, line
from page.status_text import USER_ERRORS, error_text
from page.viser_inside import element_id

TYPING_DEBOUNCE = 0.8  # [s] without a key press, after which a text or number is applied
Apply = Callable[[str, FormField, Any], None]  # id of the step, field, displayed value; raises for an invalid value


class StepFields:
    """Elements for the fields of one step.

    They are removed when another step is chosen: what another page enters for the former step is then ignored instead
    of changing this one.
    """

    def __init__(self, gui: viser.GuiApi, console: Console, apply: Apply) -> None:
        """Add the folders at the current position of the GUI; `apply` makes a change."""
        self._gui, self._console, self._apply = gui, console, apply
        self._folder = gui.add_folder("Step", visible=False)
        self._more = gui.add_folder("More of this step", expand_by_default=False, visible=False)
        self._shape: object = None
        self._id = ""
        self._elements: dict[tuple[str | int, ...], viser.GuiInputHandle[Any]] = {}
        self._fields: dict[tuple[str | int, ...], FormField] = {}
        self._pending: dict[tuple[str | int, ...], tuple[int, Any]] = {}  # number of the change, and the entered value
        self._reasons: dict[tuple[str | int, ...], Html] = {}
        self._changes = 0

    def show(self, id_: str, fields: Sequence[FormField]) -> None:
        """Show the fields of a step; none without one."""
        shape = [id_, *((each.path, each.label, each.kind, tuple(each.options)) for each in fields)]
        if shape != self._shape:
            self._rebuild(id_, fields)
            self._shape = shape
        for each in fields:
            self._fields[each.path] = each
            element = self._elements[each.path]
            if each.path not in self._pending and each.path not in self._reasons and element.value != each.shown:
                assign(element, each.shown)

    @property
    def pending(self) -> bool:
        """Whether a value was entered that is not applied yet."""
        return bool(self._pending)

    def flush(self) -> None:
        """Apply what was entered so far without waiting for the end of typing. Raises ConfigError."""
        for path in list(self._pending):
            self._change(path)

    def _rebuild(self, id_: str, fields: Sequence[FormField]) -> None:
        for element in self._elements.values():
            self._console.permissions.forget(element_id(element))
            element.remove()
        for path in list(self._reasons):
            self._reasons.pop(path).remove()
        self._elements.clear()
        self._fields.clear()
        self._pending.clear()
        self._id = id_
        self._folder.label = id_ or "Step"
        self._folder.visible, self._more.visible = bool(fields), any(each.common for each in fields)
        for each in fields:
            with self._more if each.common else self._folder:
                element = self._elements[each.path] = self._add(each)
            self._console.on_change(element, partial(self._entered, id_, each.path))

    def _add(self, each: FormField) -> viser.GuiInputHandle[Any]:
        gui, hint = self._gui, each.hint or None
        if each.kind == "check":
            return gui.add_checkbox(each.label, each.shown, hint=hint)
        if each.kind == "choice":
            return gui.add_dropdown(each.label, each.options, initial_value=each.shown, hint=hint)
        if each.kind == "vector":
            return gui.add_vector3(each.label, each.shown, step=0.1, hint=hint)
        return gui.add_text(each.label, each.shown, hint=hint)

    async def _entered(self, id_: str, path: tuple[str | int, ...], value: Any) -> None:
        """Apply a value once the operator has finished entering it."""
        if id_ != self._id or path not in self._fields:
            return
        self._changes += 1
        change = self._changes
        self._pending[path] = change, value
        if self._fields[path].kind in ("text", "vector"):
            await asyncio.sleep(TYPING_DEBOUNCE)
        if id_ == self._id and self._pending.get(path, (0, None))[0] == change:
            self._change(path)

    def _change(self, path: tuple[str | int, ...]) -> None:
        _, value = self._pending.pop(path)
        if (reason := self._reasons.pop(path, None)) is not None:
            reason.remove()
        try:
            self._apply(self._id, self._fields[path], value)
        except USER_ERRORS as error:
            below = self._elements[path].order + 0.1
            with self._more if self._fields[path].common else self._folder:
                self._reasons[path] = Html(
                    self._gui, block(line(error_text(error), "bad"), "step reason"), order=below)
            raise
