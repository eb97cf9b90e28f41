"""Meshes of the robot for viewers: positions, colours, and number of triangles."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from common.config import RobotConfig
from common.errors import ConfigError
from common.robot.model import RobotModel
from common.robot.visual_meshes import _groups, _parts, _piece, coarse, collision_pieces, visual_pieces
from tests.page.scene_cell import pieces_of, robot_of

URDF = """<robot name="post">
  <material name="blue"><color rgba="0 0 1 1"/></material>
  <link name="foot">
    <visual><origin xyz="0 0 0.5"/><geometry><box size="0.2 0.4 1.0"/></geometry><material name="blue"/></visual>
    {extra}
  </link>
  <joint name="hinge" type="revolute">
    <parent link="foot"/><child link="arm"/><origin xyz="0 0 1"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/>
  </joint>
  <link name="arm">
    <visual><geometry><cylinder radius="0.1" length="0.6"/></geometry></visual>
    <visual><origin xyz="1 0 0"/><geometry><sphere radius="0.25"/></geometry></visual>
  </link>
</robot>"""


def post(folder: Path, extra: str = "") -> RobotModel:
    urdf = folder / "post.urdf"
    urdf.write_text(URDF.format(extra=extra))
    return RobotModel.load(RobotConfig(
        name="post", urdf=str(urdf), joints=["hinge"], base_link="foot", tcp_link="arm", named_poses={"home": [0.0]},
        acceleration_limits=[1.0], jerk_limits=[1.0],
    ))


def corners(geometry: Any) -> NDArray[np.float64]:
    if hasattr(geometry, "vertices"):
        return np.array(geometry.vertices())
    geometry.computeLocalAABB()
    low, high = np.array(geometry.aabb_local.min_), np.array(geometry.aabb_local.max_)
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


COARSE = """<robot name="post">
  <link name="foot"><collision><geometry><box size="0.2 0.4 1.0"/></geometry></collision></link>
  <joint name="hinge" type="revolute">
    <parent link="foot"/><child link="arm"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/>
  </joint>
  <link name="arm">{visual}<collision><geometry><sphere radius="0.25"/></geometry></collision></link>
  <joint name="fixed" type="fixed"><parent link="arm"/><child link="arm_coarse"/></joint>
  <link name="arm_coarse"><collision><geometry><sphere radius="0.5"/></geometry></collision></link>
