"""The panel in which the simulated world is edited: objects are added, moved, removed, put back, and that undone."""

from __future__ import annotations

from collections.abc import Callable

import viser

from common import topics
from common.messages import Vector3, WorldEdit, WorldObject
from page.console import Console, assign
from page.markup import block, buttons, press, span
from page.world_edits import middle_of

_STEP = 1.0  # [mm]


class WorldPanel:
    """Fields and buttons; not there where the world cannot be edited."""

    def __init__(
        self, gui: viser.GuiApi, console: Console, *, editing: bool, on_editing: Callable[[bool], None],
        on_reset: Callable[[], None],
    ) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            console: to the cell.
            editing: whether objects can be dragged at first.
            on_editing: called with whether they can now.
            on_reset: called when everything is where it was at first.
        """
        self._console, self._on_editing, self._on_reset = console, on_editing, on_reset
        self.editing = editing
        self._chosen, self._at = "", (0.0, 0.0)
        self._lay: tuple[float, float] | None = None  # where what is chosen was when that was last looked at [mm]
        console.picked = self._pick
        self._folder = gui.add_folder("Simulated world", visible=False)
        with self._folder:
            tick = gui.add_checkbox("Edit the simulated world", editing, hint="drag objects to other places")
            console.on_change(tick, self._set_editing)
            self._more = gui.add_folder(None, visible=editing)
        with self._more:
            self._names = gui.add_dropdown("Object", [""], hint="or click it in the scene while the world is edited")
            console.on_change(self._names, self._pick)
            self._place = gui.add_vector2("At [mm]", self._at, step=_STEP, hint="x, y of its middle in world")
            console.on_change(self._place, self._set_place)
            for name, act, told in (("move", self._move, "Move there"), ("add", self._add, "Add one like it"),
                                    ("remove", self._remove, "Remove"), ("undo", self._undo, "Undo"),
                                    ("reset", self._reset, "Reset the world")):
                console.on_press(f"world:{name}", act, told)
            self._buttons = gui.add_html("")
            self._note = gui.add_html("")

    def show(self) -> None:
        """Bring objects and buttons up to date."""
        there = self._console.answers(topics.WORLD_EDIT)
        if self._folder.visible is not there:
            self._folder.visible = there
        if not there or not self.editing:
            return
        names = list(self._things()) or [""]
        if list(self._names.options) != names:
            self._names.options = names
            if self._chosen not in names:
                self._pick(names[0])
            assign(self._names, self._chosen)
        self._follow()
        none = "" if self._chosen else "there is no object"
        last = self._console.world.last
        content = block(buttons(
            press("Move there", "world:move", none), press("Add one like it", "world:add", none),
            press("Remove", "world:remove", none)) + buttons(
            press(f"Undo: {last}" if last else "Undo", "world:undo", "" if last else "nothing was edited here"),
            press("Reset the world", "world:reset")), "world", objects=len(self._things()))
        if content != self._buttons.content:
            self._buttons.content = content

    def _things(self) -> dict[str, WorldObject]:
        truth = self._console.latest(topics.SCENE_OBJECTS)
        return {thing.id: thing for thing in truth.objects} if truth is not None else {}

    def _pick(self, name: str) -> None:
        """Choose an object, and say where it is."""
        self._chosen, self._lay = name, None
        self._follow()
        if name in self._names.options:
            assign(self._names, name)

    def _follow(self) -> None:
        """Say where the object is that is chosen, when it lies elsewhere by now; else what a person wrote stays."""
        if (thing := self._things().get(self._chosen)) is None:
            return
        middle = middle_of(thing)
        if (lies := (round(1e3 * middle.x, 1), round(1e3 * middle.y, 1))) != self._lay:
            self._lay = self._at = lies
            assign(self._place, lies)

    def _set_place(self, at: tuple[float, float]) -> None:
        self._at = at

    def _set_editing(self, on: bool) -> None:
        self.editing = self._more.visible = on
        self._on_editing(on)

    async def _do(self, edit: WorldEdit) -> None:
        self._tell(f"{await self._console.world.do(edit)}: done")

    async def _move(self) -> None:
        await self._do(WorldEdit(op="move", id=self._chosen, position=self._position(*self._at)))

    async def _add(self) -> None:
        if (thing := self._things().get(self._chosen)) is not None:
            x, y = self._at
            self._tell(f"{await self._console.world.add_like(thing, 1e-3 * x, 1e-3 * y)}: done")

    async def _remove(self) -> None:
        await self._do(WorldEdit(op="remove", id=self._chosen))

    async def _reset(self) -> None:
        await self._do(WorldEdit(op="reset"))
        self._on_reset()

    async def _undo(self) -> None:
        self._tell(f"{await self._console.world.undo()}: taken back")

    @staticmethod
    def _position(x: float, y: float) -> Vector3:
        return Vector3(x=1e-3 * x, y=1e-3 * y)

    def _tell(self, line: str) -> None:
        self._note.content = block(span(line, "good"), "world edit", kind="good")
        self._console.tell(line, "good")
