"""The same `Cell` without `await`, for scripts and notebooks: each call returns when it is done.

A thread runs the event loop, so this also works where a loop already runs, as in a notebook. Awaited methods are called
instead, `async with` becomes `with`, `async for` becomes `for`; `cell.param["path"] = 3` changes a parameter.
"""

from __future__ import annotations

import asyncio
import atexit
import concurrent.futures
import contextlib
import functools
import inspect
import os
import threading
import weakref
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from typing import Any, TypeVar

from common.client import arm, cell, io, parameters, scene, several_arms, subscriptions, task
from common.errors import ZencellError
from common.transport.zenoh_session import Forked

T = TypeVar("T")

END_TIMEOUT = 5.0  # [s] for pending calls to end
WRAPPED = (arm.Arm, arm.Gripper, subscriptions.Camera, parameters.Parameters, task.TaskControl, scene.Scene,
           scene.World, io.Signals, several_arms.Arms, cell.Cell)


class LoopThread:
    """An event loop in a thread.

    Not anyio's blocking portal: its `call` leaves the coroutine running after Ctrl-C, and a motion must stop.
    """

    def __init__(self) -> None:
        """Start the thread."""
        self.ended = False
        self._process = os.getpid()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="zencell", daemon=True)
        self._thread.start()

    def wait(self, begin: Callable[[], Awaitable[T]]) -> T:
        """Run a coroutine on the loop and return its result. Ctrl-C cancels it, waits for its end, and is raised."""
        if self._process != os.getpid():
            raise Forked
        if self.ended:
            raise ZencellError("the cell was closed")
        done: concurrent.futures.Future[T] = concurrent.futures.Future()
        tasks: list[asyncio.Future[T]] = []

        def settle(task: asyncio.Future[T]) -> None:
            if task.cancelled():
                done.set_exception(ZencellError("the cell was closed meanwhile"))
            elif (error := task.exception()) is not None:
                done.set_exception(error)
            else:
                done.set_result(task.result())

        def start() -> None:
            tasks.append(task := asyncio.ensure_future(begin()))
            task.add_done_callback(settle)

        def cancel() -> None:
            if tasks:
                tasks[0].cancel()
            else:  # interrupted before it was scheduled
                done.set_exception(ZencellError("the call was interrupted"))

        try:
            self._loop.call_soon_threadsafe(start)
            return done.result()
        except KeyboardInterrupt:
            self._loop.call_soon_threadsafe(cancel)
            concurrent.futures.wait([done])
            raise

    @property
    def is_current(self) -> bool:
        """Whether this is called on the loop's own thread, which must not wait for the loop."""
        return threading.current_thread() is self._thread

    def schedule(self, begin: Callable[[], Awaitable[object]]) -> None:
        """Run a coroutine on the loop without waiting for it."""
        self._loop.call_soon_threadsafe(lambda: asyncio.ensure_future(begin()))

    def end(self) -> None:
        """Cancel pending calls and end the thread."""
        if not self.ended and self._process == os.getpid():
            self.wait(self._cancel_all)
            self.ended = True
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
            self._loop.close()

    async def _cancel_all(self) -> None:
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for other in others:
            other.cancel()
        if others:
            await asyncio.wait(others, timeout=END_TIMEOUT)


class Blocking:
    """Wraps an object so that its coroutine methods block."""

    def __init__(self, loop: LoopThread, inner: Any) -> None:
        """Wrap an object whose coroutines run on a loop."""
        self.__dict__.update(_loop=loop, _inner=inner, __doc__=inner.__doc__)

    def __repr__(self) -> str:
        return f"<blocking {type(self._inner).__name__}>"

    def __dir__(self) -> list[str]:
        return dir(self._inner)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "_inner" not in self.__dict__:  # looked up by copy and pickle
            raise AttributeError(name)
        value = getattr(self._inner, name)
        if self._loop is None:
            raise ZencellError(f"cell.{name}: the cell {cell.NOT_JOINED}")
        return wrap(self._loop, value)

    def __setattr__(self, name: str, value: object) -> None:
        setattr(self._inner, name, value)

    def __getitem__(self, key: str) -> Any:
        return call(self._loop, self._inner.__getitem__, key)

    def __setitem__(self, key: str, value: object) -> None:
        call(self._loop, self._inner.set, key, value)

    def __iter__(self) -> Iterator[Any]:
        return iterate(self._loop, self._inner)


