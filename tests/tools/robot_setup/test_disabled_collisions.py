import re
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
import trimesh

from common.config import RobotConfig, load_cell
from common.planning.robot_geometry import RobotGeometry, convex_hulls
from common.robot.model import RobotModel
from tests.common.planning.ur5_scene import ROBOT
from tools.robot_setup.sampling import disabled_pairs, sample_configurations, srdf, survey_pairs

PANDA = RobotModel.load(load_cell("panda").robot)


def named(pairs, *reasons):
    return {frozenset((p.one, p.other)) for p in pairs if not reasons or p.reason in reasons}


def test_srdf_of_the_ur5_is_up_to_date():
    written = {(item.get("link1"), item.get("link2"), item.get("reason"))
               for item in ET.parse(ROBOT.srdf).iter("disable_collisions")}
    assert written == {(p.one, p.other, p.reason) for p in disabled_pairs(ROBOT)}


def test_same_seed_gives_the_same_pairs():
    first, second = (disabled_pairs(ROBOT, samples=300, rng=np.random.default_rng(7)) for _ in range(2))
    assert first == second


@pytest.mark.parametrize("robot", [ROBOT, PANDA], ids=["ur5", "panda"])
@pytest.mark.slow
def test_never_colliding_pairs_do_not_collide_at_other_samples(robot):
    never = named(disabled_pairs(robot), "Never")
    assert never
    geometry = convex_hulls(robot.full_geometry())
    names = [robot.full_model.frames[item.parentFrame].name for item in geometry.geometryObjects]
    for i, one in enumerate(names):
        for j in range(i):
            if frozenset((one, names[j])) in never:
                geometry.addCollisionPair(pin.CollisionPair(j, i))
    data, shapes = robot.full_model.createData(), pin.GeometryData(geometry)
    for q in sample_configurations(robot, 3000, np.random.default_rng(11)):
        assert not pin.computeCollisions(robot.full_model, data, geometry, shapes, q, True)


def test_links_that_can_collide_stay_checked():
    checked = RobotGeometry(ROBOT)
    pairs = {frozenset((checked.links[p.first], checked.links[p.second])) for p in checked.geometry.collisionPairs}
    for one, other in [("base_link", "forearm_link"), ("shoulder_link", "robotiq_85_base_link"),
                       ("upper_arm_link", "robotiq_85_left_finger_tip_link"), ("base_link", "wrist_3_link")]:
        assert frozenset((one, other)) in pairs
    fingers = [name for name in ROBOT.link_names if name.startswith("robotiq")]
    assert not any(pair <= set(fingers) for pair in pairs)


def test_panda_pairs_are_almost_those_of_its_manufacturer():
    manufacturer = {frozenset((item.get("link1"), item.get("link2")))
                    for item in ET.parse(PANDA.srdf).iter("disable_collisions")}
    with_shapes = {link for pair in named(disabled_pairs(PANDA, samples=1)) for link in pair}
    missed = {pair for pair in manufacturer if pair <= with_shapes} - named(disabled_pairs(PANDA))
    # The manufacturer disables two pairs whose shapes collide at about one sample in twelve.
    assert missed == {frozenset(("panda_link5", "panda_link7")), frozenset(("panda_link5", "panda_hand"))}


def test_srdf_contains_groups_and_poses_and_is_loaded_by_the_planner(tmp_path):
    text = srdf(ROBOT, disabled_pairs(ROBOT, samples=100))
    root = ET.fromstring(text)
    assert [group.get("name") for group in root.findall("group")] == ["ur_manipulator", "ur_gripper"]
    states = {(state.get("name"), state.get("group")): {j.get("name"): float(j.get("value", "nan")) for j in state}
              for state in root.findall("group_state")}
    assert set(states) == {("home", "ur_manipulator"), ("default", "ur_manipulator"),
                           ("open", "ur_gripper"), ("closed", "ur_gripper")}
    assert states["home", "ur_manipulator"]["shoulder_lift_joint"] == -2.36
    assert states["closed", "ur_gripper"]["robotiq_85_left_knuckle_joint"] == pytest.approx(0.8, abs=1e-5)
    path = tmp_path / "ur5.srdf"
    path.write_text(text)
    reduced = RobotModel.load(ROBOT.config.model_copy(update={"srdf": str(path)}))
    everything = RobotModel.load(ROBOT.config.model_copy(update={"srdf": ""}))
    counts = [len(RobotGeometry(robot).geometry.collisionPairs) for robot in (reduced, everything)]
    assert counts[0] < counts[1]


