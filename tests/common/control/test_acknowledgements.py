"""Which operators may move the arm past a stop: the one who made it, once they know it."""

import numpy as np
import pytest

from tests.common.control.jogged_arm import arm

__all__ = ["arm"]

BLOCKED, MOVES = True, False


@pytest.mark.parametrize(("stopped_by", "moved_by", "acknowledged", "blocked"), [
    ("ann", "ann", lambda newest: newest, MOVES),
    ("ann", "ann", lambda newest: newest - 1, BLOCKED),
    ("ann", "ann", lambda newest: newest + 1, BLOCKED),  # was never published
    ("ann", "ann", lambda newest: 2**62, BLOCKED),
    ("ann", "ann", lambda newest: None, BLOCKED),
    ("ann", "bob", lambda newest: newest, BLOCKED),
    ("", "bob", lambda newest: newest, BLOCKED),  # a stop without a name belongs to no operator
    ("operator", "operator", lambda newest: newest, BLOCKED),
    ("", "", lambda newest: newest, BLOCKED),
])
def test_stop_is_passed_only_by_its_operator_who_acknowledges_what_was_published(
    arm, stopped_by, moved_by, acknowledged, blocked
):
    arm.stop(stopped_by)
    arm.run(0.4)
    newest = acknowledged(arm.executor.arm.status.newest)
    assert (arm.execute("one", moved_by, acknowledged=newest).error == "stopped") is blocked
    if moved_by and not blocked:
        arm.run(3.0)
    before = arm.q
    arm.jog_joint(0.8, 0.3, owner=moved_by or "operator", acknowledged=newest)
    assert np.array_equal(arm.q, before) is blocked


def test_hold_without_a_name_is_turned_into_a_stop_of_the_moving_operator(arm):
    arm.hold("")
    arm.run(0.1)
    arm.hold("ann", hold=False, into_stop=True, acknowledged=arm.executor.arm.status.newest)
    newest = arm.executor.arm.status.newest
    assert arm.execute("one", "bob", acknowledged=newest).error == "stopped"
    assert arm.execute("two", "ann", acknowledged=newest).state == "active"
