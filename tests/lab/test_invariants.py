"""Invariants of a simulated cell: goals, motion after an operator's stop, objects of the ground truth."""

from pathlib import Path

import numpy as np
import pytest

from common import messages as m
from common.config import load_cell
from common.hardware.interface import Limits
from common.robot.model import RobotModel
from common.transport.codec import encode, encoding_of
from common.transport.session import RawSample
from lab.invariants import ACCEPTED, APART, OBJECTS, Invariants
from lab.loop import Incarnation, context_of
from lab.motion_invariants import LIMITS, NEVER, UNREQUESTED
from lab.processes import RequestLog

PANDA = load_cell("panda")
MOTION = m.ExecuteRequest(id="a-1", trajectory=m.JointTrajectory(joint_names=["j"], points=[]))
FINGERS = m.GripperCommand(id="a-1", width=0.04)
EDIT = m.WorldEdit(op="move", id="ball_1", position=m.Vector3(x=0.5))


@pytest.fixture
def requests():
    return RequestLog()


@pytest.fixture
def invariants(requests):
    return Invariants(PANDA, requests, lambda: 1.0)


def put(invariants, topic, message):
    sample = RawSample(f"panda/{topic}", encode(message), encoding_of(type(message)))
    invariants.on_put("executor", "executor 1", sample)


def put_objects(invariants, **positions):
    """Publish objects at x [m]; return whether a violation was found so far."""
    objects = [m.WorldObject(id=name, shape="sphere", pose=m.Pose(position=m.Vector3(x=x)), state="table")
               for name, x in positions.items()]
    put(invariants, "scene_objects", m.WorldObjects(objects=objects))
    return any(OBJECTS in line for line in invariants.broken)


@pytest.mark.parametrize(("instance", "first", "again", "holds"), [
    ("executor 1", "active", "active", True), ("executor 1", "active", "succeeded", True),
    ("executor 1", "rejected", "rejected", True), ("executor 1", "active", "rejected", False),
    ("executor 1", "rejected", "active", False),
    ("executor 2", "active", "rejected", True),  # a restarted executor does not know earlier goals
])
def test_repeated_goal_request_gets_the_same_decision(invariants, requests, instance, first, again, holds):
    fingers = FINGERS.model_copy(update={"id": "b-1"})
    for process, state in (("executor 1", first), (instance, again)):
        requests.on_serve(process, MOTION, m.MotionStatus(id="a-1", state=state))
        requests.on_serve(process, fingers, m.GripperState(id="b-1", state=state))
    assert (invariants.broken == []) == holds


@pytest.mark.parametrize(("other", "holds"), [
    (MOTION, True), (MOTION.model_copy(), True), (FINGERS, False), (FINGERS.model_copy(update={"id": "a-2"}), True),
    (MOTION.model_copy(update={"trajectory": m.JointTrajectory(joint_names=["k"], points=[])}), False),
    (m.PlanRequest(id="a-1", goal=m.JointGoal(named="home")), False),
])
def test_id_belongs_to_one_request(invariants, requests, other, holds):
    requests.on_request("task", MOTION)
    requests.on_request("task", other)
    assert (invariants.broken == []) == holds


@pytest.mark.parametrize("known", [False, True])
def test_goal_stopped_before_it_arrived_never_moves(invariants, requests, known):
    answer = m.MotionStatus(id="a-1", state="active") if known else m.MotionStatus(id="a-1", error="unknown_goal")
    requests.on_serve("executor 1", m.StopRequest(id="a-1", by="requester"), answer)
    put(invariants, "motion/status", m.MotionStatus(id="a-1", state="active"))
    assert invariants.broken == ([] if known else [f"1.000 s: {NEVER}: a-1"])


@pytest.mark.parametrize(("goal", "state", "held", "holds"), [
    ("", "active", True, True), ("", "active", False, False), ("a-1", "active", False, False),
    ("a-0", "active", False, True), ("a-1", "succeeded", False, True),
])
def test_requested_hold_takes_effect_unless_its_goal_is_over(invariants, requests, goal, state, held, holds):
    request = m.HoldRequest(hold=True, reason="a mug blocks the path", by="scene_monitor", goal=goal)
    requests.on_answer("motion_planner", request, m.MotionStatus(id="a-1", state=state, held=held))
    assert (invariants.broken == []) == holds


