"""Interlocks: who releases them, what persists, and a file that cannot be read or written."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.atomic_file import state_folder
from common.control.interlocks import (
    MAX_ENTRIES,
    MAX_GOALS,
    SLOWEST,
    InterlockFile,
    Interlocks,
    Record,
    Speed,
    effective_speed,
    interlock_file,
)
from common.errors import ConfigError
from common.messages import HoldRequest, MotionStatus, StopRequest

T0 = 1_700_000_000_000_000_000


def at(*times: int) -> Callable[[], int]:
    left = list(times)
    return lambda: left.pop(0) if len(left) > 1 else left[0]


def made(record: Record | None = None) -> Interlocks:
    return Interlocks(record, at(T0))


def held(interlocks: Interlocks) -> list[str]:
    return sorted(hold.by for hold in interlocks.holds)


def test_hold_is_released_only_by_its_owner_and_one_without_a_name_by_every_operator() -> None:
    interlocks = made()
    for owner in ("anna", "bert", ""):
        interlocks.hold(HoldRequest(hold=True, owner=owner, reason="lunch"))
    assert held(interlocks) == ["anna", "bert", "operator"]
    assert [gone.by for gone in interlocks.hold(HoldRequest(hold=False, owner="bert"))] == ["bert", "operator"]
    interlocks.hold(HoldRequest(hold=False))
    interlocks.hold(HoldRequest(hold=False, owner="bert", stops=True))
    assert held(interlocks) == ["anna"]
    assert [gone.by for gone in interlocks.hold(HoldRequest(hold=False, owner="bert", override=True))] == ["anna"]
    assert interlocks.all == []


def test_stop_is_released_by_a_start_of_any_operator_and_not_by_a_resume_of_its_owner() -> None:
    interlocks = made()
    interlocks.stop(StopRequest(owner="anna", reason="fire"))
    interlocks.hold(HoldRequest(hold=False, owner="anna"))
    refused = interlocks.check("a")
    assert refused is not None and refused.code == "stopped"
    assert str(refused) == "stopped since 2023-11-14 22:13:20 UTC by anna (fire)"
    interlocks.hold(HoldRequest(hold=False, owner="bert", stops=True))
    assert interlocks.check("a") is None


def test_request_decided_before_a_stop_neither_releases_it_nor_moves_the_arm() -> None:
    interlocks = made()
    interlocks.stop(StopRequest(owner="anna"))
    acknowledged = interlocks.stops[0].since
    assert interlocks.check("go there", "anna", acknowledged) is None, "the one who stopped it may move it"
    assert interlocks.check("go there", "bert", acknowledged) and interlocks.check("go there", "", acknowledged)
    interlocks.stop(StopRequest(owner="anna"))
    interlocks.hold(HoldRequest(hold=False, stops=True, override=True, acknowledged=acknowledged))
    assert interlocks.check("go there", "anna", acknowledged) and interlocks.check("go there", "anna")
    interlocks.hold(HoldRequest(hold=False, stops=True, acknowledged=interlocks.stops[0].since))
    assert interlocks.check("task") is None


def test_hold_turned_into_a_stop_still_blocks_all_others() -> None:
    interlocks = made()
    interlocks.hold(HoldRequest(hold=True, owner="anna"))
    since = interlocks.holds[0].since
    interlocks.hold(HoldRequest(hold=False, owner="anna", into_stop=True, acknowledged=since))
    assert not interlocks.holds and interlocks.check("task")
    assert interlocks.check("go there", "anna", since) is None


@given(times=st.lists(st.integers(0, 2 * T0), min_size=2, max_size=8))
def test_later_interlock_has_a_later_time_for_any_clock_also_after_a_restart(times: list[int]) -> None:
    interlocks, seen = Interlocks(None, at(*times)), []
    for number in range(len(times)):
        interlocks.stop(StopRequest(owner=f"{number % 3}"))
        seen.append(max(stop.since for stop in interlocks.stops))
        interlocks.hold(HoldRequest(hold=False, stops=True))
        interlocks = Interlocks(Record.model_validate_json(interlocks.record.model_dump_json()), at(*times[number:]))
    assert seen == sorted(set(seen))


def test_holds_of_watchdog_and_controller_do_not_persist() -> None:
    interlocks = made()
    interlocks.hold(HoldRequest(hold=True, by="watchdog", reason="no joint states"))
    interlocks.set_internal_hold("controller", True, "the task is gone")
    interlocks.hold(HoldRequest(hold=True, owner="watchdog"))
    assert [one.by for one in interlocks.all] == ["watchdog", "watchdog", "controller"]
    assert [one.by for one in made(interlocks.record).all] == ["watchdog"]
    interlocks.hold(HoldRequest(hold=False, by="watchdog"))
    assert held(interlocks) == ["watchdog"], "an operator of that name"


def test_stopped_goals_are_blocked_and_the_oldest_are_forgotten() -> None:
    interlocks = made()
    interlocks.block_goals(str(number) for number in range(MAX_GOALS + 5))
    again = made(interlocks.record)
    assert again.check("5") and again.check(str(MAX_GOALS + 4)) and not again.check("4")


def test_too_many_operators_share_an_entry_that_still_holds_the_robot() -> None:
    interlocks = made()
    for number in range(MAX_ENTRIES + 9):
        interlocks.hold(HoldRequest(hold=True, owner=f"{number}", reason="x" * 1000))
    assert len(interlocks.all) == MAX_ENTRIES + 1
    for number in range(MAX_ENTRIES + 9):
        interlocks.hold(HoldRequest(hold=False, owner=f"{number}"))
    assert held(interlocks) == ["others"]
    assert interlocks.hold(HoldRequest(hold=False, override=True)) and not interlocks.all


@pytest.mark.parametrize(("saved", "configured", "now"), [
    (None, 0.5, 0.5), (Speed(scaling=0.05, configured=1.0), 1.0, 0.05), (Speed(scaling=1.0, configured=0.2), 0.2, 1.0),
    (Speed(scaling=1.0, configured=1.0), 0.2, 0.2), (Speed(scaling=0.05, configured=1.0), 0.2, 0.05),
])
def test_saved_speed_applies_or_the_slower_one_if_another_was_configured_since(
    saved: Speed | None, configured: float, now: float
) -> None:
    assert effective_speed(saved, configured) == now


# --- the file ---


def test_saved_record_is_loaded_again(tmp_path: Path) -> None:
    interlocks = made()
    interlocks.stop(StopRequest(owner="anna", reason="fire"))
    interlocks.block_goals(["a"])
    interlocks.speed, interlocks.arm_stopped = Speed(scaling=0.05, configured=1.0), True
    file = interlock_file("panda", {"ZENCELL_STATE": str(tmp_path / "new" / "folder")})
    file.require_writable()
    assert file.load() == (Record(), "")
    file.save(interlocks.record)
    assert file.load() == (interlocks.record, "")


def test_truncated_new_file_leaves_the_record_before_it(tmp_path: Path) -> None:
    file, interlocks = InterlockFile(tmp_path / "r"), made()
    interlocks.stop(StopRequest(owner="anna"))
    file.save(interlocks.record)
    for size in (0, 10, 200):
        (tmp_path / "r.new").write_bytes((tmp_path / "r").read_bytes()[:size])
        assert file.load() == (interlocks.record, "")


class PowerCut(Exception):
    pass


def step_or_cut(steps: Iterator[int], step: Callable[..., Any], *args: Any, **named: Any) -> Any:
    if next(steps, None) is None:
        raise PowerCut
    return step(*args, **named)


@pytest.mark.parametrize("step", range(12))
def test_save_interrupted_at_any_step_leaves_one_of_both_records_and_room_for_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, full_disk: Callable[[], None], step: int
) -> None:
    file, interlocks = InterlockFile(tmp_path / "r"), made()
    file.require_writable()
    interlocks.stop(StopRequest(owner="anna"))
    file.save(interlocks.record)
    before = interlocks.record
    interlocks.stop(StopRequest(owner="bert"))
    steps = iter(range(step))
    with monkeypatch.context() as patched:
        for name in ("open", "write", "fsync", "unlink", "link", "replace"):
            patched.setattr(os, name, partial(step_or_cut, steps, getattr(os, name)))
        with suppress(PowerCut):
            file.save(interlocks.record)
    assert file.load() in ((before, ""), (interlocks.record, ""))
    full_disk()
    again = InterlockFile(tmp_path / "r")
    again.require_writable()
    again.save(interlocks.record)
    assert again.load() == (interlocks.record, "")


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Has no more room from the call on than the files have."""
    honest = os.write

    def write(descriptor: int, data: bytes) -> int:
        if os.lseek(descriptor, 0, os.SEEK_CUR) + len(data) > os.fstat(descriptor).st_size:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return honest(descriptor, data)

    return lambda: monkeypatch.setattr(os, "write", write)


