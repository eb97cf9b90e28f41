from __future__ import annotations

from typing import Any

import pytest

from common import messages as m
from common.config import Io
from common.tasks.decisions import TaskConfig
from common.tasks.engine import Task
from common.tasks.monitoring import LivenessWatchdog
from common.tasks.signals import Output, WaitFor
from common.tasks.stages import Move, View
from tests.common.tasks.engine_cell import CELL, THERE
from tests.common.tasks.engine_cell import Cell as EngineCell

IO = Io.model_validate({"signals": {
    "clamp": {"output": 0}, "closed": {"input": 0}, "valve": {"output": 0, "range": [0, 10]},
    "pressure": {"input": 0, "range": [0, 10]}, "door": {"input": 1}}})


class Cell(EngineCell):
    """The task double with signals, which the test changes; requests to set an output are answered by `reply`."""

    def __init__(self, *stages: Any) -> None:
        class Sequence(Task[View]):
            def decide(self, view: View) -> None:
                if not self.status.done:
                    self.queue += stages
                    self.status.done = 1
                elif self.status.state != "ERROR":
                    self.end("DONE")

        super().__init__(Sequence)
        self.task.p = TaskConfig(robot=CELL.robot, run=CELL.run, io=IO)
        self.values: dict[str, Any] = {"clamp": False, "closed": False, "valve": 0.0, "pressure": 0.0, "door": True}
        self.lost, self.refusal, self.answers = "", "", True

    @property
    def io(self) -> m.IoState:
        return m.IoState(header=self.header, reason=self.lost, signals=[
            m.IoSignal(name=name, direction="output" if IO.signals[name].is_output else "input", value=value)
            for name, value in self.values.items()])

    def view(self) -> View:
        view = super().view()
        view.io = self.io
        view.blocked = self.task.blocked(view)
        return view

    def answer(self, request: m.Message) -> None:
        super().answer(request)
        if isinstance(request, m.IoSet) and self.answers:
            if not self.refusal:
                self.values[request.signal] = request.value
            self.task.on_output(m.IoReply(header=self.header, id=request.id, signal=request.signal, value=request.value,
                                          error=self.refusal, message="no"), self.view())

    def ends(self, state: str, most: int) -> None:
        """Step until the task has ended in a state."""
        for _ in range(most):
            self.step()
            if self.status.state in ("DONE", "ERROR"):
                break
        assert self.status.state == state, self.status

    @property
    def sets(self) -> list[tuple[str, Any]]:
        return [(each.signal, each.value) for each in self.requests if isinstance(each, m.IoSet)]


def test_output_and_wait_end_one_after_the_other() -> None:
    cell = Cell(Output("clamp"), WaitFor("closed", timeout=2.0), Output("valve", 4.5), WaitFor("pressure", above=4.0))
    cell.steps(10)
    assert (cell.sets, cell.status.stage) == ([("clamp", True)], "wait for closed")
    cell.values["closed"] = True
    cell.steps(5)
    assert (cell.sets[1:], cell.status.stage) == ([("valve", 4.5)], "wait for pressure")
    cell.values["pressure"] = 4.0
    cell.ends("DONE", most=3)


def test_motion_after_a_wait_is_planned_meanwhile() -> None:
    cell = Cell(WaitFor("closed"), Move("reach", "REACHING", goal=THERE))
    cell.steps(3)
    assert cell.stages() == ["reach"] and not cell.running
    cell.values["closed"] = True
    cell.steps(2)
    assert cell.running or cell.stage == "reach"


