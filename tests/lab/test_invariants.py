"""What the invariants make of goals that are asked for again, and of motion after a person's stop."""

import numpy as np
import pytest

from common.config import load_cell
from common.hardware.interface import Limits
from common.messages import (
    ExecuteRequest,
    GripperCommand,
    GripperState,
    HoldRequest,
    JointGoal,
    JointTrajectory,
    MotionStatus,
    PlanRequest,
    StopRequest,
    WorldObject,
    WorldObjects,
)
from common.transport.codec import encode
from common.transport.session import RawSample
from lab.invariants import ASKED, JUDGED, NEVER, Invariants, _Goals
from lab.loop import Incarnation, context_of
from lab.processes import RequestLog

MOTION = ExecuteRequest(id="a-1", trajectory=JointTrajectory(joint_names=["j"], points=[]))
FINGERS = GripperCommand(id="a-1", width=0.04)


@pytest.fixture
def seen():
    """What looks, and what it looks at."""
    requests = RequestLog()
    return Invariants(load_cell("panda"), requests, lambda: 1.0), requests


@pytest.mark.parametrize(("first", "again", "holds"), [
    ("active", "active", True), ("active", "succeeded", True), ("rejected", "rejected", True),
    ("active", "rejected", False), ("rejected", "active", False),
])
def test_who_asks_for_a_goal_again_hears_what_became_of_it(seen, first, again, holds):
    invariants, requests = seen
    for state in (first, again):
        requests.on_serve("executor 1", MOTION, MotionStatus(id="a-1", state=state))
        requests.on_serve("executor 1", FINGERS.model_copy(update={"id": "b-1"}), GripperState(id="b-1", state=state))
    assert (invariants.broken == []) == holds


def test_executor_that_was_started_again_knows_no_goals(seen):
    invariants, requests = seen
    requests.on_serve("executor 1", MOTION, MotionStatus(id="a-1", state="active"))
    requests.on_serve("executor 2", MOTION, MotionStatus(id="a-1", state="rejected"))
    assert invariants.broken == []


@pytest.mark.parametrize(("other", "holds"), [
    (MOTION, True), (MOTION.model_copy(), True), (FINGERS, False), (FINGERS.model_copy(update={"id": "a-2"}), True),
    (MOTION.model_copy(update={"trajectory": JointTrajectory(joint_names=["k"], points=[])}), False),
    (PlanRequest(id="a-1", goal=JointGoal(named="home")), False),
])
def test_an_id_stands_for_one_thing(seen, other, holds):
    invariants, requests = seen
    requests.on_ask("task", MOTION)
    requests.on_ask("task", other)
    assert (invariants.broken == []) == holds


@pytest.mark.parametrize("known", [False, True])
def test_goal_that_was_stopped_before_it_was_heard_of_never_moves(seen, known):
    invariants, requests = seen
    known_of = MotionStatus(id="a-1", state="active") if known else MotionStatus(id="a-1", error="unknown_goal")
    requests.on_serve("executor 1", StopRequest(id="a-1", by="requester"), known_of)
    moving = encode(MotionStatus(id="a-1", state="active"))
    invariants.on_put("executor", "executor 1", RawSample("panda/motion/status", moving, "application/msgpack", b""))
    assert invariants.broken == ([] if known else [f"1.000 s: {NEVER}: a-1"])


@pytest.mark.parametrize(("goal", "held", "holds"), [
    ("", True, True), ("", False, False), ("a-1", False, False), ("a-0", False, True),
])
def test_arm_is_held_for_whoever_asks_but_not_for_a_goal_that_is_over(seen, goal, held, holds):
    invariants, requests = seen
    request = HoldRequest(hold=True, reason="a mug is in the way", by="scene_monitor", goal=goal)
    requests.on_answer("motion_planner", request, MotionStatus(id="a-1", state="active", held=held))
    assert (invariants.broken == []) == holds


@pytest.mark.parametrize(("begun_later", "seconds", "holds"), [
    (False, 1.0, True), (False, 3.0, False), (True, 1.0, False),
])
def test_arm_that_a_person_stopped_brakes_and_rests_and_does_not_move_when_its_process_is_another(
    seen, begun_later, seconds, holds
):
    invariants, requests = seen
    limits = Limits(("j",), np.array([-3.0]), np.array([3.0]), np.array([1.0]), np.array([1.0]))
    stop = StopRequest(owner="anna")
    first = context_of(Incarnation("executor"))
    then = context_of(Incarnation("executor")) if begun_later else first

    def move(begin, count):
        q = np.array([0.5])
        for cycle in range(count):
            q = q + 1e-4
            invariants.on_set_point(limits, q, q, np.array([0.01]), begin + 0.01 * cycle)

    requests.on_ask("person", stop)
    first.run(requests.on_serve, "executor 1", stop, MotionStatus(id="a-1", state="active"))
    invariants._goals["panda/motion/status"] = _Goals("a-1", "executor 1")
    first.run(move, 0.0, 10)
    invariants._last = None
    then.run(move, seconds, 20)
    assert any(ASKED in line for line in invariants.broken) != holds


def test_application_judges_the_truth_when_its_task_says_done_and_not_before(tmp_path, monkeypatch):
    (tmp_path / "judging").mkdir()
    (tmp_path / "judging" / "task.py").write_text(
        "from common.messages import TaskStatus\nfrom common.topics import Topic\n"
        "from common.application import Application, ApplicationTopics\n"
        "STATUS = Topic('judging_status', TaskStatus, 'state', '')\n"
        "def misplaced(truth):\n    return ', '.join(thing.id for thing in truth.objects)\n"
        "APPLICATION = Application(topics=ApplicationTopics(status=STATUS), truth_check=misplaced)\n")
    monkeypatch.syspath_prepend(tmp_path)
    cell = load_cell("panda").model_copy(update={"application": "judging.task"})
    for state, broken in (("ERROR", False), ("DONE", True)):
        invariants = Invariants(cell, RequestLog(), lambda: 1.0)
        key, world = "panda/scene_objects", WorldObjects(objects=[WorldObject(id="thing", shape="box")])
        invariants.on_put("executor", "executor 1", RawSample(key, encode(world), "", None))
        invariants.on_end(0, state)
        assert [line.endswith(f"{JUDGED}: thing") for line in invariants.broken] == [True] * broken
    assert JUDGED not in Invariants(load_cell("panda"), RequestLog(), lambda: 1.0).checked
