"""The owner of the motion: which client may move the arm, and the effect of a hand-over, a start, a stop and a hold."""

import pytest

from common.errors import Refused
from tests.common.control.jogged_arm import ur5

__all__ = ["ur5"]

NO_OWNER = ("", "none")
OWNED_BY_ANN = r"the motion is owned by ann \(operator\)"


@pytest.fixture
def arm(ur5):
    return ur5


@pytest.fixture
def owned(ur5):
    """The arm, of which ann owns the motion."""
    ur5.own()
    return ur5


def start_of_a_task(arm):
    """Give the motion to a task, as its start does."""
    return arm.own(owner="sorting", kind="task").owner == "sorting"


def test_motion_is_owned_by_its_requester_until_its_end_or_by_an_owner_until_it_is_returned(arm):
    assert arm.owner == NO_OWNER
    assert arm.execute("one", "ann").state == "active" and arm.owner == ("ann", "operator")
    assert arm.execute("two").error == "not_owner"
    arm.run(3.0)
    assert arm.owner == NO_OWNER and arm.execute("three").state == "active" and arm.owner == ("", "task")
    arm.run(3.0)
    arm.own(kind="script")
    arm.run(10.0)
    assert arm.owner == ("ann", "script") and arm.execute("four", "bob").error == "not_owner"
    arm.own("give", "bob")
    assert arm.owner == ("ann", "script")
    arm.own("give")
    assert arm.owner == NO_OWNER and arm.execute("five", "bob").state == "active"



def test_ownership_returned_during_a_motion_ends_with_that_motion(owned):
    assert owned.execute("one", "ann").state == "active"
    owned.run(0.3)
    owned.own("give")
    owned.step()
    assert owned.executor.arm.goal == "one" and owned.owner == ("ann", "operator")
    with pytest.raises(Refused, match=OWNED_BY_ANN):
        owned.own(owner="bob")
    owned.run(3.0)
    assert owned.owner == NO_OWNER
    owned.own(owner="bob")
    owned.jog_joint(0.3, owner="bob")
    owned.own("give", "bob")
    assert owned.owner == ("bob", "operator"), "the arm is not at rest yet"
    owned.run(0.5)
    assert owned.owner == NO_OWNER


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


def test_ownership_is_taken_over_only_explicitly_and_stops_the_owner_before(owned):
    with pytest.raises(Refused, match=OWNED_BY_ANN + " since .*: take it over, if it must be"):
        owned.own(owner="bob")
    owned.own(owner="bob", over=True)
    assert owned.owner == ("bob", "operator") and owned.execute("one", "ann").error == "stopped"


@pytest.mark.parametrize("task_alive", [True, False])
def test_operator_who_takes_over_from_a_task_stops_it_until_a_start(arm, task_alive):
    assert start_of_a_task(arm)
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
    assert arm.execute("three", "ann", acknowledged=arm.executor.arm.status.newest).state == "active"
    arm.run(3.0)
    arm.start_task("ann")
    assert arm.owner == NO_OWNER and start_of_a_task(arm) and arm.execute("four").state == "active"


def test_operator_who_takes_over_while_a_task_restarts_stops_it(arm):
    arm.own(over=True)  # the executor has restarted, too, and knows no owner
    arm.own("give")
    assert arm.execute("one").error == "stopped"


def test_refused_task_stays_stopped_when_the_ownership_is_returned(owned):
    assert owned.execute("one").error == "not_owner"
    owned.own("give")
    assert owned.execute("two").error == owned.execute("three", "bob").error == "stopped"
    owned.start_task("bob")
    assert owned.execute("four").state == "active"


def test_repeated_goal_that_was_refused_does_not_stop_a_task_started_since(owned):
    assert owned.execute("one").error == "not_owner"
    owned.start_task("ann")
    assert start_of_a_task(owned)
    assert owned.execute("one").error == "not_owner", "an id has one answer"
    assert owned.execute("two").state == "active"
    owned.run(3.0)
    owned.own("give", "sorting")
    owned.own(owner="bob")
    assert owned.execute("one").error == "not_owner" and not owned.authority.interlocks.all


def test_ownership_of_a_task_ends_with_its_process_and_that_of_an_operator_does_not(arm):
    assert start_of_a_task(arm)
    arm.authority.disown_task()
    arm.step()
    assert arm.owner == NO_OWNER
    arm.own()
    arm.authority.disown_task()
    assert arm.owner == ("ann", "operator")


# --- starts, stops and holds ---


def test_start_by_another_operator_ends_an_ownership_only_with_override_or_of_an_unknown_operator(owned):
    owned.start_task("bob")
    assert owned.owner == ("ann", "operator") and owned.execute("one").error == "not_owner"
    owned.start_task("bob", override=True)
    assert owned.owner == NO_OWNER
    owned.own(owner="operator")
    owned.start_task("bob")
    assert owned.owner == NO_OWNER and owned.execute("two").state == "active"


def test_start_with_override_ends_the_motion_of_the_owner_for_good(owned):
    owned.execute("one", "ann")
    owned.run(0.5)
    owned.start_task("bob", override=True)
    assert start_of_a_task(owned)
    owned.run(0.5)
    assert owned.at_rest() and owned.executor.arm.goal == "" and owned.reports[-1].owner is None
    assert owned.execute("one", "ann").state == "cancelled" and "one" in owned.authority.interlocks.record.goals
    assert owned.execute("two").state == "active"
    owned.start_task("bob", override=True)
    owned.run(0.5)
    assert owned.executor.arm.goal == "two", "a second start does not end the motion of the task"


def test_start_decided_before_a_later_stop_has_no_effect(arm):
    decided = arm.stamp
    arm.run(0.1)
    arm.own(over=True)
    arm.execute("one", "ann", acknowledged=arm.executor.arm.status.newest)
    arm.run(0.5)
    arm.start_task("bob", override=True, acknowledged=decided)
    arm.run(0.5)
    assert arm.owner == ("ann", "operator") and arm.executor.arm.goal == "one" and not arm.at_rest()
    assert arm.execute("two").error == "stopped"


def test_operator_who_turns_a_hold_into_a_stop_gets_the_motion_of_a_task_and_of_no_operator(owned):
    def into_stop(goal):
        owned.hold("bob", hold=False, into_stop=True, acknowledged=owned.executor.arm.status.newest)
        return owned.execute(goal, "bob", acknowledged=owned.executor.arm.status.newest)

    owned.hold("bob")
    assert into_stop("one").error == "not_owner" and owned.owner == ("ann", "operator")
    owned.own("give")
    assert start_of_a_task(owned) and into_stop("two").state == "active"


def test_stop_and_hold_need_no_ownership_and_a_stop_ends_it(owned):
    owned.execute("one", "ann")
    owned.run(0.5)
    assert owned.hold("bob").held
    owned.run(0.5)
    assert owned.at_rest()
    owned.stop("bob")
    assert owned.owner == NO_OWNER
