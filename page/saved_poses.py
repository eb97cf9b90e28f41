"""Panel of the saved poses on the page: save, delete, and move through several of them."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Sequence
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from common.config import check
from common.errors import ConfigError, ZencellError
from common.saved_poses import MAX_POSES, Poses, SavedPoses, load_poses, poses_file, save_poses
from page.markup import Html, block, buttons, line, press, span, text

if TYPE_CHECKING:
    import viser

    from page.console import ActionQueue


class SavedPosesPanel:
    """Saves and deletes poses, and moves through several of them."""

    def __init__(
        self, gui: viser.GuiApi, actions: ActionQueue, cell: str, joints: Sequence[str],
        positions: Callable[[], NDArray[Any] | None], on_change: Callable[[], None],
        move_through: Callable[[list[str]], Coroutine[Any, Any, None]], reserved: Sequence[str] = (),
    ) -> None:
        """Build the panel.

        Args:
            gui: of the server.
            actions: runs the buttons.
            cell: whose poses are shown.
            joints: names, in order.
            positions: returns the current joint positions [rad, m].
            on_change: called when poses were saved or deleted.
            move_through: moves the arm to poses, one after the other.
            reserved: names that have another meaning.
        """
        self._actions, self._joints, self._positions = actions, list(joints), positions
        self._on_change, self._move_through, self._reserved = on_change, move_through, reserved
        self._name = self._sequence = self._problem = ""
        try:
            self._file = poses_file(cell)
            self._saved = load_poses(self._file)
        except (ZencellError, OSError) as error:
            self._saved, self._problem = SavedPoses(), str(error)
        name = gui.add_text("Pose name", "", hint="of the pose to save or delete")
        sequence = gui.add_text("Sequence", "", hint="saved poses, separated by commas: a, b, a")
        actions.on_change(name, self._set_name)
        actions.on_change(sequence, self._set_sequence)
        for button, action in (("save", self._save), ("delete", self._delete), ("sequence", self._run_sequence)):
            actions.on_press(f"pose:{button}", action, f"saved poses: {button}")
        self._html = Html(gui)

    @property
    def names(self) -> list[str]:
        """Names of the saved poses, except reserved ones."""
        return [name for name in self._saved.poses if name not in self._reserved]

    def positions(self, name: str) -> list[float]:
        """Return the joint positions of a pose [rad, m].

        Raises:
            ConfigError: no pose has that name.
        """
        if name in self._reserved:
            raise ConfigError("pose", name, "is a reserved name")
        return self._saved.named(name, self._joints)

    def show(self, arm_blocked: str) -> None:
        """Update the buttons; `arm_blocked` is why the arm cannot be moved, or empty."""
        problem = self._problem
        reserved = [name for name in self._saved.poses if name in self._reserved]
        warning = problem or (f"hidden, because the name is reserved: {', '.join(reserved)}" if reserved else "")
        self._html.set(block(buttons(
            press("Save current pose", "pose:save", problem or ("" if self._name else "enter a pose name first")),
            press("Delete", "pose:delete", problem or (
                "" if self._name in self._saved.poses else "no pose has this name")),
            press("Run sequence", "pose:sequence", arm_blocked or (
                "" if self._sequence.strip() else "enter a sequence first"), arm=True))
            + f"<div>{span('Saved:', 'dim')} {text(', '.join(self.names) or 'none')}</div>"
            + (line(warning, "bad") if warning else ""), "poses"))

    def _save(self) -> None:
        q = self._positions()
        if q is None:
            raise ConfigError("pose", self._name, "cannot be saved: the joint positions are unknown")
        pose = {name: round(float(value), 6) for name, value in zip(self._joints, q, strict=True)}
        if self._name in self._reserved:
            raise ConfigError("pose", self._name, "is a reserved name")

        def added(poses: Poses) -> Poses:
            if len(poses) >= MAX_POSES and self._name not in poses:
                raise ConfigError("pose", self._name, f"exceeds the limit of {MAX_POSES} saved poses")
            return {**poses, self._name: pose}

        self._update(added, f"Pose {self._name} saved in")

    def _delete(self) -> None:
        self._update(lambda poses: {name: pose for name, pose in poses.items() if name != self._name},
                     f"Pose {self._name} deleted from")

    def _update(self, change: Callable[[Poses], Poses], message: str) -> None:
        """Change the current content of the file: another page or an editor may have changed it."""
        if self._problem:
            raise ConfigError("pose", self._name, self._problem)
        try:
            saved = check(SavedPoses, {"poses": change(load_poses(self._file).poses)}, "pose")
            save_poses(self._file, saved)
        except OSError as error:
            self._actions.notify(f"{error.filename or self._file} cannot be written: {error.strerror}")
            return
        self._saved = saved
        self._on_change()
        self._actions.notify(f"{message} {self._file}", "good")

    async def _run_sequence(self) -> None:
        names = [name.strip() for name in self._sequence.split(",") if name.strip()]
        for name in names:
            self.positions(name)  # check all names before the first motion
        await self._move_through(names)

    def _set_name(self, name: str) -> None:
        self._name = name.strip()

    def _set_sequence(self, sequence: str) -> None:
        self._sequence = sequence
