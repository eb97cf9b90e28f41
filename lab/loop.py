"""An event loop whose time passes only when everything that could be done by now was done."""

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

EPOCH_NS = 1_767_225_600_000_000_000  # what day it is when a simulation begins: 2026-01-01, UTC
LOOK_NS = 20_000  # a look at the clock within a call that computes stands for so much work [ns]
CALL_MEAN, CALL_MOST = 0.01, 0.5  # [s] a call beside the loop takes as long as is drawn, and its looks on top


class Deadlock(RuntimeError):
    """Everybody waits, and nothing will ever happen."""


class Incarnation:
    """What belongs together in a loop, such as one process of a cell; it can be cut off in the middle.

    Nothing of it runs then: no `finally`, no callback. `revive` lets it go on, so that it can be cleared away.
    """

    def __init__(self, name: str) -> None:
        """Begin to live."""
        self.name = name
        self.over = False
        self.turns = 0  # taken so far
        self.at_turn: tuple[int, Callable[[], None]] | None = None  # called in place of that turn
        self.left: list[tuple[Callable[..., object], tuple[object, ...], Context]] = []  # turns never taken


_life: ContextVar[Incarnation | None] = ContextVar("life", default=None)


def current_incarnation() -> Incarnation | None:
    """The life whose turn it is."""
    return _life.get()


def context_of(life: Incarnation) -> Context:
    """A context of its own for what belongs to a life; whatever is started in it does too."""
    context = Context()
    context.run(_life.set, life)
    return context


class _Numbered:
    """Has a hash that is the same in every process, so that sets of it are walked in the same order."""

    _number: int

    def __hash__(self) -> int:
        return self._number


class _Task(_Numbered, asyncio.Task[Any]):
    pass


class _Future(_Numbered, asyncio.Future[Any]):
    pass


class VirtualTimeLoop(base_events.BaseEventLoop):
    """A loop of one thread on a virtual clock, which begins at 0; the seed decides how long calls beside it take.

    What would run in another thread runs at once and in one go; its result comes after the time that it is said to
    have taken. The loop is also what everything takes its time and its ids from: a `common.sources.Sources`.
    """

    # Of asyncio's own loop, whose turns it takes:
    _ready: deque[Any]
    _scheduled: list[Any]  # when and timer: numbers are compared sooner than timers
    _timer_cancelled_count: int
    _stopping: bool

    def __init__(self, seed: int, *, shuffled: bool = False) -> None:
        """Begin at 0 s; shuffled, the lives take the turns that are due at once in an order of the seed's."""
        super().__init__()
        self._shuffle = Random(f"turns of {seed}").shuffle if shuffled else None  # a text: the same in every process
        self._now = 0.0
        self.stepped_ns = 0  # by which somebody set the system clock
        self._work_ns = 0  # done by the call that computes now
        self._computing = False
        self._ids = Random(f"ids of {seed}")  # a text: the same in every process
        self._calls = np.random.default_rng([seed, 2])
        self._numbers = count()
        self.set_task_factory(self._make_task)

    # --- time and ids -------------------------------------------------------------------------------------------------

    def time(self) -> float:
        """Virtual time since the loop was made [s]."""
        return self._now

    def monotonic_ns(self) -> int:
        """Virtual time [ns], which also passes with each look from within a call that computes."""
        if self._computing:
            self._work_ns += LOOK_NS
        return round(self._now * 1e9) + self._work_ns

    def host_ns(self) -> int:
        """Virtual time since the host was started [ns]."""
        return self.monotonic_ns()

    def wall_ns(self) -> int:
        """What the host takes for the time since the Unix epoch [ns]."""
        return EPOCH_NS + self.stepped_ns + self.monotonic_ns()

    def token_hex(self, count: int) -> str:
        """An id that the seed decides, of so many bytes."""
        return f"{self._ids.getrandbits(8 * count):0{2 * count}x}"

    # --- turns --------------------------------------------------------------------------------------------------------

    def _run_once(self) -> None:
        """Take all turns that are due; when there are none, let time pass up to the next one."""
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
                raise Deadlock(f"nothing will ever happen after {self._now:.3f} s")
            self._now = max(self._now, scheduled[0][0])
        while scheduled and scheduled[0][0] <= self._now:
            _, timer = heapq.heappop(scheduled)
            timer._scheduled = False
            if not timer._cancelled:
                ready.append(timer)
        if self._shuffle is not None and len(ready) > 1:
            self._shuffle_lives(self._shuffle)
        for _ in range(len(ready)):
            handle = ready.popleft()
            if not handle._cancelled:
                handle._run()

    def _shuffle_lives(self, shuffle: Callable[[list[Any]], None]) -> None:
        """Bring the turns that are ready into another order, in which each life's own keep theirs."""
        ready = self._ready
        lives = [handle._context.get(_life) for handle in ready]
        if lives.count(lives[0]) == len(lives):
            return
        turns: dict[Incarnation | None, list[Any]] = {}
        for life, handle in zip(lives, ready, strict=True):
            turns.setdefault(life, []).append(handle)
        for own in turns.values():
            own.reverse()
        shuffle(lives)
        ready.clear()
        ready.extend(turns[life].pop() for life in lives)

    def call_soon(
        self, callback: Callable[..., object], *args: object, context: Context | None = None
    ) -> events.Handle:
        """Take a turn of the life to which the context belongs, unless it is over."""
        if context is None:
            context = contextvars.copy_context()
        life = context.get(_life)
        handle = events.Handle(callback, args, self, context)
        if life is not None:
            if life.over:
                life.left.append((callback, args, context))
                return handle
            life.turns += 1
            if life.at_turn is not None and life.turns >= life.at_turn[0]:
                (_, instead), life.at_turn = life.at_turn, None
                self.call_soon(instead, context=Context())
        self._ready.append(handle)
        return handle

    call_soon_threadsafe = call_soon  # there are no threads

    def call_at(
        self, when: float, callback: Callable[..., object], *args: object, context: Context | None = None
    ) -> Any:
        """Take a turn at a time [s], unless the life is over by then."""
        timer: Any = events.TimerHandle(when, callback, args, self, context)
        life = timer._context.get(_life)
        if life is not None and life.over:
            return timer
        heapq.heappush(self._scheduled, (when, timer))
        timer._scheduled = True
        return timer

    def end(self, life: Incarnation) -> None:
        """Cut a life off: none of its turns is taken any more."""
        life.over = True
        for handle in [handle for handle in self._ready if handle._context.get(_life) is life]:
            if not handle._cancelled:
                life.left.append((handle._callback, handle._args, handle._context))
                handle.cancel()
        for timer in [timer for _, timer in self._scheduled if timer._context.get(_life) is life]:
            timer.cancel()

    def revive(self, life: Incarnation) -> None:
        """Let the turns be taken that were left, so that its tasks can be cancelled; its timers are gone."""
        life.over = False
        left, life.left = life.left, []
        for callback, args, context in left:
            self.call_soon(callback, *args, context=context)

    # --- calls that would run beside the loop -------------------------------------------------------------------------

    def run_in_executor(  # type: ignore[override]
        self, executor: object, func: Callable[..., Any], *args: Any
    ) -> asyncio.Future[Any]:
        """Call it now; the result comes after the time that it is said to have taken."""
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

    # --- the rest of what a loop is asked -----------------------------------------------------------------------------

    def create_future(self) -> asyncio.Future[Any]:
        """A future that is the same in every process."""
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
