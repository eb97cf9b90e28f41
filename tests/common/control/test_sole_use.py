"""One at a time keeps a record: who is second is told of the first, and waits for one that ends."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

import pytest

from common.control import sole_use as module
from common.control.sole_use import sole_use
from common.errors import ConfigError

HOLDER = """
import fcntl, sys
file = open(sys.argv[1], "w")
fcntl.flock(file, fcntl.LOCK_EX)
print("has it", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def record(tmp_path: Path) -> Path:
    return tmp_path / "state" / "panda.inhibits.json"


async def test_second_is_refused_in_one_line_that_names_the_first(
    record: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "PATIENCE", 0.0)
    async with sole_use(record, "executor of panda"):
        with pytest.raises(ConfigError, match=r"^ZENCELL_STATE: '.*/state' is in use by executor of panda, ") as caught:
            async with sole_use(record, "another"):
                pass
        assert f"process {os.getpid()} on " in str(caught.value) and "\n" not in str(caught.value)
        async with sole_use(record.with_name("ur5.inhibits.json"), "of another cell"):
            pass
    async with sole_use(record, "another"):
        pass


async def test_who_ends_just_now_is_waited_for(record: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entered, looked_again = asyncio.Event(), asyncio.Event()
    asked, locked = [], module._locked

    def look(descriptor: int, folder: str) -> bool:
        asked.append(descriptor)
        if len(asked) == 4:  # the first one's, and three of who waits
            looked_again.set()
        return locked(descriptor, folder)

    monkeypatch.setattr(module, "_locked", look)
    monkeypatch.setattr(module, "PATIENCE", 60.0)

    async def second() -> None:
        async with sole_use(record, "second"):
            entered.set()

    async with sole_use(record, "first"):
        waiting = asyncio.create_task(second())
        async with asyncio.timeout(20):
            await looked_again.wait()
        assert not entered.is_set()
    async with asyncio.timeout(20):
        await waiting
    assert entered.is_set()


async def test_process_that_is_killed_leaves_no_lock_behind(record: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PATIENCE", 0.0)
    record.parent.mkdir()
    lock = str(record.with_suffix(".lock"))
    pipe = asyncio.subprocess.PIPE
    other = await asyncio.create_subprocess_exec(sys.executable, "-c", HOLDER, lock, stdin=pipe, stdout=pipe)
    try:
        assert other.stdout is not None and await other.stdout.readline()
        with pytest.raises(ConfigError, match="is in use by another process"):
            async with sole_use(record, "second"):
                pass
    finally:
        other.kill()
        await other.communicate()
    async with sole_use(record, "second"):
        pass


@pytest.mark.parametrize("kind", ["a file for a folder", "a folder for the lock", "a link for the lock"])
async def test_lock_that_cannot_be_had_is_refused_in_one_line(record: Path, kind: str) -> None:
    if kind == "a file for a folder":
        record.parent.write_text("")
    else:
        record.parent.mkdir()
        lock = record.with_suffix(".lock")
        lock.mkdir() if kind == "a folder for the lock" else lock.symlink_to(record.parent / "elsewhere")
    with pytest.raises(ConfigError, match=r"ZENCELL_STATE: .* cannot be written \(.*\): stops") as caught:
        async with sole_use(record, "me"):
            pass
    assert "\n" not in str(caught.value)