def robot_of(tmp_path, *parts):
    """Load a robot of links (`name`, position, size or file) and revolute or fixed joints (`parent`, `child`)."""
    text = ""
    for part in parts:
        if len(part) == 3:
            name, at, size = part
            shape = f'<mesh filename="{size}"/>' if size.endswith(".stl") else f'<box size="{size}"/>'
            shape = f'<origin xyz="{at}"/><geometry>{shape}</geometry>'
            text += f'<link name="{name}"><collision>{shape}</collision></link>'
        else:
            parent, child = part
            kind = "fixed" if child == "wall" else "revolute"
            text += (f'<joint name="to_{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
                     '<axis xyz="0 0 1"/><limit lower="-1.5" upper="1.5" velocity="1" effort="1"/></joint>')
    (tmp_path / "r.urdf").write_text(f'<robot name="r">{text}</robot>')
    tip = parts[-1][1] if parts[-1][1] != "wall" else parts[-1][0]
    return RobotModel.load(RobotConfig(
        name="r", urdf=str(tmp_path / "r.urdf"), joints=["to_arm", f"to_{tip}"], base_link="base", tcp_link=tip,
        named_poses={"home": [0, 0]}, acceleration_limits=[1, 1], jerk_limits=[1, 1]))


def test_links_that_always_touch_are_reported_as_always(tmp_path):
    robot = robot_of(tmp_path, ("base", "0 0 0", "0.2 0.2 0.2"), ("arm", "0 0 0", "0.02 0.02 0.02"),
                     ("tip", "0 0 0", "0.3 0.3 0.3"), ("base", "arm"), ("arm", "tip"))
    found = {(p.one, p.other): p.reason for p in disabled_pairs(robot, samples=20)}
    assert found == {("base", "arm"): "Adjacent", ("arm", "tip"): "Adjacent", ("base", "tip"): "Always"}


@pytest.mark.parametrize(("gap", "reason"), [(0.0002, "Always"), (0.02, None)])
def test_neighbors_that_almost_always_touch_are_disabled(gap, reason, tmp_path):
    """A box before a joint and a wall behind it, a gap [m] apart at position 0, touch when the joint turns."""
    robot = robot_of(tmp_path, ("base", "0 0 -1", "0.1 0.1 0.1"), ("arm", "0 0 0", "0.1 0.02 0.02"),
                     ("hand", "0 0 0.03", "0.02 0.02 0.01"), ("wall", f"0 {0.011 + gap} 0", "0.1 0.002 0.08"),
                     ("base", "arm"), ("arm", "hand"), ("hand", "wall"))
    found = {frozenset((p.one, p.other)): p.reason for p in disabled_pairs(robot, samples=400)}
    assert found.get(frozenset(("arm", "wall"))) == reason


@pytest.mark.parametrize(("post", "reason", "line"), [
    ([], "Hulls", r"base and tip are not checked: .* touch in 9\d.\d\d% of the poses, their shapes in 0.00%"),
    ([(0.0757, 0.0757)], None, "base and tip are checked: .* --allow-pair base tip leaves them out"),
])
def test_shapes_decide_where_hulls_of_links_two_joints_apart_almost_always_touch(post, reason, line, tmp_path):
    """The tip circles between the posts of the base, in their hull but for four directions."""
    corners = [(x, y) for x in (-0.1, 0.1) for y in (-0.1, 0.1)]
    boxes = [trimesh.creation.box((0.01, 0.01, 0.1)).apply_translation((x, y, 0)) for x, y in [*corners, *post]]
    trimesh.util.concatenate(boxes).export(tmp_path / "posts.stl")
    robot = robot_of(tmp_path, ("base", "0 0 0", "posts.stl"), ("arm", "0 0 0.2", "0.02 0.02 0.02"),
                     ("tip", "0.10702 0 0", "0.004 0.004 0.004"), ("base", "arm"), ("arm", "tip"))
    pairs, (overlap,) = survey_pairs(robot, samples=1000)
    assert {frozenset((p.one, p.other)): p.reason for p in pairs}.get(frozenset(("base", "tip"))) == reason
    assert re.fullmatch(line, overlap.line)
