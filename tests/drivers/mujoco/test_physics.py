"""Physics: objects fall, roll, are pushed and held by friction, and are restored after a restart."""

import math
from typing import Any

import numpy as np
import pytest

from common.config import World, load_cell
from common.errors import ConfigError, Refused
from common.hardware.interface import Gripper, Limits
from common.messages import Header, Vector3, WorldEdit, WorldObject
from common.planning.ik import solve_ik
from common.robot.finger_joints import finger_positions
from common.robot.model import RobotModel
from common.robot.transforms import tool_down
from common.sim.interface import load_world

BALL = {"shape": "sphere", "radius": 0.03, "mass": 0.1}
CUBE = {"shape": "box", "size": [0.05, 0.05, 0.05], "mass": 0.1}
PERIOD = 0.01  # [s] of a cycle of control
GRIPPER = load_cell("panda").robot.gripper


class Rig:
    """An arm above a table with objects, and a clock that tests drive by hand."""

    def __init__(self, *objects: dict[str, Any], cell: str = "panda") -> None:
        config = load_cell(cell)
        self.robot = RobotModel.load(config.robot)
        objects = [{"id": f"object_{i + 1}", "x": 0.45, "y": 0.0, **obj} for i, obj in enumerate(objects)]
        self.config = World.model_validate({
            "fixtures": [{"id": "table", "dimensions": [1.0, 1.0, 0.05], "position": [0.5, 0.0, -0.025]}],
            "containers": {"box": {"x": 0.55, "y": 0.25}}, "objects": objects, "simulator": "mujoco"})
        self.now = 100.0
        self.begin(self.robot.named("home"))

    def begin(self, q: Any) -> None:
        world = load_world(self.config, self.config.objects, None, self.robot.config.gripper)
        robot = self.robot
        limits = Limits(tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration)
        self.world, self.arm = world, world.hardware(robot, limits, np.array(q, float))
        self.set_point = np.array(q, float)

    def restart(self, saved: Any = None) -> None:
        """Restore the world in a new process from a snapshot through its wire format, by default of now."""
        saved, width = saved or self.world.snapshot(), self.fingers.read(self.now).width
        self.begin(self.set_point)
        self.world.restore({name: type(each).model_validate(each.model_dump()) for name, each in saved.items()})
        self.fingers.place(width)

    @property
    def fingers(self) -> Gripper:
        return self.arm.gripper

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD)):
            self.now += PERIOD
            self.arm.read(self.now)

    def move(self, to: Any, seconds: float = 1.0) -> None:
        """Move along a straight line in joint space with smooth ends."""
        start, change = self.set_point.copy(), np.array(to, float) - self.set_point
        for step in range(1, round(seconds / PERIOD) + 1):
            fraction = step * PERIOD / seconds
            self.now += PERIOD
            self.arm.read(self.now)
            s, ds = 0.5 - 0.5 * math.cos(math.pi * fraction), 0.5 * math.pi / seconds * math.sin(math.pi * fraction)
            self.set_point = start + s * change
            self.arm.write(self.set_point, ds * change, self.now)
        self.wait(0.2)

    def above(self, x: float, y: float, z: float) -> Any:
        return solve_ik(self.robot, tool_down(x, y, z), self.set_point)

    def grip(self, width: float, effort: float = 5.0, seconds: float = 0.8) -> None:
        self.fingers.command(width, self.now, effort)
        self.wait(seconds)

    def grasp(self, z: float = 0.03, effort: float = 5.0, lift: float | None = 0.2) -> None:
        """Grasp the object at (0.45, 0, z) from above, and lift it."""
        self.move(self.above(0.45, 0.0, z + 0.07))
        self.move(self.above(0.45, 0.0, z))
        self.grip(0.0, effort)
        if lift is not None:
            self.move(self.above(0.45, 0.0, lift))

    def object(self, name: str = "object_1") -> WorldObject:
        return next(obj for obj in self.world.objects(Header()).objects if obj.id == name)

    def position(self, name: str = "object_1") -> tuple[float, float, float]:
        p = self.object(name).pose.position
        return p.x, p.y, p.z

    def push(self, name: str, *velocity: float) -> None:
        cell, data = self.world.simulation
        at = cell.objects[name].dof
        data.qvel[at: at + len(velocity)] = velocity


