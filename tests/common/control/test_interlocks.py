"""Interlocks: which requests release them, what persists, and a file that cannot be read or written."""

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
from common.messages.basics import MAX_STAMP

T0 = 1_700_000_000_000_000_000


class Made(Interlocks):
    """Interlocks on a fixed clock, with short requests."""

    def __init__(self, record: Record | None = None) -> None:
        super().__init__(record, lambda: T0)

    def stop_by(self, owner: str, reason: str = "") -> None:
        self.stop(StopRequest(owner=owner, reason=reason))

    def release(self, owner: str = "", **more: Any) -> list[str]:
        """Release holds, and known stops if requested; return whose."""
        if more.get("stops"):
            more.setdefault("acknowledged", self.record.newest)
        return [gone.by for gone in self.hold(HoldRequest(hold=False, owner=owner, **more))]

    @property
    def held(self) -> list[str]:
        return sorted(hold.by for hold in self.holds)


@pytest.fixture
def interlocks() -> Made:
    return Made()


@pytest.fixture
def stopped() -> Made:
    made = Made()
    made.stop_by("anna", "fire")
    return made


def test_hold_is_released_only_by_its_owner_and_one_without_a_name_by_every_operator(interlocks: Made) -> None:
    for owner in ("anna", "bert", ""):
        interlocks.hold(HoldRequest(hold=True, owner=owner, reason="lunch"))
    assert interlocks.held == ["anna", "bert", "operator"]
    assert interlocks.release("bert") == ["bert", "operator"]
    interlocks.release()
    interlocks.release("bert", stops=True)
    assert interlocks.held == ["anna"]
    assert interlocks.release("bert", override=True) == ["anna"] and interlocks.all == []


def test_stop_is_released_by_a_start_of_any_operator_and_not_by_a_resume_of_its_owner(stopped: Made) -> None:
    stopped.release("anna")
    refused = stopped.check("a")
    assert refused is not None and refused.code == "stopped"
    assert str(refused) == "stopped since 2023-11-14 22:13:20 UTC by anna (fire)"
    stopped.release("bert", stops=True)
    assert stopped.check("a") is None


def test_request_decided_before_a_stop_neither_releases_it_nor_moves_the_arm(stopped: Made) -> None:
    acknowledged = stopped.stops[0].since
    assert stopped.check("go there", "anna", acknowledged) is None, "the one who stopped it may move it"
    assert stopped.check("go there", "bert", acknowledged) and stopped.check("go there", "", acknowledged)
    stopped.stop_by("anna")
    stopped.release(stops=True, override=True, acknowledged=acknowledged)
    assert stopped.check("go there", "anna", acknowledged) and stopped.check("go there", "anna")
    for unknown in (None, 0, T0 + 3600 * 10**9, MAX_STAMP):  # what the executor never published names no stop
        stopped.release("anna", stops=True, override=True, acknowledged=unknown)
        assert stopped.check("task"), unknown
    stopped.release(stops=True, acknowledged=stopped.stops[0].since)
    assert stopped.check("task") is None


def test_stop_in_the_entry_of_too_many_operators_blocks_an_operator_of_its_name(interlocks: Made) -> None:
    for number in range(MAX_ENTRIES + 1):
        interlocks.stop_by(f"{number}")
    refused = interlocks.check("go there", "others", interlocks.record.newest)
    assert refused is not None and "by others" in str(refused)


def test_hold_turned_into_a_stop_still_blocks_all_others(interlocks: Made) -> None:
    interlocks.hold(HoldRequest(hold=True, owner="anna"))
    since = interlocks.holds[0].since
    interlocks.release("anna", into_stop=True, acknowledged=since)
    assert not interlocks.holds and interlocks.check("task")
    assert interlocks.check("go there", "anna", since) is None


