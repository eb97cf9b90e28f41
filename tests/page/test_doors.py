"""Who may do what on the page, and who of several operates."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from common.time_source import use_time_source
from page.access import EVERYTHING
from page.doors import IDLE, QUIET, Doors, Need, Visitor


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def monotonic_ns(self) -> int:
        return round(self.now * 1e9)

    def wall_ns(self) -> int:
        return self.monotonic_ns()

    def token_hex(self, count: int) -> str:
        return "0" * 2 * count


class Rig:
    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.noted: list[str] = []
        self.told: list[str] = []
        self.doors = Doors(self.noted.append)
        self.doors.guarded, self.doors.refused = True, self.told.append
        parts: dict[str, Need] = {"STOP": "stop", "Tab": "look", "Start": "operate", "Knob": "tune", "Take": "take"}
        for part, need in parts.items():
            self.doors.need(part, need, part)


@pytest.fixture
def rig() -> Iterator[Rig]:
    clock = Clock()
    with use_time_source(clock):
        yield Rig(clock)


def visitor(number: int, *roles: str) -> Visitor:
    return Visitor(number, "10.0.0.5", frozenset({"look", *roles}))


def test_each_role_does_its_own_and_everybody_may_stop(rig: Rig) -> None:
    may = {role: {part for part in ("STOP", "Tab", "Start", "Knob", "") if rig.doors.admit(visitor(n, role), part)}
           for n, role in enumerate(("look", "tune", "operate"))}
    assert may == {"look": {"STOP", "Tab"}, "tune": {"STOP", "Tab", "Knob"}, "operate": {"STOP", "Tab", "Start", ""}}
    assert "page 0 (look, 10.0.0.5) has no token to operate" in rig.told
    assert [part for part in ("STOP", "Tab", "Start") if rig.doors.admit(None, part)] == ["STOP", "Tab"]


def test_one_at_a_time_operates_until_it_goes_is_idle_or_is_relieved(rig: Rig) -> None:
    doors, (first, second) = rig.doors, (visitor(number, "operate") for number in (1, 2))
    assert doors.operator == "" and doors.admit(first, "Start") and doors.operator == str(first)
    assert not doors.admit(second, "Start")
    assert rig.told == [f"{first} operates: Take over, or wait until that is given back"]
    assert doors.admit(second, "STOP") and doors.operator == str(first)
    assert doors.admit(second, "Take") and doors.operator == str(second) and not doors.admit(first, "Start")
    rig.clock.now = IDLE + 1
    assert doors.operator == "" and doors.admit(first, "Start")
    doors.leave(second)
    assert doors.operator == str(first)
    doors.leave(first)
    assert doors.operator == "" and doors.admit(second, "Start")
    assert f"{second} operates instead of {first}" in rig.noted


def test_who_did_what_is_noted_once_for_a_slider_on_its_way(rig: Rig) -> None:
    operator = visitor(3, *EVERYTHING)
    for value in range(5):
        rig.doors.admit(operator, "Knob", value)
    rig.doors.admit(operator, "STOP")
    rig.clock.now = 2 * QUIET
    rig.doors.admit(operator, "Knob", "\x1b" + "x" * 1000)
    assert rig.noted[:2] == ["page 3 (operate, tune, 10.0.0.5): Knob: 0", "page 3 (operate, tune, 10.0.0.5): STOP"]
    assert len(rig.noted) == 3 and len(rig.noted[2]) < 120 and "\x1b" not in rig.noted[2]


def test_where_no_token_is_asked_for_all_is_as_it_was() -> None:
    noted: list[str] = []
    doors = Doors(noted.append)
    assert all(doors.admit(None, part) for part in ("Start", "STOP", ""))
    assert not noted and doors.operator == ""
