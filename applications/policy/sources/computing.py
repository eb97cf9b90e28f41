"""Run a function that may compute for long, or forever, without blocking the loop or the end of the process."""

from __future__ import annotations

import asyncio
import inspect
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any

from applications.policy.interface import PolicyFailed
from common import time_source


class _DaemonExecutor(Executor):
    """Runs each call in a daemon thread: unlike those of the standard library, it does not delay the process's end."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()

        def call() -> None:
            if future.set_running_or_notify_cancel():
                future.set_result(fn(*args, **kwargs))

        threading.Thread(target=call, name="policy", daemon=True).start()
        return future


class Computation:
    """Calls functions, one call at a time and each with a time limit: ordinary ones in a thread."""

    def __init__(self, name: str, timeout: float) -> None:
        """Name it for messages; a call may last `timeout` [s, wall time]."""
        self._name, self._timeout = name, timeout
        self._executor = _DaemonExecutor()
        self._busy_since: float | None = None

    async def call(self, function: Callable[..., Any], *args: Any) -> Any:
        """Return what the function returns, or raise its error.

        Raises:
            PolicyFailed: it did not return in time, or an earlier call still computes.
        """
        if self._busy_since is not None:
            raise PolicyFailed(f"{self._name} still computes since {time_source.monotonic() - self._busy_since:.1f} s")
        self._busy_since = time_source.monotonic()
        loop = asyncio.get_running_loop()
        asynchronous = inspect.iscoroutinefunction(function) or inspect.iscoroutinefunction(
            getattr(function, "__call__", None))  # noqa: B004 - of an object
        future: asyncio.Future[tuple[Any, Exception | None]] = (
            loop.create_task(_awaited(function, *args)) if asynchronous else
            loop.run_in_executor(self._executor, partial(_outcome, function, *args)))
        future.add_done_callback(self._end)
        try:
            await asyncio.wait({future}, timeout=self._timeout)
        finally:
            if asynchronous and not future.done():
                future.cancel()  # a thread cannot be cancelled: it stays busy
        if not future.done():
            raise PolicyFailed(f"{self._name} returned nothing within {self._timeout:g} s")
        result, error = future.result()
        if error is not None:
            raise error
        return result

    def _end(self, _: object) -> None:
        self._busy_since = None


async def _awaited(function: Callable[..., Any], *args: Any) -> tuple[Any, Exception | None]:
    try:
        return await function(*args), None
    except BaseException as error:
        return None, _ordinary(error)


def _outcome(function: Callable[..., Any], *args: Any) -> tuple[Any, Exception | None]:
    try:
        return function(*args), None
    except BaseException as error:
        return None, _ordinary(error)


def _ordinary(error: BaseException) -> Exception:
    """Return an error that can be raised in a coroutine; one that ends a process, task or iterator becomes another."""
    if isinstance(error, Exception) and not isinstance(error, StopIteration):
        return error
    return RuntimeError(f"{type(error).__name__}: {error}".removesuffix(": ")).with_traceback(error.__traceback__)