@given(times=st.lists(st.integers(0, 2 * T0), min_size=2, max_size=8))
def test_later_interlock_has_a_later_time_for_any_clock_also_after_a_restart(times: list[int]) -> None:
    clock = iter(times * 9)
    interlocks, seen = Interlocks(None, lambda: next(clock)), []
    for number in range(len(times)):
        interlocks.stop(StopRequest(owner=f"{number % 3}"))
        seen.append(max(stop.since for stop in interlocks.stops))
        interlocks.hold(HoldRequest(hold=False, stops=True, acknowledged=seen[-1]))
        saved = Record.model_validate_json(interlocks.record.model_dump_json())
        interlocks = Interlocks(saved, lambda: next(clock))
    assert seen == sorted(set(seen))


def test_holds_of_watchdog_and_controller_do_not_persist(interlocks: Made) -> None:
    interlocks.hold(HoldRequest(hold=True, by="watchdog", reason="no joint states"))
    interlocks.set_internal_hold("controller", True, "the task is gone")
    interlocks.hold(HoldRequest(hold=True, owner="watchdog"))
    assert [one.by for one in interlocks.all] == ["watchdog", "watchdog", "controller"]
    assert [one.by for one in Made(interlocks.record).all] == ["watchdog"]
    interlocks.release(by="watchdog")
    assert interlocks.held == ["watchdog"], "an operator of that name"


def test_record_stays_short_with_many_goals_and_operators(interlocks: Made) -> None:
    interlocks.block_goals(str(number) for number in range(MAX_GOALS + 5))
    again = Made(interlocks.record)
    assert again.check("5") and again.check(str(MAX_GOALS + 4)) and not again.check("4"), "it forgets the oldest"
    for number in range(MAX_ENTRIES + 9):
        interlocks.hold(HoldRequest(hold=True, owner=f"{number}", reason="x" * 1000))
    assert len(interlocks.all) == MAX_ENTRIES + 1
    for number in range(MAX_ENTRIES + 9):
        interlocks.release(f"{number}")
    assert interlocks.held == ["others"], "a shared entry still holds the robot"
    assert interlocks.release(override=True) and not interlocks.all



@pytest.mark.parametrize(("saved", "configured", "now"), [
    (None, 0.5, 0.5), (Speed(scaling=0.05, configured=1.0), 1.0, 0.05), (Speed(scaling=1.0, configured=0.2), 0.2, 1.0),
    (Speed(scaling=1.0, configured=1.0), 0.2, 0.2), (Speed(scaling=0.05, configured=1.0), 0.2, 0.05),
])
def test_saved_speed_applies_or_the_slower_one_if_another_was_configured_since(
    saved: Speed | None, configured: float, now: float
) -> None:
    assert effective_speed(saved, configured) == now


def test_only_unsaved_interlocks_say_that_they_are_not_on_disk(stopped: Made) -> None:
    saved = stopped.record
    stopped.stop_by("bert", "smoke")
    stopped.hold(HoldRequest(hold=True, by="watchdog", reason="no joint states"))
    stopped.note_saved(saved, "No space left on device")
    status = MotionStatus(interlocks=stopped.all)
    lost = "not saved on disk (No space left on device), lost if the executor ends"
    assert [one.reason for one in status.interlocks] == ["fire", f"{lost}; smoke", "no joint states"]
    assert status.unsaved.endswith(f"by bert ({lost}; smoke)")
    assert stopped.record.interlocks[1].reason == "smoke"
    stopped.note_saved(stopped.record)
    assert not MotionStatus(interlocks=stopped.all).unsaved


# --- the file ---


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "r"


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """From the call on the disk has only the room that the files have."""
    original = os.write

    def write(descriptor: int, data: bytes) -> int:
        if os.lseek(descriptor, 0, os.SEEK_CUR) + len(data) > os.fstat(descriptor).st_size:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return original(descriptor, data)

    return lambda: monkeypatch.setattr(os, "write", write)


