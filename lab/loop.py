"""Event loop on virtual time: the clock advances only when no callback is ready."""

from __future__ import annotations

import asyncio
import contextvars
import heapq
from asyncio import base_events, events
from collections import deque
from collections.abc import Callable
from contextvars import Context, ContextVar
from itertools import count
from random import Random
from typing import Any

import numpy as np

EPOCH_NS = 1_767_225_600_000_000_000  # wall time at which a simulation starts: 2026-01-01, UTC
CLOCK_READ_NS = 20_000  # assumed work between two reads of the clock within a computing call [ns]
CALL_MEAN, CALL_MOST = 0.01, 0.5  # [s] random duration of a call in a thread, in addition to its clock reads


class Deadlock(RuntimeError):
    """Everything waits, and nothing is scheduled."""


class Incarnation:
    """One life of a process in the loop, from its start to its end; it can be cut off anywhere.

    Nothing of it runs then: no `finally`, no callback. `revive` lets it run again, so that it can be cleaned up.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.over = False
        self.paused_until = 0.0  # nothing of it runs before this time of the loop [s]
        self.turns = 0  # callbacks run so far
        self.at_turn: tuple[int, Callable[[], None]] | None = None  # called instead of that callback
        self.skipped: list[tuple[Callable[..., object], tuple[object, ...], Context]] = []  # callbacks never run


_current: ContextVar[Incarnation | None] = ContextVar("incarnation", default=None)


def current_incarnation() -> Incarnation | None:
    """Return the incarnation whose callback runs."""
    return _current.get()


def context_of(incarnation: Incarnation) -> Context:
    """Return a new context; all tasks started in it belong to the incarnation."""
    context = Context()
    context.run(_current.set, incarnation)
    return context


class _Numbered:
    """Hashes to the same value in every process, so that sets iterate in the same order."""

    _number: int

    def __hash__(self) -> int:
        return self._number


class _Task(_Numbered, asyncio.Task[Any]):
    pass


class _Future(_Numbered, asyncio.Future[Any]):
    pass


class VirtualTimeLoop(base_events.BaseEventLoop):
    """Single-threaded loop on a virtual clock that starts at 0.

    A call for another thread runs at once and to its end; its result arrives after a random time drawn from the seed.
    The loop is also the source of all times and ids: a `common.time_source.TimeSource`.
    """

    # Of asyncio's own loop:
    _ready: deque[Any]
    _scheduled: list[Any]  # time and timer: comparing times is faster than comparing timers
    _timer_cancelled_count: int
    _stopping: bool

    def __init__(self, seed: int, *, shuffled: bool = False) -> None:
        """Start at 0 s.

        Args:
            seed: decides ids and the durations of calls in threads.
            shuffled: whether incarnations run their simultaneous callbacks in an order drawn from the seed.
        """
        super().__init__()
        self._shuffle = Random(f"turns of {seed}").shuffle if shuffled else None  # text: the same in every process
        self._now = 0.0
        self.stepped_ns = 0  # by which the system clock was set
        self._work_ns = 0  # of the computing call
        self._computing = False
        self._ids = Random(f"ids of {seed}")  # text: the same in every process
        self._calls = np.random.default_rng([seed, 2])
        self._numbers = count()
        self.set_task_factory(self._make_task)

    # --- time and ids -------------------------------------------------------------------------------------------------

    def time(self) -> float:
        """Return the virtual time since the loop was created [s]."""
        return self._now

    def monotonic_ns(self) -> int:
        """Return the virtual time [ns]; within a computing call each read advances it."""
        if self._computing:
            self._work_ns += CLOCK_READ_NS
        return round(self._now * 1e9) + self._work_ns

    def host_ns(self) -> int:
        """Return the virtual time since the host was started [ns]."""
        return self.monotonic_ns()

    def wall_ns(self) -> int:
        """Return the host's system time since the Unix epoch [ns]."""
        return EPOCH_NS + self.stepped_ns + self.monotonic_ns()

    def token_hex(self, count: int) -> str:
        """Return a random id of this many bytes, drawn from the seed."""
        return f"{self._ids.getrandbits(8 * count):0{2 * count}x}"

    # --- callbacks ----------------------------------------------------------------------------------------------------

    def _run_once(self) -> None:
        """Run all callbacks that are due; if there are none, advance time to the next one."""
        scheduled, ready = self._scheduled, self._ready
        if self._timer_cancelled_count > 100 + len(scheduled) // 2:
            scheduled[:] = [entry for entry in scheduled if not entry[1]._cancelled]
            heapq.heapify(scheduled)
            self._timer_cancelled_count = 0
        while scheduled and scheduled[0][1]._cancelled:
            self._timer_cancelled_count -= 1
            heapq.heappop(scheduled)
        if not ready and not self._stopping:
            if not scheduled:
                raise Deadlock(f"nothing is scheduled after {self._now:.3f} s")
            self._now = max(self._now, scheduled[0][0])
        while scheduled and scheduled[0][0] <= self._now:
            _, timer = heapq.heappop(scheduled)
            incarnation = timer._context.get(_current)
            if incarnation is not None and incarnation.paused_until > self._now:
                heapq.heappush(scheduled, (incarnation.paused_until, timer))
                continue
            timer._scheduled = False
            if not timer._cancelled:
                ready.append(timer)
        if self._shuffle is not None and len(ready) > 1:
            self._shuffle_ready(self._shuffle)
        for _ in range(len(ready)):
            handle = ready.popleft()
            if not handle._cancelled:
                handle._run()

    def _shuffle_ready(self, shuffle: Callable[[list[Any]], None]) -> None:
        """Interleave the ready callbacks of incarnations at random; those of each incarnation keep their order."""
        ready = self._ready
        owners = [handle._context.get(_current) for handle in ready]
        if owners.count(owners[0]) == len(owners):
            return
        handles: dict[Incarnation | None, list[Any]] = {}
        for owner, handle in zip(owners, ready, strict=True):
            handles.setdefault(owner, []).append(handle)
        for own in handles.values():
            own.reverse()
        shuffle(owners)
        ready.clear()
        ready.extend(handles[owner].pop() for owner in owners)

    def call_soon(
        self, callback: Callable[..., object], *args: object, context: Context | None = None
    ) -> events.Handle:
        """Schedule a callback, unless the incarnation of its context is over."""
        if context is None:
            context = contextvars.copy_context()
        incarnation = context.get(_current)
        handle = events.Handle(callback, args, self, context)
        if incarnation is not None:
            if incarnation.over:
                incarnation.skipped.append((callback, args, context))
                return handle
            incarnation.turns += 1
            if incarnation.at_turn is not None and incarnation.turns >= incarnation.at_turn[0]:
                (_, instead), incarnation.at_turn = incarnation.at_turn, None
                self.call_soon(instead, context=Context())
        self._ready.append(handle)
        return handle

    call_soon_threadsafe = call_soon  # there are no threads

    def call_at(
        self, when: float, callback: Callable[..., object], *args: object, context: Context | None = None
    ) -> Any:
        """Schedule a callback at a time [s], unless the incarnation of its context is over by then."""
        timer: Any = events.TimerHandle(when, callback, args, self, context)
        incarnation = timer._context.get(_current)
        if incarnation is not None and incarnation.over:
            return timer
        heapq.heappush(self._scheduled, (when, timer))
        timer._scheduled = True
        return timer

    def end(self, incarnation: Incarnation) -> None:
        """Cut an incarnation off: none of its callbacks runs any more."""
        incarnation.over = True
        for handle in [handle for handle in self._ready if handle._context.get(_current) is incarnation]:
            if not handle._cancelled:
                incarnation.skipped.append((handle._callback, handle._args, handle._context))
                handle.cancel()
        for timer in [timer for _, timer in self._scheduled if timer._context.get(_current) is incarnation]:
            timer.cancel()

    def revive(self, incarnation: Incarnation) -> None:
        """Run the skipped callbacks, so that its tasks can be cancelled; its timers are gone."""
        incarnation.over = False
        skipped, incarnation.skipped = incarnation.skipped, []
        for callback, args, context in skipped:
            self.call_soon(callback, *args, context=context)

    # --- calls in threads ---------------------------------------------------------------------------------------------

    def run_in_executor(  # type: ignore[override]
        self, executor: object, func: Callable[..., Any], *args: Any
    ) -> asyncio.Future[Any]:
        """Call the function now; its result arrives after a random time."""
        future = self.create_future()
        before, self._computing, self._work_ns = self._computing, True, 0
        try:
            result = func(*args)
        except Exception as error:
            settle: Callable[[Any], None] = future.set_exception
            outcome: Any = error
        else:
            settle, outcome = future.set_result, result
        finally:
            took, self._computing, self._work_ns = self._work_ns * 1e-9, before, 0
        took += min(CALL_MOST, float(self._calls.exponential(CALL_MEAN)))
        self.call_later(took, lambda: None if future.done() else settle(outcome))
        return future

    # --- the rest of the loop interface -------------------------------------------------------------------------------

    def create_future(self) -> asyncio.Future[Any]:
        """Return a future whose hash is the same in every process."""
        future = _Future(loop=self)
        future._number = next(self._numbers)
        return future

    @staticmethod
    def _make_task(loop: Any, coroutine: Any, **kwargs: Any) -> asyncio.Task[Any]:
        task = _Task.__new__(_Task)
        task._number = next(loop._numbers)
        task.__init__(coroutine, loop=loop, **kwargs)  # type: ignore[misc]
        return task

    def _process_events(self, event_list: list[Any]) -> None:
        pass

    def _write_to_self(self) -> None:
        pass