def test_cell_at_rest_does_not_change() -> None:
    rig = Rig(BALL)
    rig.wait(0.5)
    version, readings = rig.world.version, set()
    for _ in range(150):
        rig.now += PERIOD
        q, dq = rig.arm.read(rig.now)
        readings.add((q.tobytes(), dq.tobytes(), rig.fingers.read(rig.now)))
    assert len(readings) == 1, "noise of readings would be published"
    assert q == pytest.approx(rig.robot.named("home"), abs=1e-3) and np.abs(dq).max() < 1e-3
    assert rig.position() == pytest.approx((0.45, 0.0, 0.03), abs=5e-4)
    assert rig.object().state == "table" and rig.world.version == version and rig.world.take_events() == []


def test_pushed_ball_rolls_and_stops_or_leaves_the_table() -> None:
    rig = Rig(BALL, {**BALL, "x": 0.95})
    rig.push("object_1", 0.3)
    rig.push("object_2", 1.0)
    rig.wait(0.3)
    assert rig.object("object_2").state == "falling"
    rig.wait(3.2)
    stopped = rig.position()
    rig.wait(1.0)
    assert rig.position() == pytest.approx(stopped, abs=5e-4)
    assert 0.5 < stopped[0] < 0.8 and rig.object().state == "table"
    assert rig.object("object_2").state == "elsewhere" and rig.position("object_2")[2] < -0.5


def test_grasped_ball_is_lifted_by_friction_and_released() -> None:
    rig = Rig(BALL)
    assert not rig.fingers.read(rig.now).holding
    rig.grasp(lift=None)
    reading = rig.fingers.read(rig.now)
    assert reading.holding and not reading.moving and reading.width == pytest.approx(0.06, abs=3e-3)
    assert reading.effort == pytest.approx(5.0, rel=0.1)
    rig.move(rig.above(0.45, 0.0, 0.2))
    rig.wait(2.0)
    assert rig.object().state == "held" and rig.position()[2] == pytest.approx(0.2, abs=5e-3)
    rig.grip(0.08)
    rig.wait(1.0)
    assert rig.object().state == "table" and rig.position()[2] == pytest.approx(0.03, abs=1e-3)
    assert [update.data for update in rig.world.take_events()] == ["remove:object_1", "add:object_1"]


def test_fingers_respect_their_speed_limit_and_hold_nothing_without_an_object() -> None:
    rig = Rig()
    for _ in range(2):
        rig.wait(0.1)
        rig.fingers.command(0.0, rig.now, 5.0)
        widths = []
        while (reading := rig.fingers.read(rig.now)).moving:
            rig.wait(PERIOD)
            widths.append(reading.width)
        assert np.abs(np.diff(widths)).max() <= 1.05 * GRIPPER.speed * PERIOD
        assert reading.width == pytest.approx(0.0, abs=1e-3) and not reading.holding
        rig.grip(0.08)
        assert rig.fingers.read(rig.now).width == pytest.approx(0.08, abs=1e-3)


def test_fingers_opening_against_an_obstacle_do_not_push_the_arm() -> None:
    rig = Rig({**CUBE, "size": [0.1, 0.1, 0.07], "y": 0.085, "mass": 80.0})  # next to the closed fingers
    rig.grip(0.0)
    rig.grasp(0.05, lift=None)
    rig.grip(GRIPPER.max_width, GRIPPER.effort, 2.0)
    assert rig.fingers.read(rig.now).width < GRIPPER.max_width - 0.01, "blocked from opening"
    assert np.abs(rig.arm.read(rig.now)[0] - rig.set_point).max() < 5e-3


@pytest.mark.parametrize("cell", ["panda", "ur5"])
def test_gripper_joints_follow_the_driven_one(cell: str) -> None:
    rig = Rig(cell=cell)
    gripper = rig.robot.config.gripper
    model, data = rig.world.simulation
    for fraction in (0.2, 0.7):
        rig.grip(fraction * gripper.max_width, gripper.max_effort, 3.0)
        wanted = finger_positions(gripper, fraction * gripper.max_width)
        found = [float(data.qpos[model.joints[name]]) for name in gripper.joints]
        assert found == pytest.approx(wanted, abs=0.01 if gripper.linkage else 1e-3)


