"""The exception of a handover: what the coordinator permits with it, and what it refuses."""

import re

import numpy as np
import pytest

from common.messages import AttachedObject, CollisionObject, Pose, Vector3
from common.planning.arms import way_back
from common.planning.arms.arm import Observed
from common.planning.arms.coordinator import Coordinator, Retreat
from common.planning.arms.pair_world import ArmGeometry, PairWorld
from common.planning.ik import solve_ik
from common.planning.trajectory import TimedPath
from tests.two_arms import Array, robots

HEIGHT, BACK, APART = 0.5, 0.15, 0.03  # [m] between the tools at last: each holds its half of the box


class Meeting:
    """The left arm offers a box at rest; the right one is in front of it."""

    def __init__(self, carried: str = "box") -> None:
        geometries = [ArmGeometry(name, robot) for name, robot in robots().items()]
        self.coordinator = Coordinator(geometries, line=lambda *_: True)
        self.offers = self.pose("left", 0.0, 0.55)
        self.near, self.at = (self.pose("right", np.pi / 2, 0.55 + x) for x in (BACK, APART))
        self.coordinator.carry("left", self.body("left", carried))
        self.rest("left", self.offers)
        self.rest("right", self.near)

    def pose(self, arm: str, roll: float, x: float) -> Array:
        """Return joint positions (dof,) [rad] with the tool towards the other arm."""
        robot, z = self.coordinator.arms[arm].geometry.robot, 1.0 if arm == "left" else -1.0
        y = np.array([0.0, np.cos(roll), np.sin(roll)])
        T = np.eye(4)
        T[:3, :3] = np.column_stack([np.cross(y, [z, 0, 0]), y, [z, 0, 0]])
        T[:3, 3] = x, 0.0, HEIGHT
        q = solve_ik(robot, T, getattr(self, "near", robot.named("home")), restarts=3)
        assert q is not None
        return q

    def body(self, arm: str, name: str):  # noqa: ANN202
        geometry = self.coordinator.arms[arm].geometry
        box = CollisionObject(id=name, role="attached", shape="box", dimensions=[0.05, 0.04, 0.06],
                              pose=Pose(position=Vector3(z=APART / 2)))
        return geometry.body([AttachedObject(link=geometry.robot.config.tcp_link, object=box)])

    def rest(self, arm: str, q: Array) -> None:
        self.coordinator.observe(arm, Observed(0.0, q))
        self.coordinator.step(4.0)

    def reach(self, seconds: float = 3.0) -> TimedPath:
        path = way_back.straight(self.near, self.at, self.coordinator.arms["right"].limits)
        scale = seconds / path.duration
        return TimedPath(path.times * scale, path.positions, path.velocities / scale, path.accelerations / scale**2)


def test_receiver_reaches_the_object_with_the_exception_alone_and_has_a_way_back_out_of_it() -> None:
    meeting = Meeting()
    right = meeting.coordinator.arms["right"]
    assert meeting.coordinator.request("right", "without", meeting.reach(), 0.0).state == "wait"
    meeting.coordinator.step(0.0)
    assert right.committed is None and right.ticket is not None and "box" in right.ticket.reason
    meeting.coordinator.request("right", "with", meeting.reach(), 0.0, may_touch=["box"])
    meeting.coordinator.step(0.0)
    assert right.committed is not None and right.committed.goal == "with"
    back = right.committed.back
    assert back is not None and back.touch is not None and back.touch.object == "box"
    assert back.touch.end < 3.0 < back.motion.duration


@pytest.mark.parametrize(("names", "seconds", "message"), [
    (["panda_link7"], 3.0, "may_touch: panda_link7 is not one object that another arm carries; choices: box"),
    (["own"], 3.0, "may_touch: own is not one object that another arm carries; choices: box"),
    (["box", "panda_hand"], 3.0, "may_touch: box, panda_hand is not one object that another arm carries; choices: box"),
    (["box"], 0.5, r"may_touch: the tool moves at 0\.\d\d m/s near box; at most 0.1 m/s within 0.08 m of it"),
])
def test_other_exceptions_are_refused_in_one_line(names: list[str], seconds: float, message: str) -> None:
    meeting = Meeting()
    meeting.coordinator.carry("right", meeting.body("right", "own"))
    decision = meeting.coordinator.request("right", "g", meeting.reach(seconds), 0.0, may_touch=names)
    assert (decision.state, decision.error) == ("refused", "may_touch")
    assert re.fullmatch(message, decision.message), decision.message


def test_object_named_as_a_link_excepts_the_gripper_and_the_object_alone() -> None:
    left, right = Meeting("panda_link7").coordinator.arms.values()
    world = PairWorld(left.body, right.body)
    excepted = [world.names(pair) for pair in np.flatnonzero(world.gripper_on(1, "panda_link7"))]
    assert sorted({*excepted}) == [("panda_link7", f"panda_{link}") for link in ("hand", "leftfinger", "rightfinger")]


def test_who_reached_in_moves_back_first_and_neither_does_while_both_hold() -> None:
    meeting = Meeting()
    coordinator, left, right = meeting.coordinator, *meeting.coordinator.arms.values()
    coordinator.request("right", "reach", meeting.reach(), 0.0, may_touch=["box"])
    coordinator.step(0.0)
    coordinator.observe("right", Observed(0.5, meeting.at, "reach", 3.0))
    coordinator.step(0.5)
    meeting.rest("right", meeting.at)
    (retreat,) = coordinator.move_back(left, right, 0.0, 10.0)
    assert isinstance(retreat, Retreat)
    assert (retreat.arm, retreat.may_touch, retreat.why) == ("right", ("box",), "out of the way of left")
    coordinator.carry("right", meeting.body("right", "taken"))
    coordinator.step(10.0)
    for arm, other in ((left, right), (right, left)):
        assert coordinator.move_back(arm, other, 0.0, 20.0) == (
            f"holds what {other.name} holds, too: open one of the grippers")
    coordinator.carry("left", left.geometry.body([]))  # the giver has opened, and is the one to withdraw
    assert coordinator.move_back(right, left, 0.0, 30.0) == "has no proved way back"
