"""Going through taught poses: one row, which a STOP between two of them ends."""

from __future__ import annotations

from typing import Any, cast

import pytest
import viser

from common.client.operator_motion import MotionFailed
from common.config import load_cell
from common.messages import Interlock, MotionStatus
from common.robot.model import RobotModel
from page.console import ActionQueue
from page.move_panel import MovePanel
from page.saved_poses import SavedPoses, save_taught, taught_file


class Motions:
    """Moves at once; a person presses STOP as it arrives for the first time."""

    def __init__(self) -> None:
        self.status, self.moved = MotionStatus(), 0

    async def require_free(self) -> MotionStatus:
        return self.status

    async def move(self, _goal: Any, *, planner: str = "", acknowledged: int | None = None) -> MotionStatus:
        if acknowledged is not None and self.status.newest > acknowledged:
            raise MotionFailed("stopped", "the motion was refused")
        self.moved += 1
        self.status = MotionStatus(interlocks=[Interlock(kind="stopped", by="anna", since=8)])
        return self.status


class Nowhere:
    """A scene without anything."""

    def __getattr__(self, _name: str) -> Any:
        return lambda *_: None


class Silent(ActionQueue):
    """A actions in a cell that says nothing."""

    def latest(self, _topic: Any) -> None:
        pass


async def test_stop_between_two_poses_ends_the_row(
    server: viser.ViserServer, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZENCELL_STATE", str(tmp_path))
    robot, motions, told = RobotModel.load(load_cell("ur5").robot), Motions(), []
    pose = dict.fromkeys(robot.joint_names, 0.1)
    save_taught(taught_file("cell"), SavedPoses(poses={"one": pose, "two": pose}))
    panel = MovePanel(
        server.gui, cast(Any, Silent()), motions, cast(Any, Nowhere()), robot, [], cell="cell", planner="",
        marker=False, tell=lambda line, kind: told.append((line, kind)))
    panel._taught._set_row("one, two")
    await panel._taught._go()
    assert motions.moved == 1
    assert told[-2:] == [("Going to two …", "busy"), ("the motion was refused", "bad")]