@pytest.mark.parametrize(("stage", "words"), [
    (WaitFor("closed", timeout=0.5), "closed is on was not seen within 0.5 s"),
    (WaitFor("pressure", above=2.0, below=3.0, timeout=0.5), "pressure >= 2 and pressure <= 3 was not seen"),
    (WaitFor("clozed"), "unknown signal of the cell 'clozed' (did you mean 'closed'?); choices: clamp, closed"),
    (Output("closed"), "unknown output of the cell 'closed'"),
    (Output("valve", 11.0), "valve: 11.0 must be a number from 0 to 10"),
    (Output("clamp", 0.5), "clamp: 0.5 must be true or false"),
    (WaitFor("pressure"), "pressure: is analog: wait for above=LEAST or below=LARGEST"),
    (WaitFor("closed", above=1.0), "closed: is digital"),
])
def test_signal_that_does_not_change_or_fit_ends_the_task(stage: Any, words: str) -> None:
    cell = Cell(stage, Move("reach", "REACHING", goal=THERE))
    cell.ends("ERROR", most=12)
    assert words in cell.status.message
    assert not any(isinstance(each, m.ExecuteRequest | m.IoSet) for each in cell.requests)


def test_pause_does_not_count_as_waiting_and_a_lost_backend_delays_the_stage() -> None:
    cell = Cell(WaitFor("closed", timeout=1.0))
    cell.steps(5)
    cell.motion.held, cell.task.status.paused = True, True
    cell.steps(30)
    cell.motion.held, cell.task.status.paused = False, False
    cell.steps(3)
    cell.lost = "no answer within 1 s"
    cell.steps(30)
    assert cell.status.message == "wait for closed waits: no answer within 1 s"
    cell.lost = ""
    cell.steps(1)
    assert cell.status.message == ""
    cell.values["closed"] = True
    cell.ends("DONE", most=3)


def test_output_is_sent_again_when_the_backend_is_back_and_not_once_the_queue_is_cleared() -> None:
    cell = Cell(Output("clamp"))
    cell.refusal = "io_lost"
    cell.steps(1)
    cell.lost = "gone"
    cell.steps(5)
    assert cell.sets == [("clamp", True)]
    cell.lost, cell.refusal = "", ""
    cell.ends("DONE", most=4)
    assert cell.sets == [("clamp", True)] * 2

    stopped = Cell(Output("clamp"))
    stopped.answers = False
    stopped.steps(2)
    stopped.command("stop")
    stopped.steps(5)
    assert stopped.sets == [("clamp", True)] and not stopped.task.queue


@pytest.mark.parametrize(("error", "state"), [("not_owner", "DONE"), ("bad_value", "ERROR")])
def test_refusal_because_of_another_client_is_decided_again(error: str, state: str) -> None:
    cell = Cell(Output("clamp"))
    cell.refusal = error
    cell.ends(state, most=5)


def test_wait_after_an_output_does_not_see_the_state_before_it() -> None:
    cell = Cell(Output("clamp"), WaitFor("closed", False))
    cell.answers = False
    cell.steps(2)
    (request,) = [each for each in cell.requests if isinstance(each, m.IoSet)]
    reply = m.IoReply(header=cell.header, id=request.id, signal="clamp", value=True)
    cell.task.on_output(reply, cell.view())
    cell.steps(3)
    assert cell.status.state != "DONE", "the output is not in the state yet"
    cell.values.update(clamp=True, closed=True)
    cell.steps(3)
    assert cell.status.state != "DONE"
    cell.values["closed"] = False
    cell.ends("DONE", most=4)


def test_motion_that_requires_a_signal_does_not_start_and_is_held_without_it() -> None:
    cell = Cell(Move("reach", "REACHING", goal=THERE, requires={"door": True}))
    cell.values["door"] = False
    cell.steps(5)
    assert cell.stage == "" and cell.status.message == "reach waits: door is off"
    cell.values["door"] = True
    cell.steps(1)
    assert (cell.stage, cell.status.message) == ("reach", "")
    watchdog = LivenessWatchdog(lambda: 1, lambda: 1.0)
    seen = []
    for change in ({}, {"door": False}, {}, {"door": True}):
        cell.values.update(change)
        view = cell.view()
        seen.append([(each.hold, each.reason) for each in watchdog.update(0.0, {}, view.motion, view.blocked)])
    assert seen == [[], [(True, "door is off")], [], [(False, "what was missing is back")]]
    cell.lost = "no route to host"
    assert cell.view().blocked == "no route to host"
