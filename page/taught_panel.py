"""Poses with names: taught where the arm is, forgotten, and gone through one after the other."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Sequence
from typing import Any

import viser
from numpy.typing import NDArray

from common.config import check
from common.errors import ConfigError, ZencellError
from page.console import Desk
from page.markup import block, buttons, press, span, text
from page.taught import MOST, Taught, load_taught, save_taught, taught_file

Poses = dict[str, dict[str, float]]


class TaughtPanel:
    """A field for a name, one for the names of a row, and buttons."""

    def __init__(
        self, gui: viser.GuiApi, desk: Desk, cell: str, joints: Sequence[str],
        where: Callable[[], NDArray[Any] | None], changed: Callable[[], None],
        through: Callable[[list[str]], Coroutine[Any, Any, None]], taken: Sequence[str] = (),
    ) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            desk: takes the orders.
            cell: whose poses they are.
            joints: names, in order.
            where: the joints are now [rad, m].
            changed: called when there are other poses.
            through: has the arm go to poses, one after the other.
            taken: names that mean something else.
        """
        self._desk, self._joints, self._where = desk, list(joints), where
        self._changed, self._through, self._taken = changed, through, taken
        self._name = self._row = ""
        self._problem = ""
        try:
            self._file = taught_file(cell)
            self._taught = load_taught(self._file)
        except (ZencellError, OSError) as error:
            self._taught, self._problem = Taught(), str(error)
        name = gui.add_text("Name", "", hint="of the pose to teach or to forget")
        row = gui.add_text("Waypoints", "", hint="names of taught poses with commas between them: a, b, a")
        desk.on_change(name, self._set_name)
        desk.on_change(row, self._set_row)
        for order, act in (("teach", self._teach), ("forget", self._forget), ("through", self._go)):
            desk.on_press(f"taught:{order}", act, f"taught pose: {order}")
        self._html = gui.add_html("")

    @property
    def names(self) -> list[str]:
        """Of the poses that there are, but for those that mean something else: nothing is to be offered twice."""
        return [name for name in self._taught.poses if name not in self._taken]

    def positions(self, name: str) -> list[float]:
        """Joints in a pose [rad, m].

        Raises:
            ConfigError: there is none of that name.
        """
        if name in self._taken:
            raise ConfigError("pose", name, "is a name that means something else already")
        return self._taught.named(name, self._joints)

    def show(self, why: str) -> None:
        """Have what moves the arm off for a reason, or on without one."""
        listed = ", ".join(self.names) or "none yet"
        file = self._problem
        twice = [name for name in self._taught.poses if name in self._taken]
        said = file or (f"not offered, for they mean something else: {', '.join(twice)}" if twice else "")
        content = block(buttons(
            press("Teach", "taught:teach", file or ("" if self._name else "give it a name first")),
            press("Forget", "taught:forget", file or (
                "" if self._name in self._taught.poses else "there is no such pose")),
            press("Go through", "taught:through", why or ("" if self._row.strip() else "name the waypoints first"),
                  arm=True)) + f"<div>{span('Taught:', 'dim')} {text(listed)}</div>"
            + (f"<div>{span(said, 'bad')}</div>" if said else ""), "taught")
        if content != self._html.content:
            self._html.content = content

    def _teach(self) -> None:
        q = self._where()
        if q is None:
            raise ConfigError("pose", self._name, "cannot be taught: where the arm is is not known")
        pose = {name: round(float(value), 6) for name, value in zip(self._joints, q, strict=True)}
        if self._name in self._taken:
            raise ConfigError("pose", self._name, "is a name that means something else already")

        def with_it(poses: Poses) -> Poses:
            if len(poses) >= MOST and self._name not in poses:
                raise ConfigError("pose", self._name, f"is one too many: {MOST} are kept")
            return {**poses, self._name: pose}

        self._keep(with_it, f"{self._name} is taught, kept in")

    def _forget(self) -> None:
        self._keep(lambda poses: {name: pose for name, pose in poses.items() if name != self._name},
                   f"{self._name} is forgotten, in")

    def _keep(self, changed: Callable[[Poses], Poses], line: str) -> None:
        """Change what is in the file now: another page, or a person, may have written it since it was read."""
        if self._problem:
            raise ConfigError("pose", self._name, self._problem)
        try:
            taught = check(Taught, {"poses": changed(load_taught(self._file).poses)}, "pose")
            save_taught(self._file, taught)
        except OSError as error:
            self._desk.tell(f"{error.filename or self._file} cannot be written: {error.strerror}")
            return
        self._taught = taught
        self._changed()
        self._desk.tell(f"{line} {self._file}", "good")

    async def _go(self) -> None:
        names = [name.strip() for name in self._row.split(",") if name.strip()]
        for name in names:
            self.positions(name)  # all of them are known before the first is gone to
        await self._through(names)

    def _set_name(self, name: str) -> None:
        self._name = name.strip()

    def _set_row(self, row: str) -> None:
        self._row = row
