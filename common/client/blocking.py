"""The same `Cell` for scripts and notebooks that do not `await`: each call returns when it is done.

A thread of its own has the loop, so it works inside a loop that runs already, as in a notebook. What the asynchronous
one awaits is called, `async with` is `with`, `async for` is `for`; `cell.param["path"] = 3` changes a parameter.
"""

from __future__ import annotations

import asyncio
import atexit
import concurrent.futures
import contextlib
import functools
import inspect
import threading
import weakref
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from typing import Any, TypeVar

from common.client import arm, cell, parameters, scene, task
from common.client import subscriptions as hearing
from common.errors import ZencellError

T = TypeVar("T")

ENDS = 5.0  # [s] in which what was begun has ended
WRAPPED = (arm.Arm, arm.Gripper, hearing.Camera, parameters.Parameters, task.TaskControl, scene.Scene,
           cell.World)


class LoopThread:
    """A running loop in a thread of its own."""

    def __init__(self) -> None:
        """Begin it."""
        self.ended = False
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="zencell", daemon=True)
        self._thread.start()

    def wait(self, begin: Callable[[], Awaitable[T]]) -> T:
        """The result of what is begun on the loop. Ctrl-C cancels it, waits until it has ended, and is raised then."""
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

        self._loop.call_soon_threadsafe(start)
        try:
            return done.result()
        except KeyboardInterrupt:
            self._loop.call_soon_threadsafe(lambda: [task.cancel() for task in tasks])
            concurrent.futures.wait([done])
            raise

    @property
    def is_here(self) -> bool:
        """Whether this is the loop's own thread, which must not wait for it."""
        return threading.current_thread() is self._thread

    def soon(self, begin: Callable[[], Awaitable[object]]) -> None:
        """Begin something that nobody waits for."""
        self._loop.call_soon_threadsafe(lambda: asyncio.ensure_future(begin()))

    def end(self) -> None:
        """End it."""
        if not self.ended:
            self.wait(self._cancelled)
            self.ended = True
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
            self._loop.close()

    async def _cancelled(self) -> None:
        """Whoever still waits is told that there is nothing to wait for."""
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for other in others:
            other.cancel()
        if others:
            await asyncio.wait(others, timeout=ENDS)


class Blocking:
    """An object whose asynchronous methods are called without `await`."""

    def __init__(self, loop: LoopThread, inner: Any) -> None:
        """Stand for an object that lives on a loop."""
        self.__dict__.update(_loop=loop, _inner=inner, __doc__=inner.__doc__)

    def __repr__(self) -> str:
        return f"<blocking {type(self._inner).__name__}>"

    def __dir__(self) -> list[str]:
        return dir(self._inner)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "_inner" not in self.__dict__:  # what copies and pickles ask for
            raise AttributeError(name)
        value = getattr(self._inner, name)
        if self._loop is None:
            raise ZencellError(f"cell.{name}: the cell {cell.NOT_JOINED}")
        return given(self._loop, value)

    def __setattr__(self, name: str, value: object) -> None:
        setattr(self._inner, name, value)

    def __getitem__(self, key: str) -> Any:
        return called(self._loop, self._inner.__getitem__, key)

    def __setitem__(self, key: str, value: object) -> None:
        called(self._loop, self._inner.set, key, value)

    def __iter__(self) -> Iterator[Any]:
        return iterated(self._loop, self._inner)


def given(loop: LoopThread, value: Any) -> Any:
    """A value as who blocks can use it."""
    if isinstance(value, WRAPPED):
        return Blocking(loop, value)
    if inspect.ismethod(value) or inspect.isfunction(value):
        @functools.wraps(value)
        def call(*args: Any, **kwargs: Any) -> Any:
            return called(loop, value, *args, **kwargs)

        return call
    return value


def called(loop: LoopThread, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """What a function returns that is called on the loop, and awaited there if need be."""

    async def work() -> Any:
        result = function(*args, **kwargs)
        return await result if inspect.isawaitable(result) else result

    result = loop.wait(work)
    if isinstance(result, contextlib.AbstractAsyncContextManager):
        return entered(loop, result)
    return iterated(loop, result) if hasattr(result, "__anext__") else given(loop, result)


def iterated(loop: LoopThread, messages: Any) -> Iterator[Any]:
    """What comes of an asynchronous iterator."""
    found: AsyncIterator[Any] = aiter(messages)
    try:
        while True:
            try:
                yield loop.wait(lambda: anext(found))
            except StopAsyncIteration:
                return
    finally:
        if (close := getattr(found, "aclose", None)) is not None and not loop.ended:
            (loop.soon if loop.is_here else loop.wait)(close)  # here, where it is collected as garbage


@contextlib.contextmanager
def entered(loop: LoopThread, block: contextlib.AbstractAsyncContextManager[Any]) -> Iterator[Any]:
    """An asynchronous context as a plain one."""
    values: list[Any] = []

    async def enter() -> None:
        values.append(await block.__aenter__())

    try:
        loop.wait(enter)
    except KeyboardInterrupt:
        if values:  # it was entered as Ctrl-C came: what was taken is given back
            loop.wait(functools.partial(block.__aexit__, None, None, None))
        raise
    try:
        yield given(loop, values[0])
    except BaseException as error:
        if not loop.wait(functools.partial(block.__aexit__, type(error), error, error.__traceback__)):
            raise
    else:
        loop.wait(functools.partial(block.__aexit__, None, None, None))


class Cell(Blocking):
    """A work cell: as the asynchronous one, which says what there is. Use `with`, or `open` and `close`."""

    def __init__(self, name: str | None = None, **where: Any) -> None:
        """A cell that is up: see `common.client.cell.Cell`."""
        self._hold(cell.Cell(name, **where))

    def _hold(self, inner: cell.Cell) -> None:
        self.__dict__.update(_inner=inner, _loop=None)

    @classmethod
    def start(cls, name: str, **how: Any) -> Cell:
        """A cell that is brought up when it is entered or opened, and ended when it is left or closed."""
        made = cls.__new__(cls)
        made._hold(cell.Cell.start(name, **how))
        return made

    def open(self) -> Cell:
        """Join it; at the latest when the program ends it is closed."""
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
        """Leave it; what was started is ended."""
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