def test_joint_forces_respect_effort_limits() -> None:
    rig = Rig()
    model, data = rig.world.simulation
    rig.arm.write(rig.set_point + 0.5, 0 * rig.set_point, rig.now)
    rig.wait(0.05)
    forces = np.abs([float(data.actuator_force[model.actuators[name]]) for name in rig.robot.joint_names])
    assert (forces <= rig.robot.model.effortLimit + 1e-9).all() and forces.max() > 1.0


def test_delay_of_the_process_does_not_advance_the_world() -> None:
    rig = Rig(BALL)
    rig.push("object_1", 0.2)
    rig.wait(0.1)
    before = rig.position()
    rig.now += 3600.0
    rig.arm.read(rig.now)
    assert rig.position() == pytest.approx(before, abs=5e-3)


def test_restored_motion_continues() -> None:
    rig = Rig({**BALL, "x": 0.3}, CUBE)
    rig.push("object_1", 0.3, 0.1)
    rig.wait(0.3)
    before, saved = rig.position(), rig.world.snapshot()
    rig.wait(0.3)
    after = rig.position()
    rig.restart(saved)
    rig.now += 1000.0
    rig.wait(0.01)
    assert rig.position() == pytest.approx(before, abs=5e-3)
    rig.wait(0.3)
    assert rig.position() == pytest.approx(after, abs=5e-3)


def test_held_object_is_restored_at_rest_and_still_held() -> None:
    rig = Rig(BALL)
    rig.grasp()
    rig.push("object_1", 0.0, 1.0)
    rig.restart()
    cell, data = rig.world.simulation
    assert not data.qvel[cell.objects["object_1"].dof:][:6].any()
    rig.grip(0.0, seconds=1.0)
    assert rig.fingers.read(rig.now).holding
    assert rig.object().state == "held" and rig.position()[2] == pytest.approx(0.2, abs=8e-3)


def test_snapshot_has_the_current_pose() -> None:
    rig = Rig(BALL)
    rig.wait(0.5)
    rig.push("object_1", 0.2)
    for _ in range(10):  # shorter than the publish interval
        before = rig.world.snapshot()["object_1"].details["qpos"][0]
        rig.wait(PERIOD)
        assert rig.world.snapshot()["object_1"].details["qpos"][0] - before > 0.1 * PERIOD


def test_edits_add_move_remove_and_reset() -> None:
    rig = Rig(BALL, {**CUBE, "y": -0.2})
    rig.wait(0.1)
    added = rig.world.edit(WorldEdit(op="add", shape="ring", size=Vector3(x=0.06, y=0.06, z=0.03), inner_radius=0.02,
                                     position=Vector3(x=0.6, y=-0.2), mass=0.25), rig.now)
    cell, _ = rig.world.simulation
    assert cell.model.body_mass[cell.objects[added].body] == pytest.approx(0.25)
    rig.wait(0.5)
    assert rig.position(added) == pytest.approx((0.6, -0.2, 0.015), abs=1e-3)
    assert rig.position()[0] == pytest.approx(0.45)
    rig.world.edit(WorldEdit(op="move", id="object_1", position=Vector3(x=0.3, y=0.1)), rig.now)
    rig.wait(0.5)
    assert rig.position() == pytest.approx((0.3, 0.1, 0.03), abs=1e-3)
    with pytest.raises(Refused, match=r"occupied|overlap"):
        rig.world.edit(WorldEdit(op="move", id="object_1", position=Vector3(x=0.45, y=-0.2)), rig.now)
    rig.world.edit(WorldEdit(op="remove", id="object_2"), rig.now)
    assert rig.world.ids == ["object_1", added]
    rig.wait(0.1)
    rig.world.edit(WorldEdit(op="reset"), rig.now)
    rig.wait(0.1)
    assert rig.world.ids == ["object_1", "object_2"] and rig.position() == pytest.approx((0.45, 0.0, 0.03), abs=1e-3)


