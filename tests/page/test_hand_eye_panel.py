"""The panel of a hand-eye calibration: what was chosen when it began holds until another begins."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from threading import Event
from typing import Any, cast

import pytest
import viser
from page.hand_eye_panel import HandEyePanel

from common import topics
from common.config import load_cell
from page.console import ActionQueue
from page.hand_eye import Result

LEFT, RIGHT = (replace(topics.CAMERA_IMAGE, key=f"{side}/image_raw") for side in ("left", "right"))


async def test_views_are_of_the_camera_with_which_they_were_begun(
    server: viser.ViserServer, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZENCELL_STATE", str(tmp_path))
    asked: list[str] = []
    console: Any = ActionQueue()
    panel = HandEyePanel(server.gui, console, lambda topic: asked.append(topic.key), [LEFT, RIGHT],
                         load_cell("ur5").robot, on_listen=lambda: None)
    panel._set("name", "wrist")
    await panel._begin()
    panel._set("camera", RIGHT.key)
    assert [topic.key for topic in panel.wanted] == ["left/image_raw", "left/camera_info"]
    await panel._take()
    panel.follow(1.0)
    assert {key for key in asked if key.endswith("image_raw")} == {LEFT.key}
    await panel._begin()
    assert [topic.key for topic in panel.wanted] == ["right/image_raw", "right/camera_info"]
    panel._end()
    assert panel.wanted == []


async def test_result_and_last_picture_of_views_that_were_left_are_not_those_of_the_next(
    server: viser.ViserServer, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Taking a picture, and calibrating, take seconds: another calibration may have begun by then."""
    monkeypatch.setenv("ZENCELL_STATE", str(tmp_path))
    going_on, told = Event(), list[str]()

    class Slow:
        """Views that were begun before: they answer when the next have begun."""

        count = 9

        def take(self, _image: Any) -> str:
            assert going_on.wait(10)
            return "the arm moves"

        def calibrate(self, _info: Any) -> Result:
            assert going_on.wait(10)
            return Result(True, ["good: of before"])

    console: Any = ActionQueue()
    console.notify = lambda line, _kind="bad": told.append(line)
    panel = HandEyePanel(server.gui, console, lambda topic: topic, [LEFT], load_cell("ur5").robot,
                         on_listen=lambda: None)
    for act in (panel._take, panel._calibrate):
        going_on.clear()
        panel._views = cast(Any, Slow())
        doing = asyncio.create_task(act())
        await asyncio.sleep(0)
        panel._set("name", "next")
        await panel._begin()
        going_on.set()
        await doing
        assert panel._result is None and "the arm moves" not in panel._told()
    assert told[-1] == "good: of before"
