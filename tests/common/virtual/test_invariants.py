"""What the invariants make of goals that are asked for again."""

import pytest

from common.config import load_cell
from common.messages import (
    ExecuteRequest,
    GripperCommand,
    GripperState,
    JointGoal,
    JointTrajectory,
    MotionStatus,
    PlanRequest,
)
from common.virtual.invariants import Invariants
from common.virtual.process import Requests

MOTION = ExecuteRequest(id="a-1", trajectory=JointTrajectory(joint_names=["j"], points=[]))
FINGERS = GripperCommand(id="a-1", width=0.04)


@pytest.fixture
def seen():
    """What looks, and what it looks at."""
    requests = Requests()
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
