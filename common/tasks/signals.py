"""Stages for digital and analog I/O, and how the engine works through them: docs/io.md."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from common import messages as m
from common.errors import ConfigError, UnknownName
from common.tasks.decisions import NOT_ITS_FAULT, TaskDecisions, V
from common.tasks.stages import Command, Cycle, Move, Stage

LOST = "io_lost"  # error of a request to set an output: the backend does not answer
LONGEST_COUNTED = 1.0  # [s] between two steps; a longer time is a pause


class Output(Stage):
    """Set an output. It ends once the output is read back."""

    def __init__(
        self, signal: str, value: bool | float = True, *, state: str = "", name: str = "", cycle: Cycle | None = None
    ) -> None:
        """Set `signal` to a value: true or false, or a number in the unit of an analog output."""
        super().__init__(name or f"set {signal}", state, cycle)
        self.signal, self.value = signal, value


class WaitFor(Stage):
    """Wait until a signal has a value. An analog signal has to be at least `above`, or at most `below`."""

    def __init__(
        self, signal: str, value: bool = True, timeout: float = 10.0, *, above: float | None = None,
        below: float | None = None, state: str = "", name: str = "", cycle: Cycle | None = None,
    ) -> None:
        """Wait for at most `timeout` of cell time [s]; time in which the arm is held does not count."""
        super().__init__(name or f"wait for {signal}", state, cycle)
        self.signal, self.value, self.timeout, self.above, self.below = signal, value, timeout, above, below

    @property
    def condition(self) -> str:
        """What it waits for, in words."""
        return condition_text(self.signal, self.value, self.above, self.below)

    def met(self, value: bool | float | None) -> bool:
        """Return whether a value ends the wait."""
        return condition_met(value, self.value, self.above, self.below)


def condition_text(signal: str, value: bool, above: float | None, below: float | None) -> str:
    """Return a condition in words, such as `pressure >= 5`."""
    limits = [f"{signal} {sign} {limit:g}" for sign, limit in ((">=", above), ("<=", below)) if limit is not None]
    return " and ".join(limits) or f"{signal} is {'on' if value else 'off'}"


def condition_met(current: bool | float | None, value: bool, above: float | None, below: float | None) -> bool:
    """Return whether the current value of a signal meets a condition; an unknown one does not."""
    if current is None:
        return False
    if above is None and below is None:
        return current is value
    return (above is None or current >= above) and (below is None or current <= below)


def check_condition(name: str, analog: bool, above: float | None, below: float | None) -> None:
    """Require limits for an analog signal, and none for a digital one.

    Raises:
        ConfigError: it is otherwise.
    """
    if analog != (above is not None or below is not None):
        raise ConfigError(name, ..., "is analog: wait for above=LEAST or below=LARGEST" if analog else
                          "is digital: wait for true or false, not above or below")


@dataclass(eq=False)
class SignalRun:
    """A started stage; times are cell time [s]."""

    stage: Output | WaitFor
    counted: float
    id: str = ""  # of the request that set the output
    reply: m.IoReply | None = None
    spent: float = 0.0


class SignalStages(TaskDecisions[V]):
    """Works through stages for I/O at the front of the queue. While the backend is lost they wait."""

    _signal: SignalRun | None = None

    def signal_failed(self, stage: Stage, view: V, problem: str) -> None:
        """Handle a signal that did not change in time, or an output that cannot be set: end with ERROR."""
        self.end("ERROR", problem)

    def unmet(self, requires: Mapping[str, bool], view: V) -> str:
        """Return why the signals that a motion requires do not have their values; empty if they do."""
        for name, value in requires.items():
            if problem := self._signal_problem(name, view):
                return problem
            if view.signal(name) is not value:
                return f"{name} is {'off' if value else 'on'}"
        return ""

    def blocked(self, view: V) -> str:
        """Return why the running motion must not continue: a signal that it requires; empty if it may."""
        stage = self.running.stage if self.running is not None else None
        return self.unmet(stage.requires, view) if isinstance(stage, Move) else ""

    def _may_use(self, move: Move, view: V) -> bool:
        """Return whether the signals that a motion requires let it start; the status reports what is missing."""
        waits, why = f"{move.name} waits: ", self.unmet(move.requires, view)
        if why or self.status.message.startswith(waits):
            self.status.message = f"{waits}{why}" if why else ""
        return not why

    def _signal_problem(self, name: str, view: V) -> str:
        return view.io.problem(name) if view.io is not None else "the I/O service does not answer"

    def on_output(self, reply: m.IoReply, view: V) -> None:
        """Handle the answer to a request to set an output."""
        run = self._signal
        if run is None or not run.id or run.id != reply.id:
            return
        if not reply.error:
            run.reply = reply
            return
        run.id = ""  # is sent again while the stage is at the front
        if reply.error == LOST:
            return
        self._signal = None
        problem = f"{run.stage.name} was refused: {reply.message}"
        if reply.error not in NOT_ITS_FAULT:
            self.signal_failed(run.stage, view, problem)
            return
        self.clear()
        self.status.message = problem

    def _run_signal(self, stage: Output | WaitFor, view: V) -> Iterator[Command]:
        """Start the stage at the front of the queue, or end it."""
        if (run := self._signal) is None or run.stage is not stage:
            try:
                self._check_signal(stage)
            except (UnknownName, ConfigError) as error:
                self.end("ERROR", str(error))
                return
            run = self._signal = SignalRun(stage, view.now)
            self.status.stage, self.status.state = stage.name, stage.state or self.status.state
            self.status.subject = stage.cycle.subject if stage.cycle else ""
        passed, run.counted = view.now - run.counted, view.now
        waits, problem = f"{stage.name} waits: ", self._signal_problem(stage.signal, view)
        if problem:
            self.status.message = f"{waits}{problem}"
            return
        if self.status.message.startswith(waits):
            self.status.message = ""
        run.spent += passed if passed < LONGEST_COUNTED else 0.0
        if isinstance(stage, WaitFor):
            if stage.met(view.signal(stage.signal)):
                self._finish_signal(stage, view)
            elif run.spent > stage.timeout:
                self._signal = None
                self.signal_failed(stage, view, f"{stage.condition} was not seen within {stage.timeout:g} s")
        elif not run.id:
            run.id = self.new_id()
            yield m.IoSet(id=run.id, signal=stage.signal, value=stage.value)
        elif run.reply is not None and _includes(view.io, run.reply):
            self._finish_signal(stage, view)

    def _check_signal(self, stage: Output | WaitFor) -> None:
        signal = self.p.io.find(stage.signal, output=isinstance(stage, Output))
        if isinstance(stage, Output):
            signal.checked(stage.signal, stage.value)
        else:
            check_condition(stage.signal, signal.range is not None, stage.above, stage.below)

    def _finish_signal(self, stage: Output | WaitFor, view: V) -> None:
        self.queue.popleft()
        self._signal = None
        if stage.cycle is not None:
            stage.cycle.started = True
        self.succeeded(stage, view)


def _includes(state: m.IoState | None, reply: m.IoReply) -> bool:
    """Return whether a state was read after the output was set: a wait that follows must not see an older one."""
    signal = state.find(reply.signal) if state is not None else None
    return signal is not None and (signal.value == reply.value or signal.stamp > reply.header.stamp)
