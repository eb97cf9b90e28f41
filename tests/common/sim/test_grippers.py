"""The gripper of the robot file decides what it can hold: its closing axis, a suction cup."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from common.config import GripperConfig, ObjectConfig, SuctionCup, World
from common.hardware.mock import SimulatedFingers
from common.messages import Header
from common.robot.finger_joints import finger_positions
from common.robot.transforms import rpy_to_matrix, tool_down, transform
from common.sim.kinematic import KinematicWorld
from common.sim.objects import centre_of, solid_of
from common.sim.suction import seal_problem

CUP = GripperConfig(cup=SuctionCup(), links=["cup"])
BALL = ObjectConfig(id="ball", shape="sphere", radius=0.03, x=0.5, y=0.0)
BAR = ObjectConfig(id="bar", shape="box", size=(0.05, 0.20), height=0.04, x=0.5, y=0.0)


class GripperRig:
    """A gripper in the simulated world, driven by the test."""

    def __init__(self, gripper: GripperConfig, thing: ObjectConfig) -> None:
        self.world = KinematicWorld(World(count=0), [thing], None, gripper)
        self.fingers, self.now = SimulatedFingers(gripper, gripper.max_width), 100.0

    def move(self, x: float, y: float, z: float, yaw: float = 0.0, width: float | None = None) -> None:
        """Move there and run the command to completion."""
        hand = tool_down(x, y, z, yaw)
        if width is not None:
            self.fingers.command(width, self.now)
        for _ in range(150):
            self.now += 0.01
            self.fingers.obstruct(self.world.obstruction(hand, self.fingers.read(self.now).width))
            reading = self.fingers.read(self.now)
            self.world.tick(self.now, hand, reading.width, reading.holding)

    @property
    def holding(self) -> bool:
        return self.fingers.read(self.now).holding and bool(self.world.held)

    @property
    def position(self) -> np.ndarray:
        return np.array(centre_of(self.world.objects(Header()).objects[0]))


@pytest.mark.parametrize(("thing", "top"), [(BALL, 0.06), (BAR, 0.04)])
def test_cup_picks_carries_and_releases_an_object(thing: ObjectConfig, top: float) -> None:
    rig = GripperRig(CUP, thing)
    before = rig.position
    rig.move(0.5, 0.0, top)
    assert not rig.holding  # suction is off
    rig.move(0.5, 0.0, top, width=0.0)
    assert rig.holding
    rig.move(0.4, 0.1, top + 0.2)
    assert rig.position == pytest.approx(np.add(before, (-0.1, 0.1, 0.2)), abs=1e-6)
    rig.move(0.4, 0.1, top + 0.2, width=CUP.max_width)
    assert not rig.holding and rig.position == pytest.approx(np.add(before, (-0.1, 0.1, 0.0)), abs=1e-6)


@pytest.mark.parametrize(("x", "z"), [(0.5, 0.08), (0.53, 0.06), (0.5, 0.03)])
def test_active_cup_picks_on_full_contact_only(x: float, z: float) -> None:
    rig = GripperRig(CUP, BALL)
    rig.move(x, 0.0, z, width=0.0)
    assert not rig.holding and rig.fingers.read(rig.now).width == pytest.approx(0.0, abs=1e-6)
    rig.move(0.5, 0.0, 0.06)
    assert rig.holding


@pytest.mark.parametrize(("x", "tilt", "held"), [
    (0.0, 0.0, True), (0.012, 0.0, True), (0.02, 0.0, False),  # over the edge
    (0.0, 0.1, True), (0.0, 0.5, False),
])
def test_complete_lip_must_touch_the_object(x: float, tilt: float, held: bool) -> None:
    solid = solid_of(BAR)
    R = rpy_to_matrix(0.0, tilt, 0.0) @ np.diag([1.0, -1.0, -1.0])  # the tool looks down, its tip on top of the bar
    T = transform(R, R @ [-x, 0.0, -solid.triangles[..., 2].max()])
    assert (seal_problem(SuctionCup(lip_radius=0.012, give=0.002), solid, T) == "") is held


@pytest.mark.parametrize(("thing", "x", "z", "reason"), [
    (BALL, 0.5, 0.075, "ball: the lip is up to 16.7 mm above the surface, and gives 5 mm"),
    (BALL, 0.5, 0.2, "nothing is at the cup"),
    (BAR.model_copy(update={"size": (0.015, 0.2)}), 0.5, 0.04,
     "bar: the surface is smaller than the lip, 20 mm, or the cup is at its edge"),
    (BAR, 0.52, 0.04, "bar: the surface is smaller than the lip, 20 mm, or the cup is at its edge"),
    (BALL.model_copy(update={"radius": 0.0101}), 0.5, 0.0202,
     "ball: the surface is not flat: 8.7 mm under the lip, which gives 8 mm"),
    (BAR.model_copy(update={"mass": 2.0}), 0.5, 0.04, "bar: it weighs 19.6 N, and the cup holds 18.8 N"),
    (BAR.model_copy(update={"mass": 1.9}), 0.5, 0.04, ""),
])
def test_cup_that_takes_nothing_says_why(thing: ObjectConfig, x: float, z: float, reason: str) -> None:
    gripper = CUP if "flat" not in reason else CUP.model_copy(update={"cup": SuctionCup(give=0.004)})
    rig = GripperRig(gripper, thing)
    rig.move(x, 0.0, z, width=0.0)
    assert rig.holding is not bool(reason) and rig.world.no_seal == reason


@pytest.mark.parametrize(("axis", "yaw", "takes"), [
    ("y", 0.0, False), ("y", math.pi / 2, True), ("x", 0.0, True), ("x", math.pi / 2, False)])
def test_fingers_close_along_the_configured_axis(axis: str, yaw: float, takes: bool) -> None:
    fingers = GripperConfig.model_validate({"joints": ["a", "b"], "links": [], "closing_axis": axis})
    rig = GripperRig(fingers, BAR)  # 50 mm along x, 200 along y
    rig.move(0.5, 0.0, 0.02, yaw, width=0.0)
    assert rig.holding is takes


def test_gripper_has_joints_or_a_cup() -> None:
    assert finger_positions(CUP, 0.04) == []
    for values in ({}, {"joints": ["a"], "cup": SuctionCup()}):
        with pytest.raises(ValidationError, match="needs either joints or a cup"):
            GripperConfig(links=[], **values)
