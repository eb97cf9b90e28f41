"""The panel of a hand-eye calibration: what was chosen when it began holds until another begins."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import viser

from common import topics
from common.config import load_cell
from common.viewer.console import Desk
from common.viewer.hand_eye_panel import HandEyePanel

LEFT, RIGHT = (replace(topics.CAMERA_IMAGE, key=f"{side}/image_raw") for side in ("left", "right"))


async def test_views_are_of_the_camera_with_which_they_were_begun(
    server: viser.ViserServer, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZENCELL_STATE", str(tmp_path))
    asked: list[str] = []
    console: Any = Desk()
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
