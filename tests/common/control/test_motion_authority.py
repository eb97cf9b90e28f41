"""The owner of the motion: who may move the arm, and what a hand-over, a start, a stop and a hold do."""

import pytest

from common.errors import Refused
from tests.common.control.jogged_arm import arm

__all__ = ["arm"]

NO_OWNER = ("", "none")
OWNED_BY_ANN = r"the motion is owned by ann \(operator\)"


def test_requester_of_a_motion_owns_it_until_it_ends(arm):
    assert arm.owner == NO_OWNER
    assert arm.execute("one", "ann").state == "active" and arm.owner == ("ann", "operator")
    assert arm.execute("two").error == "not_owner"
    arm.run(3.0)
    assert arm.owner == NO_OWNER and arm.execute("three").state == "active" and arm.owner == ("", "task")


def test_requested_ownership_lasts_until_it_is_returned(arm):
    arm.own(kind="script")
    arm.run(10.0)
    assert arm.owner == ("ann", "script") and arm.execute("one", "bob").error == "not_owner"
    arm.own("give", "bob")
    assert arm.owner == ("ann", "script")
    arm.own("give")
    assert arm.owner == NO_OWNER and arm.execute("two", "bob").state == "active"


def test_ownership_returned_during_a_motion_ends_with_that_motion(arm):
    arm.own()
    assert arm.execute("one", "ann").state == "active"
    arm.run(0.3)
    arm.own("give")
    arm.step()
    assert arm.executor.arm.goal == "one" and arm.owner == ("ann", "operator")
    with pytest.raises(Refused, match=OWNED_BY_ANN):
        arm.own(owner="bob")
    arm.run(3.0)
    assert arm.owner == NO_OWNER
    arm.own(owner="bob")
    arm.jog_joint(0.3, owner="bob")
    arm.own("give", "bob")
    assert arm.owner == ("bob", "operator"), "the arm is not at rest yet"
    arm.run(0.5)
    assert arm.owner == NO_OWNER


def test_lease_ends_without_a_renewal_but_not_during_a_motion(arm):
    for _ in range(2):
        arm.own(kind="script", lease=1.0)
        arm.run(0.8)
    assert arm.execute("one", "ann").state == "active"
    arm.run(2.0)
    assert arm.owner == ("ann", "script")
    arm.run(2.0)
    assert arm.owner == NO_OWNER


def test_each_change_of_the_owner_is_reported_once(arm):
    arm.reports.clear()
    arm.own()
    arm.run(0.2)
    arm.jog_joint(0.2)
    arm.run(0.5)
    reported = [report.owner for report in arm.reports if report.owner]
    assert [(one.owner, one.jogging) for one in reported] == [("ann", False), ("ann", True), ("ann", False)]


# --- taking it over ---


def test_ownership_is_taken_over_only_explicitly_and_stops_the_owner_before(arm):
    arm.own()
    with pytest.raises(Refused, match=OWNED_BY_ANN + " since .*: take it over, if it must be"):
        arm.own(owner="bob")
    arm.own(owner="bob", over=True)
    assert arm.owner == ("bob", "operator")
    assert arm.execute("one", "ann").error == "stopped"


@pytest.mark.parametrize("task_alive", [True, False])
def test_operator_who_takes_over_from_a_task_stops_it_until_a_start(arm, task_alive):
    arm.own(owner="sorting", kind="task")
    arm.execute("one")
    arm.run(0.5)
    if not task_alive:  # its motion continues
        arm.authority.disown_task()
        with pytest.raises(Refused):
            arm.own(owner="bob")
    arm.own(over=True)
    arm.run(0.5)
    assert arm.at_rest() and arm.executor.arm.goal == ""
    assert arm.execute("two").error == "stopped"
    assert arm.authority.interlocks.record.interlocks[0].by == "ann", "it persists"
    assert arm.execute("three", "ann", acknowledged=arm.stamp + 1).state == "active"
    arm.run(3.0)
    arm.start_task("ann")
    assert arm.owner == NO_OWNER and arm.own(owner="sorting", kind="task").owner == "sorting"
    assert arm.execute("four").state == "active"