def wrap(loop: LoopThread, value: Any) -> Any:
    """Return parts of a cell and functions in their blocking form, and any other value as it is."""
    if isinstance(value, WRAPPED):
        return Blocking(loop, value)
    if inspect.ismethod(value) or inspect.isfunction(value):
        @functools.wraps(value)
        def blocking(*args: Any, **kwargs: Any) -> Any:
            return call(loop, value, *args, **kwargs)

        return blocking
    return value


def call(loop: LoopThread, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call a function on the loop, await its result if necessary, and return it in its blocking form."""

    async def work() -> Any:
        result = function(*args, **kwargs)
        return await result if inspect.isawaitable(result) else result

    result = loop.wait(work)
    if isinstance(result, contextlib.AbstractAsyncContextManager):
        return enter(loop, result)
    return iterate(loop, result) if hasattr(result, "__anext__") else wrap(loop, result)


def iterate(loop: LoopThread, messages: Any) -> Iterator[Any]:
    """Yield the items of an asynchronous iterator."""
    found: AsyncIterator[Any] = aiter(messages)
    try:
        while True:
            try:
                yield loop.wait(lambda: anext(found))
            except StopAsyncIteration:
                return
    finally:
        if (close := getattr(found, "aclose", None)) is not None and not loop.ended:
            (loop.schedule if loop.is_current else loop.wait)(close)  # garbage collection may run on the loop's thread


@contextlib.contextmanager
def enter(loop: LoopThread, block: contextlib.AbstractAsyncContextManager[Any]) -> Iterator[Any]:
    """Use an asynchronous context manager as a blocking one."""
    values: list[Any] = []

    async def enter_block() -> None:
        values.append(await block.__aenter__())

    try:
        loop.wait(enter_block)
    except KeyboardInterrupt:
        if values:  # it was entered when Ctrl-C came: release it
            loop.wait(functools.partial(block.__aexit__, None, None, None))
        raise
    try:
        yield wrap(loop, values[0])
    except BaseException as error:
        if not loop.wait(functools.partial(block.__aexit__, type(error), error, error.__traceback__)):
            raise
    else:
        loop.wait(functools.partial(block.__aexit__, None, None, None))


class Cell(Blocking):
    """A work cell with the methods of the asynchronous `Cell`. Use `with`, or `open` and `close`."""

    def __init__(self, name: str | None = None, **where: Any) -> None:
        """A running cell; for the arguments see `common.client.cell.Cell`."""
        self._hold(cell.Cell(name, **where))

    def _hold(self, inner: cell.Cell) -> None:
        self.__dict__.update(_inner=inner, _loop=None)

    @classmethod
    def start(cls, name: str, **how: Any) -> Cell:
        """Return a cell that is started when it is entered or opened, and ended when it is left or closed."""
        started = cls.__new__(cls)
        started._hold(cell.Cell.start(name, **how))
        return started

    def open(self) -> Cell:
        """Join the cell; it is closed at the latest when the program ends."""
        if self._loop is None:
            self.__dict__["_loop"] = loop = LoopThread()
            try:
                loop.wait(self._inner.__aenter__)
            except BaseException:
                self._leave()
                raise
            atexit.register(_close, weakref.ref(self))
        return self

    def close(self) -> None:
        """Leave the cell, and end it if it was started here."""
        if self._loop is not None:
            try:
                self._loop.wait(self._inner.__aexit__)
            finally:
                self._leave()

    def _leave(self) -> None:
        self._loop.end()
        self.__dict__["_loop"] = None

    def __enter__(self) -> Cell:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()


def _close(known: weakref.ref[Cell]) -> None:
    found = known()
    if found is not None:
        found.close()