@pytest.mark.parametrize(("restarted", "seconds", "holds"), [
    (False, 1.0, True), (False, 3.0, False), (True, 1.0, False),
])
def test_after_a_stop_only_the_process_that_served_it_may_brake(invariants, requests, restarted, seconds, holds):
    limits = Limits(("j",), np.array([-3.0]), np.array([3.0]), np.array([1.0]), np.array([1.0]))
    stop = m.StopRequest(owner="anna")
    first = context_of(Incarnation("executor"))
    then = context_of(Incarnation("executor")) if restarted else first

    def move(start, cycles, position):
        for cycle in range(cycles):
            q = np.array([position + 1e-4 * cycle])
            invariants.on_set_point(limits, q, q, np.array([0.01]), start + 0.01 * cycle)

    requests.on_request("operator", stop)
    first.run(requests.on_serve, "executor 1", stop, m.MotionStatus(id="a-1", state="active"))
    put(invariants, "motion/status", m.MotionStatus(id="a-1", state="active"))
    first.run(move, 0.0, 10, 0.5)
    then.run(move, seconds, 20, 0.501)
    assert any(UNREQUESTED in line for line in invariants.broken) != holds


@pytest.mark.parametrize(("turned", "speed", "broken"), [(0.0, 0.0, None), (1.57, 0.0, APART), (0.0, 9.0, LIMITS)])
def test_set_points_of_several_arms_are_checked_for_each_and_between_them(requests, turned, speed, broken):
    cell = load_cell(str(Path(__file__).parents[1] / "data" / "two_arms.yaml"))
    robots = {arm: RobotModel.load(robot) for arm, robot in cell.robots.items()}
    invariants = Invariants(cell, requests, lambda: 1.0)
    for arm, sign in (("left", -1.0), ("right", 1.0)):  # turned towards each other, or beside each other
        robot = robots[arm]
        q = robot.named("home") + np.array([sign * turned, 0.7, 0.0, 0.7, 0.0, 0.0, 0.0])
        limits = Limits(tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration)
        invariants.on_set_point(limits, q, q, np.full(7, speed if arm == "right" else 0.0), 0.0, arm)
    assert [line.partition(": ")[2].partition(":")[0] for line in invariants.broken] == ([broken] if broken else [])


@pytest.mark.parametrize("later", [{}, {"ball_1": 0.4}, {"ball_1": 0.3, "ball_2": 0.5}])
def test_object_that_vanishes_moves_or_appears_by_itself_is_reported(invariants, later):
    assert not put_objects(invariants, ball_1=0.3) and put_objects(invariants, **later)


@pytest.mark.parametrize("answered", [True, False])
def test_edit_of_the_world_may_be_published_before_or_after_its_answer(invariants, requests, answered):
    put_objects(invariants, ball_1=0.3)
    requests.on_request("visitor", EDIT)
    if answered:
        requests.on_answer("visitor", EDIT, m.WorldEditReply(id="ball_1", ids=["ball_1"]))
    assert not put_objects(invariants, ball_1=0.5)
    assert not answered or put_objects(invariants, ball_1=0.3), "the edit allows one change"


def test_application_checks_the_ground_truth_once_its_task_is_done(tmp_path, monkeypatch):
    (tmp_path / "checking").mkdir()
    (tmp_path / "checking" / "task.py").write_text(
        "from common.messages import TaskStatus\nfrom common.topics import Topic\n"
        "from common.application import Application, ApplicationTopics\n"
        "STATUS = Topic('checking_status', TaskStatus, 'state', '')\n"
        "def misplaced(truth):\n    return ', '.join(each.id for each in truth.objects)\n"
        "APPLICATION = Application(topics=ApplicationTopics(status=STATUS), truth_check=misplaced)\n")
    monkeypatch.syspath_prepend(tmp_path)
    cell = PANDA.model_copy(update={"application": "checking.task"})
    for state, broken in (("ERROR", False), ("DONE", True)):
        invariants = Invariants(cell, RequestLog(), lambda: 1.0)
        put(invariants, "scene_objects", m.WorldObjects(objects=[m.WorldObject(id="cube", shape="box")]))
        invariants.on_end(0, state)
        assert [line.endswith(f"{ACCEPTED}: cube") for line in invariants.broken] == [True] * broken
    assert ACCEPTED not in Invariants(PANDA, RequestLog(), lambda: 1.0).checked


@pytest.mark.parametrize(("counted", "holds"), [(1, True), (3, False)])
def test_objects_in_a_container_that_they_are_taken_from_are_not_placed(counted, holds):
    cell = load_cell("sorting", ["world.simulator=kinematic"])
    invariants = Invariants(cell, RequestLog(), lambda: 1.0)
    objects = [m.WorldObject(id=f"o{k}", shape="box", pose=m.Pose(), state="contained", container=container)
               for k, container in enumerate(("tray", "tray", "left"))]
    invariants._world.on_truth(encode(m.WorldObjects(objects=objects)))
    invariants._world.on_end(counted, "DONE")
    assert (invariants.broken == []) == holds
