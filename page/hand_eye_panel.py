"""The panel that guides a hand-eye calibration: which views are missing, pictures, residuals and a verdict."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import viser

from common import topics
from common.config import RobotConfig, check
from common.errors import ConfigError
from common.messages import CameraInfo, Image, JointState
from common.topics import Topic
from page.console import Console
from page.feeds import Latest
from page.markup import block, buttons, fields, press, row, span, table

if TYPE_CHECKING:
    from page.hand_eye import HandEye, Mount, Result

MOUNTS: dict[str, Mount] = {"on the hand": "hand", "beside an arm that holds the board": "beside"}
PERIOD = 0.5  # [s] between two pictures that are looked at


class HandEyePanel:
    """Fields for camera and board, what is missing, and buttons. Nothing moves from here: jog to where views are."""

    def __init__(
        self, gui: viser.GuiApi, console: Console, latest: Latest, images: Sequence[Topic[Image]], robot: RobotConfig,
        *, on_listen: Callable[[], None],
    ) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            console: takes what a person does.
            latest: the newest message of a topic.
            images: of the cameras.
            robot: that carries camera or board.
            on_listen: called when `wanted` has changed.
        """
        self._console, self._latest, self._robot, self._on_listen = console, latest, robot, on_listen
        self._images = {topic.key: topic for topic in images}
        self._values: dict[str, Any] = {"name": "", "camera": next(iter(self._images), ""), "mount": "on the hand",
                                        "columns": 7, "rows": 5, "square": 36.0, "auto": True}
        self._views: HandEye | None = None
        self._camera = next(iter(self._images))  # that the views are of: another one's pictures are none of them
        self._busy, self._said, self._due = False, "", 0.0
        self._seen: tuple[Image | None, JointState | None] = (None, None)
        self._result: Result | None = None
        made: list[tuple[str, Any]] = [
            ("name", gui.add_text("Called", "", hint="under which the views are kept")),
            ("camera", gui.add_dropdown("Camera", list(self._images) or [""])),
            ("mount", gui.add_dropdown("It is", list(MOUNTS))),
            ("columns", gui.add_number("Squares along x", 7, min=3, max=50, step=1)),
            ("rows", gui.add_number("Squares along y", 5, min=3, max=50, step=1)),
            ("square", gui.add_number("Square [mm]", 36.0, min=1.0, max=1000.0, step=0.1,
                                      hint="as measured on the print of `zencell calibrate board`")),
            ("auto", gui.add_checkbox("Take pictures by itself", True, hint="whenever the arm rests in a new pose")),
        ]
        for name, handle in made:
            console.on_change(handle, partial(self._set, name))
        for name, act, told in (("begin", self._begin, "Begin"), ("take", self._take, "Take a picture"),
                                ("calibrate", self._calibrate, "Calibrate"), ("end", self._end, "End")):
            console.on_press(f"eye:{name}", act, told)
        self._buttons = gui.add_html("")
        self._html = gui.add_html("")

    @property
    def wanted(self) -> list[Topic[Any]]:
        """What is to be read now."""
        topic = self._images[self._camera]
        return [topic, self._info(topic)] if self._views is not None else []

    @staticmethod
    def _info(topic: Topic[Any]) -> Topic[CameraInfo]:
        return replace(topics.CAMERA_INFO, key=f"{topic.key.rpartition('/')[0]}/camera_info")

    def follow(self, now: float) -> None:
        """Take note of joints at a wall time [s], monotonic, and look at the newest picture if that is wanted."""
        views = self._views
        if views is None or self._busy:
            return
        state = self._latest(topics.JOINT_STATES)
        if state is not None and state is not self._seen[1]:
            self._seen = (self._seen[0], state)
            views.joints(state)
        if self._values["auto"] and now >= self._due:
            self._due = now + PERIOD
            image = self._latest(self._images[self._camera])
            if image is not None and image is not self._seen[0]:
                self._seen = (image, self._seen[1])
                self._console.put(self._take)

    def show(self) -> None:
        """Bring the panel up to date."""
        views = self._views
        from_views = "" if views is not None else "begin first"
        content = block(buttons(
            press("Begin" if views is None else "Begin another", "eye:begin", "" if self._values["name"] else
                  "give it a name first"),
            press("Take a picture", "eye:take", from_views or ("one is looked at" if self._busy else "")),
            press("Calibrate", "eye:calibrate", from_views or self._too_few()),
            press("End", "eye:end", from_views)), "hand-eye orders")
        if content != self._buttons.content:
            self._buttons.content = content
        if (content := self._told()) != self._html.content:
            self._html.content = content

    def _too_few(self) -> str:
        from page.hand_eye import why_not

        return why_not(self._views.count) if self._views is not None else ""

    def _told(self) -> str:
        """What is missing, what became of the last picture, and the result."""
        views = self._views
        if views is None:
            return block(span("Fix a board where the camera sees it, name the calibration, begin, then jog the arm: "
                              "tilt the hand to all sides between pictures.", "dim"), "hand-eye", views=0)
        turned = {f"turned about {axis}": f"{degrees:.0f}°" for axis, degrees in views.turned.items()}
        missing = views.missing
        todo = span(f"Missing: {missing}", "busy") if missing else span("Nothing is missing: calibrate", "good")
        lines = [fields({"views": views.count, "of": self._camera, **turned}), f"<div>{todo}</div>",
                 f"<div>{span(self._said, 'dim')}</div>"]
        if (result := self._result) is not None:
            kinds = ["good" if result.good else "bad", *["" for _ in result.lines[1:]]]
            lines += [f"<div>{span(line, kind)}</div>" for line, kind in zip(result.lines, kinds, strict=True)]
            rows = [row(span(each.name, ""), f"{each.rms:.2f} px", span(said, "busy" if said else ""))
                    for each, said in [*((each, "") for each in result.residuals),
                                       *((each, "dropped: does not fit") for each in result.dropped)]]
            lines.append(table(("View", "Residual ", ""), rows, "small"))
        return block("".join(lines), "hand-eye", views=views.count, missing=missing, good=bool(result and result.good))

    # --- what a person does ----------------------------------------------------------------------------------------

    def _set(self, name: str, value: Any) -> None:
        self._values[name] = value.strip() if isinstance(value, str) else value

    async def _begin(self) -> None:
        from page.hand_eye import HandEye
        from tools.calibration.board import Board, BoardOptions

        square = 1e-3 * self._values["square"]
        board = Board(check(BoardOptions, {"columns": round(self._values["columns"]), "square": square,
                                           "rows": round(self._values["rows"]), "marker": round(0.75 * square, 6)},
                            "board"))
        camera = self._values["camera"]
        self._views = await asyncio.to_thread(
            HandEye, self._values["name"], self._robot, board, MOUNTS[self._values["mount"]])
        self._camera, self._said, self._result = camera, "", None
        self._on_listen()
        self._console.tell(f"Views are kept in {self._views.folder}", "good")

    def _end(self) -> None:
        self._views = None
        self._on_listen()

    async def _take(self) -> None:
        views, image = self._views, self._latest(self._images[self._camera])
        if views is None or self._busy:
            return
        if image is None:
            self._said = "no picture comes from that camera"
            return
        self._busy = True
        try:
            why = await asyncio.to_thread(views.take, image)
        finally:
            self._busy = False
        if views is self._views:  # else others have begun meanwhile
            self._said = f"not taken: {why}" if why else f"view {views.count} is taken"

    async def _calibrate(self) -> None:
        views, info = self._views, self._latest(self._info(self._images[self._camera]))
        if views is None or self._busy:
            return
        if info is None:
            raise ConfigError("Camera", self._camera, "does not say how its lens is")
        self._busy = True
        try:
            result = await asyncio.to_thread(views.calibrate, info)
        finally:
            self._busy = False
        if views is self._views:
            self._result = result
        self._console.tell(result.lines[0], "good" if result.good else "bad")