def test_operator_who_takes_over_while_a_task_restarts_stops_it(arm):
    arm.own(over=True)  # the executor has restarted, too, and knows no owner
    arm.own("give")
    assert arm.execute("one").error == "stopped"


def test_task_that_was_refused_stays_stopped_when_the_ownership_is_returned(arm):
    arm.own()
    assert arm.execute("one").error == "not_owner"
    arm.own("give")
    assert arm.execute("two").error == arm.execute("three", "bob").error == "stopped"
    arm.start_task("bob")
    assert arm.execute("four").state == "active"


def test_repeated_goal_that_was_refused_does_not_stop_a_task_started_since(arm):
    arm.own()
    assert arm.execute("one").error == "not_owner"
    arm.start_task("ann")
    assert arm.own(owner="sorting", kind="task").owner == "sorting"
    assert arm.execute("one").error == "not_owner", "an id has one answer"
    assert arm.execute("two").state == "active"
    arm.run(3.0)
    arm.own("give", "sorting")
    arm.own(owner="bob")
    assert arm.execute("one").error == "not_owner" and not arm.authority.interlocks.all


def test_ownership_of_a_task_ends_with_its_process_and_that_of_an_operator_does_not(arm):
    arm.own(owner="sorting", kind="task")
    arm.authority.disown_task()
    arm.step()
    assert arm.owner == NO_OWNER
    arm.own()
    arm.authority.disown_task()
    assert arm.owner == ("ann", "operator")


# --- starts, stops and holds ---


def test_start_by_another_operator_ends_an_ownership_only_with_override(arm):
    arm.own()
    arm.start_task("bob")
    assert arm.owner == ("ann", "operator") and arm.execute("one").error == "not_owner"
    arm.start_task("bob", override=True)
    assert arm.owner == NO_OWNER


def test_every_start_ends_the_ownership_of_an_unknown_operator(arm):
    arm.own(owner="operator")
    arm.start_task("bob")
    assert arm.owner == NO_OWNER and arm.execute("one").state == "active"


def test_start_with_override_ends_the_motion_of_the_owner_for_good(arm):
    arm.own()
    arm.execute("one", "ann")
    arm.run(0.5)
    arm.start_task("bob", override=True)
    assert arm.own(owner="sorting", kind="task").owner == "sorting"
    arm.run(0.5)
    assert arm.at_rest() and arm.executor.arm.goal == "" and arm.reports[-1].owner is None
    assert arm.execute("one", "ann").state == "cancelled" and "one" in arm.authority.interlocks.record.goals
    assert arm.execute("two").state == "active"
    arm.start_task("bob", override=True)
    arm.run(0.5)
    assert arm.executor.arm.goal == "two", "a second start does not end the motion of the task"


def test_start_decided_before_a_later_stop_has_no_effect(arm):
    decided = arm.stamp
    arm.run(0.1)
    arm.own(over=True)
    arm.execute("one", "ann", acknowledged=arm.stamp + 1)
    arm.run(0.5)
    arm.start_task("bob", override=True, acknowledged=decided)
    arm.run(0.5)
    assert arm.owner == ("ann", "operator") and arm.executor.arm.goal == "one" and not arm.at_rest()
    assert arm.execute("two").error == "stopped"


def test_operator_who_turns_a_hold_into_a_stop_gets_the_motion_of_a_task_and_of_no_operator(arm):
    def into_stop():
        arm.hold("bob", hold=False, into_stop=True, acknowledged=arm.stamp + 1)

    arm.own()
    arm.hold("bob")
    into_stop()
    assert arm.owner == ("ann", "operator")
    assert arm.execute("one", "bob", acknowledged=arm.stamp + 1).error == "not_owner"
    arm.own("give")
    arm.own(owner="sorting", kind="task")
    into_stop()
    assert arm.execute("two", "bob", acknowledged=arm.stamp + 1).state == "active"


def test_stop_and_hold_need_no_ownership_and_a_stop_ends_it(arm):
    arm.own()
    arm.execute("one", "ann")
    arm.run(0.5)
    assert arm.hold("bob").held
    arm.run(0.5)
    assert arm.at_rest()
    arm.stop("bob")
    assert arm.owner == NO_OWNER
