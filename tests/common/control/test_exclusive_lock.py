"""Only one executor uses the state files of a cell: a second one is refused, and waits for one that is just ending."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

import pytest

from common.control import interlocks
from common.control.interlocks import exclusive_lock
from common.errors import ConfigError

HOLDER = """
import fcntl, sys
file = open(sys.argv[1], "w")
fcntl.flock(file, fcntl.LOCK_EX)
print("locked", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def record(tmp_path: Path) -> Path:
    return tmp_path / "state" / "panda.inhibits.json"


@pytest.fixture
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interlocks, "LOCK_TIMEOUT", 0.0)


async def test_second_executor_is_refused_in_one_line_that_names_the_first(record: Path, no_waiting: None) -> None:
    async with exclusive_lock(record, "executor of panda"):
        with pytest.raises(ConfigError, match=r"^ZENCELL_STATE: '.*/state' is in use by executor of panda, ") as caught:
            async with exclusive_lock(record, "another"):
                pass
        assert f"process {os.getpid()} on " in str(caught.value) and "\n" not in str(caught.value)
        async with exclusive_lock(record.with_name("ur5.inhibits.json"), "of another cell"):
            pass
    async with exclusive_lock(record, "another"):
        pass


async def test_second_executor_waits_for_one_that_is_just_ending(record: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entered, waits, sleep = asyncio.Event(), asyncio.Event(), asyncio.sleep

    async def second() -> None:
        async with exclusive_lock(record, "second"):
            entered.set()

    async def counted(seconds: float) -> None:
        waits.set()
        await sleep(seconds)

    monkeypatch.setattr(interlocks, "LOCK_TIMEOUT", 60.0)
    async with exclusive_lock(record, "first"):
        with monkeypatch.context() as patched:
            patched.setattr(interlocks.asyncio, "sleep", counted)
            waiting = asyncio.create_task(second())
            async with asyncio.timeout(20):
                await waits.wait()
        assert not entered.is_set()
    async with asyncio.timeout(20):
        await waiting
    assert entered.is_set()


async def test_killed_process_leaves_no_lock_behind(record: Path, no_waiting: None) -> None:
    record.parent.mkdir()
    lock = str(record.with_suffix(".lock"))
    pipe = asyncio.subprocess.PIPE
    other = await asyncio.create_subprocess_exec(sys.executable, "-c", HOLDER, lock, stdin=pipe, stdout=pipe)
    try:
        assert other.stdout is not None and await other.stdout.readline()
        with pytest.raises(ConfigError, match="is in use by another process"):
            async with exclusive_lock(record, "second"):
                pass
    finally:
        other.kill()
        await other.communicate()
    async with exclusive_lock(record, "second"):
        pass


@pytest.mark.parametrize("kind", ["a file for a folder", "a folder for the lock", "a link for the lock"])
async def test_lock_that_cannot_be_created_is_refused_in_one_line(record: Path, kind: str) -> None:
    if kind == "a file for a folder":
        record.parent.write_text("")
    else:
        record.parent.mkdir()
        lock = record.with_suffix(".lock")
        lock.mkdir() if kind == "a folder for the lock" else lock.symlink_to(record.parent / "elsewhere")
    with pytest.raises(ConfigError, match=r"ZENCELL_STATE: .* cannot be written \(.*\): stops") as caught:
        async with exclusive_lock(record, "me"):
            pass
    assert "\n" not in str(caught.value) and not (record.parent / "elsewhere").exists()
