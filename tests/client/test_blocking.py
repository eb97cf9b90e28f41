"""The client without `await`: an event loop in a thread, and Ctrl-C during a call."""

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

from common.client.blocking import Blocking, Cell, LoopThread, call
from common.errors import ZencellError

pytestmark = pytest.mark.timeout(30)


@pytest.fixture
def loop() -> Iterator[LoopThread]:
    made = LoopThread()
    yield made
    made.end()
    assert made.ended and not any(thread.name == "zencell" for thread in threading.enumerate())


class Fake:
    """Fake."""

    entered = left = ended = False

    def __init__(self) -> None:
        self.waiting = threading.Event()

    async def twice(self, value: int) -> int:
        """Return the double."""
        return 2 * value

    async def fails(self) -> None:
        raise ZencellError("always fails")

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

    async def forever(self) -> None:
        try:
            self.waiting.set()
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0.02)  # cleaning up takes time
            self.ended = True


def press_ctrl_c(when: threading.Event) -> None:
    """Interrupt the main thread a little after an event: there is none for its wait."""
    def interrupt() -> None:
        assert when.wait(10)
        time.sleep(0.05)
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    threading.Thread(target=interrupt).start()


def test_coroutine_methods_block_and_raise_their_errors(loop: LoopThread) -> None:
    fake = Blocking(loop, Fake())
    assert fake.twice(3) == 6 and fake.twice.__doc__ == "Return the double." and fake.__doc__ == "Fake."
    assert "twice" in dir(fake)
    with pytest.raises(ZencellError, match="always fails"):
        fake.fails()
    with pytest.raises(AttributeError):
        fake.thrice()


def test_async_for_becomes_for_and_is_closed_when_it_is_left(loop: LoopThread) -> None:
    fake = Fake()
    assert list(Blocking(loop, fake).count(3)) == [0, 1, 2]
    fake.left = False
    for _ in Blocking(loop, fake).count(100):
        break
    assert fake.left


def test_iterator_collected_on_the_loops_own_thread_does_not_block_it(loop: LoopThread) -> None:
    fake = Fake()
    held = {"numbers": Blocking(loop, fake).count(100)}
    next(held["numbers"])

    async def drop() -> None:
        held.clear()

    call(loop, drop)
    call(loop, asyncio.sleep, 0.01)
    assert fake.left


def test_async_with_becomes_with_also_with_an_error(loop: LoopThread) -> None:
    fake = Fake()
    with Blocking(loop, fake).block() as value:
        assert value == "inside" and fake.entered
    assert not fake.entered
    with pytest.raises(ValueError, match="inside"), Blocking(loop, fake).block():
        raise ValueError("inside")
    assert not fake.entered


@pytest.mark.parametrize("when", ["before", "as it is entered"])
def test_ctrl_c_while_a_block_is_entered_leaves_it(loop: LoopThread, monkeypatch, when: str) -> None:
    fake, wait = Fake(), loop.wait

    def interrupted(begin: Callable[[], Awaitable[object]]) -> None:
        monkeypatch.undo()
        wait(begin if when != "before" else functools.partial(cancelled, begin))
        raise KeyboardInterrupt

    async def cancelled(begin: Callable[[], Awaitable[object]]) -> None:
        entering = asyncio.ensure_future(begin())
        entering.cancel()
        await asyncio.wait({entering})

    block = Blocking(loop, fake).block()
    monkeypatch.setattr(loop, "wait", interrupted)
    with pytest.raises(KeyboardInterrupt), block:
        raise AssertionError("the block must not run")
    assert not fake.entered
    assert call(loop, fake.twice, 4) == 8, "the loop still works"


@pytest.mark.parametrize("busy", [False, True])
def test_ctrl_c_cancels_the_call_and_waits_for_its_end(loop: LoopThread, busy: bool) -> None:
    fake, started = Fake(), threading.Event()

    def block_loop() -> None:
        started.set()
        time.sleep(0.2)

    if busy:
        loop._loop.call_soon_threadsafe(block_loop)
    with pytest.raises(KeyboardInterrupt):  # on a busy machine it may come before the call
        press_ctrl_c(started if busy else fake.waiting)
        call(loop, fake.forever)
    assert fake.ended == fake.waiting.is_set() and (busy or fake.ended)
    assert call(loop, fake.twice, 4) == 8, "the loop still works"


@pytest.mark.parametrize("scheduled", [False, True])
def test_ctrl_c_as_a_call_is_scheduled_leaves_it_not_running(loop: LoopThread, monkeypatch, scheduled: bool) -> None:
    fake, schedule = Fake(), loop._loop.call_soon_threadsafe

    def interrupted(callback: Callable[[], object]) -> None:
        monkeypatch.undo()
        if scheduled:
            schedule(callback)
            assert fake.waiting.wait(10)
        raise KeyboardInterrupt

    monkeypatch.setattr(loop._loop, "call_soon_threadsafe", interrupted)
    with pytest.raises(KeyboardInterrupt):
        call(loop, fake.forever)
    assert fake.ended == scheduled == fake.waiting.is_set()


def test_call_in_another_thread_raises_when_the_cell_is_closed() -> None:
    loop, fake, errors = LoopThread(), Fake(), list[str]()

    def wait() -> None:
        try:
            call(loop, fake.forever)
        except ZencellError as error:
            errors.append(str(error))

    waiting = threading.Thread(target=wait)
    waiting.start()
    assert fake.waiting.wait(10)
    loop.end()
    waiting.join(10.0)
    assert errors == ["the cell was closed meanwhile"]
    with pytest.raises(ZencellError, match="was closed"):
        call(loop, fake.twice, 1)


def test_cell_that_is_not_open_says_so_and_can_be_inspected() -> None:
    cell = Cell("nowhere")
    for name in ("arm", "cameras", "listen"):
        with pytest.raises(ZencellError, match="is not joined"):
            getattr(cell, name)
    assert "arm" in repr(dir(cell)) or "camera" in dir(cell)
    cell.close()
    with pytest.raises(AttributeError):
        copy.copy(cell).__wrapped__  # noqa: B018