def largest() -> Interlocks:
    interlocks = made()
    for number in range(MAX_ENTRIES + 1):
        interlocks.stop(StopRequest(owner=f"{number}".rjust(120, "\U0001f916"), reason="\U0001f916" * 300))
    interlocks.block_goals(f"{number}".rjust(120, "\U0001f916") for number in range(MAX_GOALS))
    interlocks.speed = Speed(scaling=1 / 3, configured=2 / 3)
    return interlocks


def test_disk_that_becomes_full_still_takes_any_record(
    tmp_path: Path, full_disk: Callable[[], None]
) -> None:
    file, interlocks = InterlockFile(tmp_path / "r"), made()
    file.require_writable()
    full_disk()
    for state in (largest(), interlocks, largest()):
        file.save(state.record)
        assert file.load() == (state.record, "")
    file.require_writable()
    assert file.load() == (largest().record, ""), "also for the next executor"
    assert {entry.name for entry in tmp_path.iterdir()} == {"r", "r.new"}


def test_short_file_of_an_earlier_version_is_loaded_and_enlarged(
    tmp_path: Path, full_disk: Callable[[], None]
) -> None:
    path, interlocks = tmp_path / "r", made()
    interlocks.stop(StopRequest(owner="anna"))
    path.write_text(interlocks.record.model_dump_json(indent=1))
    (tmp_path / "r.new").write_bytes(b"")
    file = InterlockFile(path)
    file.require_writable()
    assert file.load() == (interlocks.record, "")
    full_disk()
    file.save(largest().record)
    file.save(interlocks.record)
    assert file.load() == (interlocks.record, "")


