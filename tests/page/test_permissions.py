"""Permissions of pages by role, and control by one page at a time."""

from collections.abc import Iterator

import pytest

from common.time_source import use_time_source
from page.access import LOG_INTERVAL, OPERATE_TIMEOUT, PageSession, Permission, Permissions
from security.page_tokens import ALL_ROLES

ELEMENTS: dict[str, Permission] = {"STOP": "stop", "Tab": "look", "Start": "operate", "Slider": "tune", "Take": "take"}


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def monotonic_ns(self) -> int:
        return round(self.now * 1e9)

    def wall_ns(self) -> int:
        return self.monotonic_ns()

    def token_hex(self, count: int) -> str:
        return "0" * 2 * count


class Page(Permissions):
    """Enforced permissions of `ELEMENTS` with a clock, log lines and denials."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.lines, self.denied = clock, list[str](), list[str]()
        super().__init__(self.lines.append)
        self.enforced, self.on_denied = True, self.denied.append
        for element, permission in ELEMENTS.items():
            self.require(element, permission, element)


@pytest.fixture
def page() -> Iterator[Page]:
    clock = Clock()
    with use_time_source(clock):
        yield Page(clock)


def session(number: int, *roles: str) -> PageSession:
    return PageSession(number, "10.0.0.5", frozenset({"look", *roles}))


def test_each_role_has_its_permissions_and_every_page_may_stop(page: Page) -> None:
    elements = ("STOP", "Tab", "Start", "Slider", "")  # "": the 3D scene
    allowed = {role: {each for each in elements if page.allow(session(n, role), each)}
               for n, role in enumerate(("look", "tune", "operate"))}
    assert allowed == {
        "look": {"STOP", "Tab"}, "tune": {"STOP", "Tab", "Slider"}, "operate": {"STOP", "Tab", "Start", ""}}
    assert "page 0 (look, 10.0.0.5) has no token for the role 'operate'" in page.denied
    assert [each for each in ("STOP", "Tab", "Start") if page.allow(None, each)] == ["STOP", "Tab"]


def test_one_page_has_control_until_it_closes_is_idle_or_another_takes_control(page: Page) -> None:
    first, second = (session(number, "operate") for number in (1, 2))
    assert page.operating_page == ""
    assert page.allow(first, "Start") and page.operating_page == str(first)
    assert not page.allow(second, "Start")
    assert page.denied == [f"{first} has control: press Take page control, or wait until it is released"]
    assert page.allow(second, "STOP") and page.operating_page == str(first)
    assert page.allow(second, "Take") and page.operating_page == str(second)
    assert not page.allow(first, "Start")
    page.clock.now = OPERATE_TIMEOUT + 1
    assert page.operating_page == "" and page.allow(first, "Start")
    page.remove(second)
    assert page.operating_page == str(first)
    page.remove(first)
    assert page.operating_page == "" and page.allow(second, "Start")
    assert f"{second} operates instead of {first}" in page.lines


def test_dragged_slider_is_logged_once_and_values_are_truncated(page: Page) -> None:
    operator = session(3, *ALL_ROLES)
    for value in range(5):
        page.allow(operator, "Slider", value)
    page.allow(operator, "STOP")
    page.clock.now = 2 * LOG_INTERVAL
    page.allow(operator, "Slider", "\x1b" + "x" * 1000)
    assert page.lines[:2] == ["page 3 (operate, tune, 10.0.0.5): Slider: 0", "page 3 (operate, tune, 10.0.0.5): STOP"]
    assert len(page.lines) == 3 and len(page.lines[2]) < 120 and "\x1b" not in page.lines[2]


def test_everything_is_allowed_without_tokens() -> None:
    log: list[str] = []
    permissions = Permissions(log.append)
    assert all(permissions.allow(None, element) for element in ("Start", "STOP", ""))
    assert not log and permissions.operating_page == ""