@pytest.fixture(scope="module")
def largest() -> Record:
    made = Made()
    for number in range(MAX_ENTRIES + 1):
        made.stop_by(f"{number}".rjust(120, "\U0001f916"), "\U0001f916" * 300)
    made.block_goals(f"{number}".rjust(120, "\U0001f916") for number in range(MAX_GOALS))
    made.speed = Speed(scaling=1 / 3, configured=2 / 3)
    return made.record


def test_saved_record_is_loaded_again_also_through_a_link(tmp_path: Path, stopped: Made) -> None:
    stopped.block_goals(["a"])
    stopped.speed, stopped.arm_stopped = Speed(scaling=0.05, configured=1.0), True
    file = interlock_file("panda", environ={"ZENCELL_STATE": str(tmp_path / "new" / "folder")})
    file.require_writable()
    assert file.load() == (Record(), "")
    file.save(stopped.record)
    (tmp_path / "link").symlink_to(file.path)
    assert file.load() == InterlockFile(tmp_path / "link").load() == (stopped.record, "")



class PowerCut(Exception):
    pass


def step_or_cut(steps: Iterator[int], step: Callable[..., Any], *args: Any, **named: Any) -> Any:
    if next(steps, None) is None:
        raise PowerCut
    return step(*args, **named)


@pytest.mark.parametrize("step", range(12))
def test_save_interrupted_at_any_step_leaves_one_of_both_records_and_room_for_the_next(
    path: Path, monkeypatch: pytest.MonkeyPatch, full_disk: Callable[[], None], stopped: Made, step: int
) -> None:
    file, before = InterlockFile(path), stopped.record
    file.require_writable()
    file.save(before)
    stopped.stop_by("bert")
    steps = iter(range(step))
    with monkeypatch.context() as patched, suppress(PowerCut):
        for name in ("open", "write", "fsync", "unlink", "link", "replace"):
            patched.setattr(os, name, partial(step_or_cut, steps, getattr(os, name)))
        file.save(stopped.record)
    assert file.load() in ((before, ""), (stopped.record, ""))
    full_disk()
    again = InterlockFile(path)
    again.require_writable()
    again.save(stopped.record)
    assert again.load() == (stopped.record, "")


@pytest.mark.parametrize("earlier", [False, True], ids=["new files", "short files of an earlier version"])
def test_disk_that_becomes_full_still_takes_any_record(
    path: Path, full_disk: Callable[[], None], stopped: Made, largest: Record, earlier: bool
) -> None:
    file = InterlockFile(path)
    if earlier:
        path.write_text(stopped.record.model_dump_json(indent=1))
        path.with_name("r.new").write_bytes(b"")
    file.require_writable()
    assert file.load() == (stopped.record if earlier else Record(), "")
    full_disk()
    for record in (largest, stopped.record, largest):
        file.save(record)
        assert file.load() == (record, "")
    file.require_writable()
    assert file.load() == (largest, ""), "also for the next executor"
    assert {entry.name for entry in path.parent.iterdir()} == {"r", "r.new"}



@pytest.mark.parametrize(("left", "folder", "reason"), [
    ([], "", "No space left on device"), (["r.new"], "", "No space left on device"),
    (["r"], "", "No space left on device"), (["file"], "file", ".*"), (["file"], "file/below", ".*"),
])
def test_file_that_cannot_be_written_at_the_start_is_refused_in_one_line(
    tmp_path: Path, full_disk: Callable[[], None], left: list[str], folder: str, reason: str
) -> None:
    for name in left:
        (tmp_path / name).write_text(Record().model_dump_json())
    full_disk()
    error = rf"^ZENCELL_STATE: '.*' cannot be written \({reason}\): stops"
    with pytest.raises(ConfigError, match=error) as caught:
        InterlockFile(tmp_path / folder / "r").require_writable()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["second name of the record", "link to another file", "pipe"])
