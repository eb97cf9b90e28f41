"""Editing the simulated world on the page: add, move and remove objects, reset the world, undo."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

import viser

from common import topics
from common.errors import RemoteError, ZencellError
from common.messages import Vector3, WorldEdit, WorldEditReply, WorldObject, WorldObjects
from common.robot.transforms import matrix_to_rpy, pose_to_matrix
from page.console import Console, assign
from page.markup import block, buttons, press, span

MAX_UNDO = 50  # edits
MAX_ATTEMPTS = 15  # free positions that are tried for a new object: some are off the table
_AT_REST = ("table", "contained")
_SPACING = 1.3  # distance to the next object, in sizes of a new object
_RINGS, _DIRECTIONS = 6, 12  # candidate positions for a new object
_STEP = 1.0  # [mm] of the position field


class NothingToUndo(ZencellError):
    """No edit was made, or all edits are undone."""


class NoRoom(ZencellError):
    """No free position was found for a new object."""


@dataclass(frozen=True)
class _Edit:
    text: str
    inverse: tuple[WorldEdit, ...]


class WorldEditor:
    """Edits the simulated world and undoes edits, the newest first."""

    def __init__(
        self, request: Callable[[WorldEdit], Awaitable[WorldEditReply]], truth: Callable[[], WorldObjects | None]
    ) -> None:
        """Start without edits.

        Args:
            request: sends an edit to the simulation.
            truth: returns the objects of the simulated world.
        """
        self._request, self._truth = request, truth
        self._edits: list[_Edit] = []

    @property
    def last(self) -> str:
        """Text of the edit that `undo` would undo; empty if there is none."""
        return self._edits[-1].text if self._edits else ""

    async def edit(self, edit: WorldEdit) -> str:
        """Edit the world; return a text of the edit.

        Raises:
            RequestFailed: the edit failed.
        """
        truth = self._truth()
        before = {thing.id: thing for thing in truth.objects} if truth is not None else {}
        reply = await self._request(edit)
        text = f"{edit.op} {reply.id or 'of the world'}"
        self._edits.append(_Edit(text, tuple(inverse_of(edit, before, reply))))
        del self._edits[:-MAX_UNDO]
        return text

    async def undo(self) -> str:
        """Undo the last edit; return its text.

        Raises:
            NothingToUndo: there is no edit.
            RequestFailed: the edit cannot be undone any more; it is forgotten.
        """
        if not self._edits:
            raise NothingToUndo("there is no edit to undo")
        edit = self._edits.pop()
        pending = list(edit.inverse)
        while pending:
            blocked: list[WorldEdit] = []  # positions still occupied by an object that is moved later
            for step in pending:
                try:
                    await self._restore(step)
                except RemoteError as error:
                    if error.code != "occupied":
                        raise
                    blocked.append(step)
                    last_error = error
            if len(blocked) == len(pending):
                raise last_error
            pending = blocked
        return edit.text

    async def add_like(self, thing: WorldObject, x: float, y: float) -> str:
        """Add a copy of an object at a free position near x, y [m]; return a text of the edit.

        Raises:
            RequestFailed: the edit failed at every position.
            NoRoom: no position is free.
        """
        model, first_error = WorldEdit(op="add", like=thing.id), None
        for at in free_positions(x, y, max(thing.size.x, thing.size.y), self._truth())[:MAX_ATTEMPTS]:
            try:
                return await self.edit(model.model_copy(update={"position": Vector3(x=at[0], y=at[1])}))
            except RemoteError as error:
                if error.code == "unknown_id" and model.like and thing.shape != "mesh":
                    model = add_edit(thing).model_copy(update={"id": ""})
                    return await self.edit(model.model_copy(update={"position": Vector3(x=at[0], y=at[1])}))
                first_error = first_error or error
        raise first_error or NoRoom(f"no free position near {1e3 * x:.0f}, {1e3 * y:.0f} mm")

    async def _restore(self, edit: WorldEdit) -> None:
        """Apply an inverse edit; a removed object is taken from the initial layout if it is part of that."""
        if edit.op != "add":
            await self._request(edit)
            return
        try:
            await self._request(WorldEdit(op="add", id=edit.id, like=edit.id, position=edit.position, yaw=edit.yaw))
        except RemoteError as error:
            if error.code != "unknown_id" or edit.shape is None:
                raise
            await self._request(edit)


def inverse_of(edit: WorldEdit, before: dict[str, WorldObject], reply: WorldEditReply) -> list[WorldEdit]:
    """Return the edits that undo an edit.

    Args:
        edit: to undo.
        before: objects of the world before the edit, by id.
        reply: to the edit.
    """
    if edit.op == "add":
        return [WorldEdit(op="remove", id=reply.id)]
    if edit.op == "move" and reply.id in before:
        return [move_edit(before[reply.id])]
    if edit.op == "remove" and reply.id in before:
        return [add_edit(before[reply.id])]
    if edit.op == "reset":
        added = [WorldEdit(op="remove", id=name) for name in reply.ids if name not in before]
        resting = [thing for thing in before.values() if thing.state in _AT_REST]
        return added + [move_edit(thing) if thing.id in reply.ids else add_edit(thing) for thing in resting]
    return []


def center_of(thing: WorldObject) -> Vector3:
    """Return the position of an object as an edit has it: its center [m]."""
    from common.sim.objects import centre_of

    x, y, z = centre_of(thing)
    return Vector3(x=float(x), y=float(y), z=float(z))


def move_edit(thing: WorldObject) -> WorldEdit:
    """Return the edit that moves an object to its present pose."""
    return WorldEdit(op="move", id=thing.id, position=center_of(thing), yaw=_yaw(thing))


def add_edit(thing: WorldObject) -> WorldEdit:
    """Return the edit that adds an object like this one."""
    shape = thing.shape if thing.shape != "mesh" else None
    return WorldEdit.model_validate({
        "op": "add", "id": thing.id, "position": center_of(thing), "yaw": _yaw(thing), "shape": shape,
        "size": thing.size, "inner_radius": thing.inner_radius or None, "color": thing.color,
        "polygon": thing.polygon if shape == "prism" else []})


def free_positions(x: float, y: float, size: float, truth: WorldObjects | None) -> list[tuple[float, float]]:
    """Return free positions [m] for an object of a size [m], nearest to x, y [m] first."""
    taken = [center_of(thing) for thing in truth.objects if thing.state in _AT_REST] if truth is not None else []

    def free(at: tuple[float, float]) -> bool:
        return all(math.hypot(at[0] - other.x, at[1] - other.y) >= _SPACING * size for other in taken)

    positions = [(x, y)] + [(x + ring * _SPACING * size * math.cos(turn * 2 * math.pi / _DIRECTIONS),
                             y + ring * _SPACING * size * math.sin(turn * 2 * math.pi / _DIRECTIONS))
                            for ring in range(1, _RINGS + 1) for turn in range(_DIRECTIONS)]
    return [position for position in positions if free(position)]


def _yaw(thing: WorldObject) -> float | None:
    """Return the rotation about z [rad]; None for a sphere."""
    return None if thing.shape == "sphere" else matrix_to_rpy(pose_to_matrix(thing.pose)[:3, :3])[2]


class WorldPanel:
    """Fields and buttons for editing; hidden in a cell without a simulated world."""

    def __init__(
        self, gui: viser.GuiApi, console: Console, *, editing: bool, on_editing: Callable[[bool], None],
        on_reset: Callable[[], None],
    ) -> None:
        """Build the panel.

        Args:
            gui: of the server.
            console: sends requests to the cell.
            editing: initial state of the checkbox.
            on_editing: called with the new state of the checkbox.
            on_reset: called after the world was reset.
        """
        self._console, self._on_editing, self._on_reset = console, on_editing, on_reset
        self.editing = editing
        self._selected, self._target = "", (0.0, 0.0)  # id; entered position [mm]
        self._shown_position: tuple[float, float] | None = None  # of the selected object [mm]
        self._editor = WorldEditor(
            lambda edit: console.call(topics.WORLD_EDIT, edit), lambda: console.latest(topics.SCENE_OBJECTS))
        console.on_object_selected, console.on_object_moved = self._select, self._drag
        self._folder = gui.add_folder("Simulated world", visible=False)
        with self._folder:
            checkbox = gui.add_checkbox(
                "Edit simulated world", editing, hint="drag objects in the scene, or use the fields below")
            console.on_change(checkbox, self._set_editing)
            self._fields = gui.add_folder(None, visible=editing)
        with self._fields:
            self._names = gui.add_dropdown("Object", [""], hint="or click an object in the scene")
            console.on_change(self._names, self._select)
            self._position = gui.add_vector2(
                "Position [mm]", self._target, step=_STEP, hint="x, y of the object's center in the world frame")
            console.on_change(self._position, self._set_target)
            for name, action, label in (
                ("move", self._move, "Move object"), ("add", self._add, "Add copy"),
                ("remove", self._remove, "Remove object"), ("undo", self._undo, "Undo"),
                ("reset", self._reset, "Reset world"),
            ):
                console.on_press(f"world:{name}", action, label)
            self._buttons = gui.add_html("")
            self._note = gui.add_html("")

    def show(self) -> None:
        """Update objects and buttons."""
        available = self._console.is_available(topics.WORLD_EDIT)
        if self._folder.visible is not available:
            self._folder.visible = available
        if not available or not self.editing:
            return
        names = list(self._objects()) or [""]
        if list(self._names.options) != names:
            self._names.options = names
            if self._selected not in names:
                self._select(names[0])
            assign(self._names, self._selected)
        self._follow_selected()
        disabled = "" if self._selected else "there is no object"
        last = self._editor.last
        content = block(buttons(
            press("Move object", "world:move", disabled), press("Add copy", "world:add", disabled),
            press("Remove object", "world:remove", disabled)) + buttons(
            press(f"Undo: {last}" if last else "Undo", "world:undo", "" if last else "no edit to undo"),
            press("Reset world", "world:reset")), "world", objects=len(self._objects()))
        if content != self._buttons.content:
            self._buttons.content = content

    def _objects(self) -> dict[str, WorldObject]:
        truth = self._console.latest(topics.SCENE_OBJECTS)
        return {thing.id: thing for thing in truth.objects} if truth is not None else {}

    def _select(self, name: str) -> None:
        self._selected, self._shown_position = name, None
        self._follow_selected()
        if name in self._names.options:
            assign(self._names, name)

    def _follow_selected(self) -> None:
        """Show the position of the selected object if it has moved; otherwise keep what the operator entered."""
        if (thing := self._objects().get(self._selected)) is None:
            return
        center = center_of(thing)
        if (position := (round(1e3 * center.x, 1), round(1e3 * center.y, 1))) != self._shown_position:
            self._shown_position = self._target = position
            assign(self._position, position)

    def _set_target(self, target: tuple[float, float]) -> None:
        self._target = target

    def _set_editing(self, on: bool) -> None:
        self.editing = self._fields.visible = on
        self._on_editing(on)

    async def _edit(self, edit: WorldEdit) -> None:
        self._notify(f"{await self._editor.edit(edit)}: done")

    async def _move(self) -> None:
        x, y = self._target
        await self._edit(WorldEdit(op="move", id=self._selected, position=Vector3(x=1e-3 * x, y=1e-3 * y)))

    async def _drag(self, name: str, x: float, y: float) -> None:
        await self._editor.edit(WorldEdit(op="move", id=name, position=Vector3(x=x, y=y)))

    async def _add(self) -> None:
        if (thing := self._objects().get(self._selected)) is not None:
            x, y = self._target
            self._notify(f"{await self._editor.add_like(thing, 1e-3 * x, 1e-3 * y)}: done")

    async def _remove(self) -> None:
        await self._edit(WorldEdit(op="remove", id=self._selected))

    async def _reset(self) -> None:
        await self._edit(WorldEdit(op="reset"))
        self._on_reset()

    async def _undo(self) -> None:
        self._notify(f"{await self._editor.undo()}: undone")

    def _notify(self, line: str) -> None:
        self._note.content = block(span(line, "good"), "world edit", kind="good")
        self._console.notify(line, "good")