def test_object_that_mujoco_rejects_is_rejected_without_effect() -> None:
    rig = Rig(BALL)
    rig.wait(0.1)
    thin = WorldEdit(op="add", shape="prism", size=Vector3(x=0.1, y=0.1, z=1e-30), position=Vector3(x=0.6, y=-0.2),
                     polygon=[(0.0, 0.0), (0.1, 0.0), (0.0, 0.1)])
    rig.world.take_events()
    with pytest.raises(Refused, match="cannot simulate"):
        rig.world.edit(thin, rig.now)
    assert rig.world.ids == ["object_1"] and rig.world.take_events() == []
    added = rig.world.edit(WorldEdit(op="add", id="b", position=Vector3(x=0.6, y=-0.2)), rig.now)
    rig.wait(0.1)
    assert rig.world.ids == ["object_1", added] and rig.position()[0] == pytest.approx(0.45)


@pytest.mark.parametrize("concurrent_edit", [None, WorldEdit(op="add", position=Vector3(x=0.3, y=-0.3, z=0.0))])
def test_dropped_object_falls_out_of_the_fingers(concurrent_edit: WorldEdit | None) -> None:
    rig = Rig(BALL)
    with pytest.raises(Refused, match="between the fingers"):
        rig.world.edit(WorldEdit(op="drop"), rig.now)
    rig.grasp()
    assert rig.world.edit(WorldEdit(op="drop"), rig.now) == "object_1"
    if concurrent_edit is not None:
        rig.world.edit(concurrent_edit, rig.now)
    rig.wait(1.5)
    assert rig.position()[2] == pytest.approx(0.03, abs=2e-3) and not rig.fingers.read(rig.now).holding


@pytest.mark.parametrize("restart", [False, True])
def test_object_dropped_on_the_table_is_not_flung_away_by_closing_fingers(restart: bool) -> None:
    rig = Rig(BALL)
    rig.grasp(lift=None)
    rig.world.edit(WorldEdit(op="drop"), rig.now)
    if restart:
        rig.wait(0.15)
        rig.restart()
        assert rig.fingers.read(rig.now).width < 0.04, "the fingers are within the ball"
        rig.grip(0.0, seconds=3.0)
    else:
        rig.wait(3.0)
    assert math.dist(rig.position(), (0.45, 0.0, 0.03)) < 5e-3
    assert np.abs(rig.arm.read(rig.now)[0] - rig.set_point).max() < 5e-3, "the arm is not pushed"
    rig.move(rig.above(0.45, 0.0, 0.2))
    rig.grip(0.08)
    rig.grasp(lift=None)
    assert rig.fingers.read(rig.now).holding, "graspable again"


@pytest.mark.parametrize(("friction", "holds"), [(0.2, False), (0.6, True), (None, True)])
def test_friction_of_an_object_wins_over_that_of_the_pads_also_after_a_restart(friction: float, holds: bool) -> None:
    for restarted in (False, True):
        rig = Rig({**CUBE, "mass": 0.4, "friction": friction})
        if restarted:
            rig.wait(0.1)
            rig.restart()
        rig.grasp(effort=5.0)  # by two pads: carries 10 N times the coefficient; the cube weighs 3.9 N
        assert (rig.position()[2] > 0.15) == holds


def test_added_object_has_the_friction_of_the_one_that_it_is_like() -> None:
    rig = Rig({**CUBE, "friction": 0.3})
    rig.world.edit(WorldEdit(op="add", id="another", like="object_1", position=Vector3(x=0.5, y=-0.2)), rig.now)
    cell, _ = rig.world.simulation
    geoms = np.isin(cell.model.geom_bodyid, [each.body for each in cell.objects.values()])
    assert cell.model.geom_friction[geoms][:, 0] == pytest.approx([0.3, 0.3])


def test_missing_mujoco_is_rejected_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    config = Rig().config
    monkeypatch.setattr("drivers.mujoco.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="zencell\\[physics\\]"):
        load_world(config, [])
