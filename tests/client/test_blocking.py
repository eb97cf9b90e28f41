"""The client without `await`: a loop in a thread of its own, and what Ctrl-C does to what is waited for."""

from __future__ import annotations

import asyncio
import contextlib
import copy
import functools
import signal
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator

import pytest

from common.client.blocking import Blocking, Cell, LoopThread, called
from common.errors import ZencellError

pytestmark = pytest.mark.timeout(30)


@pytest.fixture
def loop() -> Iterator[LoopThread]:
    made = LoopThread()
    yield made
    made.end()
    assert made.ended and not any(thread.name == "zencell" for thread in threading.enumerate())


class Thing:
    """Says things."""

    async def twice(self, value: int) -> int:
        """Twice of it."""
        return 2 * value

    async def fails(self) -> None:
        raise ZencellError("as it has to")

    async def count(self, most: int) -> AsyncIterator[int]:
        try:
            for n in range(most):
                yield n
        finally:
            self.left = True

    @contextlib.asynccontextmanager
    async def block(self) -> AsyncIterator[str]:
        self.entered = True
        try:
            yield "inside"
        finally:
            self.entered = False

    async def for_ever(self) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0.05)  # something is still to be done
            self.ended = True


def test_what_is_awaited_is_called_and_its_errors_are_raised_where_it_was(loop: LoopThread) -> None:
    thing = Blocking(loop, Thing())
    assert thing.twice(3) == 6 and thing.twice.__doc__ == "Twice of it." and thing.__doc__ == "Says things."
    assert "twice" in dir(thing)
    with pytest.raises(ZencellError, match="as it has to"):
        thing.fails()
    with pytest.raises(AttributeError):
        thing.thrice()


def test_async_for_is_for_and_is_closed_when_it_is_left(loop: LoopThread) -> None:
    thing = Thing()
    assert list(Blocking(loop, thing).count(3)) == [0, 1, 2]
    thing.left = False
    for _ in Blocking(loop, thing).count(100):
        break
    assert thing.left


def test_async_with_is_with_also_when_it_ends_by_an_error(loop: LoopThread) -> None:
    thing = Thing()
    with Blocking(loop, thing).block() as value:
        assert value == "inside" and thing.entered
    assert not thing.entered
    with pytest.raises(ValueError, match="inside"), Blocking(loop, thing).block():
        raise ValueError("inside")
    assert not thing.entered


@pytest.mark.parametrize("when", ["before", "as it is entered"])
def test_ctrl_c_as_a_block_is_entered_leaves_it(loop: LoopThread, monkeypatch: pytest.MonkeyPatch, when: str) -> None:
    thing, wait = Thing(), loop.wait
    thing.entered = False

    def interrupted(begin: Callable[[], Awaitable[object]]) -> None:
        monkeypatch.undo()
        if when != "before":
            wait(begin)
        else:
            wait(functools.partial(cancelled, begin))
        raise KeyboardInterrupt

    async def cancelled(begin: Callable[[], Awaitable[object]]) -> None:
        entering = asyncio.ensure_future(begin())
        entering.cancel()
        await asyncio.wait({entering})

    block = Blocking(loop, thing).block()
    monkeypatch.setattr(loop, "wait", interrupted)
    with pytest.raises(KeyboardInterrupt), block:
        raise AssertionError("nothing is done in it")
    assert not thing.entered
    assert called(loop, thing.twice, 4) == 8, "and the loop goes on"


def test_ctrl_c_cancels_what_is_waited_for_and_waits_for_its_end(loop: LoopThread) -> None:
    thing = Thing()
    threading.Timer(0.2, lambda: signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        called(loop, thing.for_ever)
    assert thing.ended
    assert called(loop, thing.twice, 4) == 8, "and the loop goes on"


def test_ctrl_c_while_the_loop_is_busy_is_no_different(loop: LoopThread) -> None:
    thing = Thing()
    loop._loop.call_soon_threadsafe(time.sleep, 0.5)
    threading.Timer(0.1, lambda: signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        called(loop, thing.for_ever)
    assert called(loop, thing.twice, 4) == 8


def test_who_waits_in_another_thread_is_told_when_the_cell_is_closed() -> None:
    loop, told = LoopThread(), list[str]()

    def wait() -> None:
        try:
            called(loop, Thing().for_ever)
        except ZencellError as error:
            told.append(str(error))

    waiting = threading.Thread(target=wait)
    waiting.start()
    called(loop, asyncio.sleep, 0.05)
    loop.end()
    waiting.join(10.0)
    assert told == ["the cell was closed meanwhile"]
    with pytest.raises(ZencellError, match="was closed"):
        called(loop, Thing().twice, 1)


def test_an_iterator_that_is_collected_as_garbage_on_the_loops_own_thread_holds_nobody_up(loop: LoopThread) -> None:
    thing = Thing()
    kept = {"numbers": Blocking(loop, thing).count(100)}
    next(kept["numbers"])

    async def drop() -> None:
        kept.clear()

    called(loop, drop)
    called(loop, asyncio.sleep, 0.01)
    assert thing.left


def test_a_cell_that_is_not_open_says_so_and_can_be_looked_at() -> None:
    cell = Cell("nowhere")
    for name in ("arm", "cameras", "listen"):
        with pytest.raises(ZencellError, match="is not joined"):
            getattr(cell, name)
    assert "arm" in repr(dir(cell)) or "camera" in dir(cell)
    cell.close()
    with pytest.raises(AttributeError):
        copy.copy(cell).__wrapped__  # noqa: B018