@pytest.mark.parametrize("left", [(), ("r.new",), ("r",)])
def test_full_disk_at_the_start_is_refused_in_one_line(
    tmp_path: Path, full_disk: Callable[[], None], left: tuple[str, ...]
) -> None:
    for name in left:
        (tmp_path / name).write_text(Record().model_dump_json())
    full_disk()
    with pytest.raises(ConfigError, match=r"cannot be written \(No space left on device\): stops") as caught:
        InterlockFile(tmp_path / "r").require_writable()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["second name of the record", "link to another file", "pipe"])
def test_other_file_at_the_path_of_the_next_record_is_never_overwritten(tmp_path: Path, kind: str) -> None:
    file, other = InterlockFile(tmp_path / "r"), tmp_path / "other"
    file.save(largest().record)
    other.write_text("mine")
    new = tmp_path / "r.new"
    {"second name of the record": lambda: os.link(tmp_path / "r", new), "pipe": lambda: os.mkfifo(new),
     "link to another file": lambda: new.symlink_to(other)}[kind]()
    file.require_writable()
    assert file.load() == (largest().record, "") and other.read_text() == "mine"


def test_unreadable_file_stays_for_inspection_until_the_next_save(tmp_path: Path) -> None:
    path = tmp_path / "r"
    path.write_bytes(b"{")
    InterlockFile(path).require_writable()
    assert path.read_bytes() == b"{"