def test_other_file_at_the_path_of_the_next_record_is_never_overwritten(path: Path, largest: Record, kind: str) -> None:
    file, new, other = InterlockFile(path), path.with_name("r.new"), path.with_name("other")
    file.save(largest)
    other.write_text("mine")
    {"second name of the record": lambda: os.link(path, new), "pipe": lambda: os.mkfifo(new),
     "link to another file": lambda: new.symlink_to(other)}[kind]()
    file.require_writable()
    assert file.load() == (largest, "") and other.read_text() == "mine"


MANY = json.dumps({"interlocks": [{"kind": "held", "by": f"p{number}", "since": 1} for number in range(40)]}).encode()


@pytest.mark.parametrize("content", [
    b"", b"{", b"\xff" * 99, b'{"version": 2}', b'{"version": 1, "interlocks": [{}]}', MANY,
    b'{"newest": 9223372036854775807}', b'{"newest": -1}', b'{"newest": 1e30}',
    b'{"interlocks": [{"kind": "stopped", "by": "a", "since": 9223372036854775807}]}',
    "link to nothing", "pipe", "folder", "link in a circle", "removed",
])
def test_unreadable_record_counts_as_a_stop_at_the_slowest_speed_and_does_not_block(
    path: Path, content: bytes | str
) -> None:
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        {"link to nothing": lambda: path.symlink_to(path.with_name("gone")), "pipe": lambda: os.mkfifo(path),
         "folder": path.mkdir, "link in a circle": lambda: path.symlink_to(path),
         "removed": lambda: (InterlockFile(path).require_writable(), path.unlink())}[content]()
    if isinstance(content, bytes):
        InterlockFile(path).require_writable()
        assert path.read_bytes() == content, "it stays for inspection"
    record, problem = InterlockFile(path).load()
    assert problem.startswith(f"{path} cannot be read: ") and "\n" not in problem
    interlocks = Interlocks(record)
    refused = interlocks.check("a")
    assert refused is not None and str(path) in str(refused) and effective_speed(interlocks.speed, 1.0) == SLOWEST
    assert interlocks.arm_stopped, "it may have been stopped"
    interlocks.hold(HoldRequest(hold=False, stops=True, acknowledged=record.newest))
    assert interlocks.check("a") is None



def test_folder_is_the_configured_one_or_one_in_the_home() -> None:
    assert state_folder({"ZENCELL_STATE": "/data", "XDG_STATE_HOME": "/x"}) == Path("/data")
    assert state_folder({"ZENCELL_STATE": "", "XDG_STATE_HOME": "/x"}) == Path("/x/zencell")
    assert state_folder({}) == Path.home() / ".local" / "state" / "zencell"


def test_interlocks_of_a_real_arm_belong_to_the_arm_whatever_its_cell_is_called(tmp_path: Path, stopped: Made) -> None:
    environ = {"ZENCELL_STATE": str(tmp_path)}
    interlock_file("a", environ=environ).save(stopped.record)  # as earlier versions did
    for cell in ("a", "b", "c"):
        assert interlock_file(cell, "ur-10.0.0.5", environ).read().interlocks == stopped.record.interlocks
    assert interlock_file("a", "ur-10.0.0.6", environ).find() is None
    assert interlock_file("a", "ur-../x", environ).path.parent == tmp_path


def test_no_flipped_bit_of_the_record_lifts_a_stop_or_raises_the_speed(tmp_path: Path, stopped: Made) -> None:
    stopped.speed = Speed(scaling=0.25, configured=1.0)
    file = InterlockFile(tmp_path / "r")
    file.save(stopped.record)
    text = file.path.read_bytes().rstrip()
    for position in range(len(text)):
        for bit in range(8):
            damaged = bytearray(text)
            damaged[position] ^= 1 << bit
            file.path.write_bytes(damaged)
            record, problem = file.load()
            assert problem or record == stopped.record, damaged.decode(errors="replace")
