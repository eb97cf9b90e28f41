"""What page and summary show of a policy."""

from __future__ import annotations

from typing import Any

import pytest

from applications.policy.figures import PolicyFigures
from applications.policy.page import GIVE, TAKE, Controls, counters
from applications.policy.topics import POLICY_CONTROL, POLICY_STATUS, PolicyStatus
from common.messages import TaskStatus

STATUS = PolicyStatus(
    state="ACTING", chunks=9, proved=5, slowed=1, shortened=2, refused=2, violation="hand would touch wall")


class Fake:
    """The GUI and the console of a page."""

    def __init__(self) -> None:
        self.options, self.chosen, self.sent = (), None, []
        self.permissions = self
        self.client_name = "anna"

    def add_button_group(self, label: str, options: tuple[str, ...], hint: str) -> Any:
        self.options = options
        return self

    def on_choice(self, buttons: Any, action: Any) -> None:
        self.chosen = action

    async def call(self, request: Any, message: Any) -> None:
        self.sent.append((request, message.take, message.owner))


async def test_buttons_take_over_and_give_back() -> None:
    page: Any = Fake()
    controls = Controls(page, page)
    assert page.options == (TAKE,)
    await page.chosen(TAKE)
    controls.show(POLICY_STATUS, STATUS.model_copy(update={"control": "operator", "operator": "anna"}))
    assert page.options == (GIVE,)
    await page.chosen(GIVE)
    assert page.sent == [(POLICY_CONTROL, True, "anna"), (POLICY_CONTROL, False, "anna")]
    for status in (STATUS, STATUS.model_copy(update={"control": "operator", "operator": "bob"})):
        controls.show(POLICY_STATUS, status)
        assert page.options == (TAKE,)


@pytest.mark.parametrize(("update", "control"), [
    ({}, "policy"), ({"control": "operator"}, "operator"), ({"control": "operator", "operator": "anna"}, "anna")])
def test_counters_show_chunks_and_who_has_control(update: dict[str, str], control: str) -> None:
    shown = counters(STATUS.model_copy(update=update), 0)
    assert (shown["control"], shown["refused"], shown["last violation"]) == (control, 2, "hand would touch wall")
    assert counters(TaskStatus(), 0) == {}


def test_progress_and_headline_name_the_chunks() -> None:
    figures = PolicyFigures()
    assert figures.progress(STATUS) == "ACTING, 9 chunks, 2 refused"
    assert figures.progress(STATUS.model_copy(update={"control": "operator"})).endswith("the operator has control")
    summary = {"figures": {"chunks": 9, "proved": 5, "refused": 2}}
    assert figures.headline(summary) == "9 chunks: 5 proved, 0 slowed, 0 shortened, 2 refused"