def test_only_unsaved_interlocks_say_that_they_are_not_on_disk() -> None:
    interlocks = made()
    interlocks.stop(StopRequest(owner="anna", reason="smoke"))
    saved = interlocks.record
    interlocks.stop(StopRequest(owner="bert", reason="fire"))
    interlocks.hold(HoldRequest(hold=True, by="watchdog", reason="no joint states"))
    interlocks.note_saved(saved, "No space left on device")
    status = MotionStatus(interlocks=interlocks.all)
    lost = "not saved on disk (No space left on device), lost if the executor ends"
    assert [one.reason for one in status.interlocks] == ["smoke", f"{lost}; fire", "no joint states"]
    assert status.unsaved.endswith(f"by bert ({lost}; fire)")
    assert interlocks.record.interlocks[1].reason == "fire"
    interlocks.note_saved(interlocks.record)
    assert not MotionStatus(interlocks=interlocks.all).unsaved


MANY = json.dumps({"interlocks": [{"kind": "held", "by": f"p{number}", "since": 1} for number in range(40)]}).encode()


@pytest.mark.parametrize("content", [
    b"", b"{", b"\xff" * 99, b'{"version": 2}', b'{"version": 1, "interlocks": [{}]}', MANY,
    b'{"newest": 9223372036854775807}', b'{"newest": -1}', b'{"newest": 1e30}',
    b'{"interlocks": [{"kind": "stopped", "by": "a", "since": 9223372036854775807}]}',
])
def test_unreadable_record_counts_as_a_stop_at_the_slowest_speed(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "r"
    path.write_bytes(content)
    record, problem = InterlockFile(path).load()
    assert problem.startswith(f"{path} cannot be read: ")
    interlocks = Interlocks(record)
    refused = interlocks.check("a")
    assert refused is not None and str(path) in str(refused) and effective_speed(interlocks.speed, 1.0) == SLOWEST
    assert interlocks.arm_stopped, "it may have been stopped"
    interlocks.hold(HoldRequest(hold=False, stops=True))
    assert interlocks.check("a") is None


@pytest.mark.parametrize("kind", ["link to nothing", "pipe", "folder", "link in a circle"])
def test_path_that_is_no_regular_file_counts_as_a_stop_and_does_not_block(
    tmp_path: Path, kind: str
) -> None:
    path = tmp_path / "r"
    {"link to nothing": lambda: path.symlink_to(tmp_path / "gone"), "pipe": lambda: os.mkfifo(path),
     "folder": path.mkdir, "link in a circle": lambda: path.symlink_to(path)}[kind]()
    record, problem = InterlockFile(path).load()
    assert problem.startswith(f"{path} cannot be read: ") and "\n" not in problem
    assert Interlocks(record).check("a")


def test_link_to_a_record_is_loaded(tmp_path: Path) -> None:
    interlocks = made()
    interlocks.stop(StopRequest(owner="anna"))
    InterlockFile(tmp_path / "there").save(interlocks.record)
    (tmp_path / "r").symlink_to(tmp_path / "there")
    assert InterlockFile(tmp_path / "r").load() == (interlocks.record, "")


def test_unwritable_folder_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(ConfigError, match=r"^ZENCELL_STATE: '.*' cannot be written \(.*\): stops") as caught:
            InterlockFile(folder / "r").require_writable()
        assert "\n" not in str(caught.value)


def test_folder_is_the_configured_one_or_one_in_the_home() -> None:
    assert state_folder({"ZENCELL_STATE": "/data", "XDG_STATE_HOME": "/x"}) == Path("/data")
    assert state_folder({"ZENCELL_STATE": "", "XDG_STATE_HOME": "/x"}) == Path("/x/zencell")
    assert state_folder({}) == Path.home() / ".local" / "state" / "zencell"