</robot>"""


@pytest.mark.parametrize(
    ("visual", "links"),
    [("", ["arm", "arm_coarse", "foot"]),
     ('<visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual>', ["arm", "foot"])],
)
def test_links_with_collision_shapes_only_are_drawn_as_these(tmp_path: Path, visual: str, links: list[str]) -> None:
    with patch(f"{__name__}.URDF", COARSE.replace("{visual}", visual)):
        robot = post(tmp_path)
    assert sorted({piece.link for piece in visual_pieces(robot)}) == links
    assert {piece.link for piece in collision_pieces(robot)} == {"foot", "arm", "arm_coarse"}


@pytest.mark.parametrize("cell", ["panda", "ur5"])
@pytest.mark.slow
def test_every_visual_of_the_description_moves_with_its_link(cell: str) -> None:
    robot = robot_of(cell)
    model, data = robot.full_model, robot.full_model.createData()
    q = np.clip(robot.full_reference + 0.3, model.lowerPositionLimit, model.upperPositionLimit)
    arm = [float(q[model.joints[model.getJointId(name)].idx_q]) for name in robot.joint_names]
    others = {name: float(q[model.joints[model.getJointId(name)].idx_q]) for name in robot.config.locked_joints}
    links = robot.link_poses(arm, others)
    pin.forwardKinematics(model, data, q)
    described: dict[str, list[NDArray[np.float64]]] = {}
    for item in robot.full_geometry(pin.GeometryType.VISUAL).geometryObjects:
        T = (data.oMi[item.parentJoint] * item.placement).homogeneous
        points = corners(item.geometry) @ T[:3, :3].T + T[:3, 3]
        described.setdefault(model.frames[item.parentFrame].name, []).append(points)
    shown: dict[str, list[NDArray[np.float64]]] = {}
    for piece in pieces_of(cell):
        T = links[piece.link]
        shown.setdefault(piece.link, []).append(piece.vertices @ T[:3, :3].T + T[:3, 3])
    assert set(shown) == set(described)
    for link, parts in described.items():
        if not link.startswith("robotiq"):  # a cylinder has other extreme points than its bounding box
            expected, found = np.concatenate(parts), np.concatenate(shown[link])
            np.testing.assert_allclose(found.min(axis=0), expected.min(axis=0), atol=0.004)
            np.testing.assert_allclose(found.max(axis=0), expected.max(axis=0), atol=0.004)


def test_colours_are_those_of_the_files_and_the_urdf() -> None:
    colors = {piece.color for piece in pieces_of("ur5")}
    assert (64, 89, 104) in colors  # the caps of the joints
    assert (38, 38, 41) in colors  # the gripper, by its URDF
    assert {piece.color for piece in pieces_of("panda")} >= {(255, 255, 255), (64, 64, 64)}


@pytest.mark.parametrize("cell", ["panda", "ur5"])
@pytest.mark.slow
def test_simplification_leaves_few_triangles_and_loses_no_part(cell: str) -> None:
    robot = robot_of(cell)
    full_pieces = visual_pieces(robot, 10**9)
    few = pieces_of(cell)
    assert sum(len(piece.faces) for piece in few) < 50_000 < sum(len(piece.faces) for piece in full_pieces)
    for full, simple in zip(full_pieces, few, strict=True):
        assert (simple.link, simple.color) == (full.link, full.color)
        assert simple.faces.max() < len(simple.vertices)
        np.testing.assert_allclose(simple.vertices.min(axis=0), full.vertices.min(axis=0), atol=0.003)
        np.testing.assert_allclose(simple.vertices.max(axis=0), full.vertices.max(axis=0), atol=0.003)


@given(st.integers(1, 30), st.data())
def test_parts_are_connected_by_edges(count: int, data: st.DataObject) -> None:
    node = st.integers(0, count - 1)
    edges = data.draw(st.lists(st.tuples(node, node), max_size=40))
    lowest = list(range(count))
    for _ in range(count):
        for a, b in edges:
            lowest[a] = lowest[b] = min(lowest[a], lowest[b])
    parts = _parts(np.array(edges, dtype=np.intp).reshape(-1, 2), count)
    assert parts.tolist() == lowest
    groups = [sorted(group.tolist()) for group in _groups(parts)]
    assert sorted(groups) == sorted([i for i in range(count) if lowest[i] == part] for part in set(lowest))


@pytest.mark.parametrize("mesh", [
    trimesh.creation.box(), trimesh.creation.cylinder(1, 2), trimesh.creation.icosphere(), trimesh.creation.torus(2, 1),
    trimesh.creation.capsule(), trimesh.creation.cone(1, 3), trimesh.creation.cylinder(1, 2, sections=6),
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False),
])
def test_surfaces_are_split_at_sharp_edges_as_in_trimesh(mesh: trimesh.Trimesh) -> None:
    expected = trimesh.graph.smooth_shade(mesh, angle=0.6)
    piece = _piece("link", (0, 0, 0), mesh)
    assert len(piece.vertices) == len(expected.vertices)
    np.testing.assert_allclose(piece.vertices[piece.faces], mesh.triangles, atol=1e-6)


def test_coarse_pieces_have_fewer_triangles_of_the_same_links() -> None:
    pieces = pieces_of("panda")
    simple = coarse(pieces, 0.3)
    assert [piece.link for piece in simple] == list(dict.fromkeys(piece.link for piece in pieces))
    assert sum(len(piece.faces) for piece in simple) < 0.6 * sum(len(piece.faces) for piece in pieces)


def test_primitive_shapes_are_created_from_their_dimensions(tmp_path: Path) -> None:
    pieces = visual_pieces(post(tmp_path))
    box = next(piece for piece in pieces if piece.color == (0, 0, 255))
    np.testing.assert_allclose([box.vertices.min(axis=0), box.vertices.max(axis=0)], [[-0.1, -0.2, 0], [0.1, 0.2, 1]])
    assert len(box.vertices) == 24  # no corner is shared by two sides: their edges stay sharp
    arm = np.concatenate([piece.vertices for piece in pieces if piece.link == "arm"])
    np.testing.assert_allclose([arm.min(axis=0)[2], arm.max(axis=0)[2]], [-0.3, 0.3], atol=1e-6)
    np.testing.assert_allclose(arm.max(axis=0)[0], 1.25, atol=1e-6)


def test_file_without_colours_gets_colour_and_scale_of_the_urdf(tmp_path: Path) -> None:
    trimesh.creation.box(extents=(1, 2, 3)).export(tmp_path / "box.stl")
    visual = """<visual><geometry><mesh filename="box.stl" scale="0.1 0.1 0.1"/></geometry>
      <material name="red"><color rgba="1 0 0 1"/></material></visual>"""
    pieces = visual_pieces(post(tmp_path, visual))
    red = next(piece for piece in pieces if piece.color == (255, 0, 0))
    np.testing.assert_allclose(red.vertices.max(axis=0), [0.05, 0.1, 0.15])


def test_unreadable_mesh_is_named(tmp_path: Path) -> None:
    trimesh.creation.box().export(tmp_path / "box.stl")
    robot = post(tmp_path, '<visual><geometry><mesh filename="box.stl"/></geometry></visual>')
    robot.urdf = robot.urdf.replace("box.stl", "box.unknown")
    (tmp_path / "box.unknown").write_text("no mesh")
    with pytest.raises(ConfigError, match=r"box\.unknown"):
        visual_pieces(robot)


def test_missing_mesh_and_unknown_shape_are_named(tmp_path: Path) -> None:
    robot = post(tmp_path)
    good = robot.urdf
    robot.urdf = good.replace('<box size="0.2 0.4 1.0" />', '<mesh filename="/nowhere/box.stl"/>')
    with pytest.raises(ConfigError, match=r"nowhere/box\.stl"):
        visual_pieces(robot)
    robot.urdf = good.replace('<box size="0.2 0.4 1.0" />', "<torus/>")
    with pytest.raises(ConfigError, match="'torus' is an unknown shape; choices: box, capsule"):
        visual_pieces(robot)
