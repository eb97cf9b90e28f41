"""Messages about control of page and arm, which every page shows."""

from collections.abc import Iterator
from typing import Any, cast

import pytest
import viser

from common.messages import MotionOwner
from page.access import CURRENT_SESSION, PageSession, Permissions
from page.console import ActionQueue
from page.main_panel import ControllerPanel, TaskPanel

FIRST, SECOND = (PageSession(n, f"10.0.0.{n}", frozenset({"look", "operate"})) for n in (1, 2))


def panel_of(gui: viser.GuiApi, owner: MotionOwner) -> tuple[TaskPanel, ActionQueue]:
    """Return a panel whose requests for ownership are all answered by the same owner."""
    async def own(_act: str, _over: bool) -> MotionOwner:
        return owner

    console: Any = ActionQueue(Permissions())
    console.permissions.enforced = True
    console.own, console.latest, console.acknowledged = own, lambda _topic: None, 0
    return TaskPanel(gui, console, cast(Any, None)), console


async def press(panel: TaskPanel, console: ActionQueue, session: PageSession, name: str) -> tuple[str, str]:
    """Press a button on a page; return the message that all pages show."""
    token = CURRENT_SESSION.set(session)
    action, _ = console._buttons[name]
    if (coroutine := action()) is not None:
        await coroutine
    CURRENT_SESSION.reset(token)
    return panel.note[1:]


@pytest.fixture(autouse=True)
def session() -> Iterator[None]:
    yield
    CURRENT_SESSION.set(None)


async def test_page_that_takes_control_is_named_on_every_page(gui: viser.GuiApi) -> None:
    panel, console = panel_of(gui, MotionOwner())
    for each in (FIRST, SECOND):
        assert console.permissions.allow(each, "any element that moves the arm") is (each is FIRST)
        assert await press(panel, console, each, "operate") == (f"{each} has control now", "good")
    assert await press(panel, console, SECOND, "leave") == (f"{SECOND} has no control to release", "bad")


@pytest.mark.parametrize(("owner", "kind"), [(f"page {FIRST.address}", "bad"), ("", "good")])
async def test_releasing_control_of_another_operator_is_an_error(gui: viser.GuiApi, owner: str, kind: str) -> None:
    panel, console = panel_of(gui, MotionOwner(owner=owner, kind="operator" if owner else "none", asked=bool(owner)))
    message, shown = await press(panel, console, SECOND, "give")
    assert shown == kind and message.startswith("This page has no control to release") is bool(owner)


async def test_controller_commands_need_the_role_operate(gui: viser.GuiApi) -> None:
    permissions = Permissions()
    permissions.enforced = True
    actions = ActionQueue(permissions)
    actions.put = lambda _action: None
    before = set(gui._gui_input_handle_from_uuid)
    ControllerPanel(gui, cast(Any, actions))
    (buttons,) = set(gui._gui_input_handle_from_uuid) - before
    allowed = {role: permissions.allow(PageSession(n, "10.0.0.5", frozenset({"look", role})), buttons)
               for n, role in enumerate(("look", "tune", "operate"))}
    assert allowed == {"look": False, "tune": False, "operate": True}
