"""What the pages are told of who operates and whose the motion is: one line, which all of them show."""

from __future__ import annotations

from typing import Any, cast

import pytest
import viser

from common.messages import MotionOwner
from page.console import ActionQueue
from page.main_panel import TaskPanel
from page.permissions import CURRENT_SESSION, PageSession, Permissions

FIRST, SECOND = (PageSession(n, f"10.0.0.{n}", frozenset({"look", "operate"})) for n in (1, 2))


class Owned(ActionQueue):
    """The motion is somebody's, whatever is asked for."""

    heard = 0

    def __init__(self, doors: Permissions, owner: MotionOwner) -> None:
        super().__init__(doors)
        self._owner = owner

    def latest(self, _topic: object) -> None:
        return None

    async def own(self, _act: str, _over: bool) -> MotionOwner:
        return self._owner


async def nothing() -> None:
    """Go nowhere."""


def panel_of(server: viser.ViserServer, owner: MotionOwner) -> TaskPanel:
    doors = Permissions()
    doors.guarded = True
    return TaskPanel(server.gui, cast(Any, Owned(doors, owner)), cast(Any, None), nothing)


async def test_who_takes_the_page_over_is_told_to_all_by_name(server: viser.ViserServer) -> None:
    panel = panel_of(server, MotionOwner())
    for visitor in (FIRST, SECOND):
        token = CURRENT_SESSION.set(visitor)
        assert panel._console.doors.admit(visitor, "anything of the arm") is (visitor is FIRST)
        panel._operate()
        assert panel.note[1:] == (f"{visitor} operates now", "good")
        CURRENT_SESSION.reset(token)
    token = CURRENT_SESSION.set(SECOND)
    panel._leave()
    assert panel.note[1:] == (f"{SECOND} does not operate", "bad")
    CURRENT_SESSION.reset(token)


@pytest.mark.parametrize(("owner", "kind"), [(f"page {FIRST.address}", "bad"), ("", "good")])
async def test_giving_back_what_another_has_is_no_success(server: viser.ViserServer, owner: str, kind: str) -> None:
    panel = panel_of(server, MotionOwner(owner=owner, kind="operator" if owner else "none", asked=bool(owner)))
    token = CURRENT_SESSION.set(SECOND)
    await panel._own("give")
    _, line, how = panel.note
    assert how == kind and line.startswith("Nothing to give back") is bool(owner)
    CURRENT_SESSION.reset(token)
