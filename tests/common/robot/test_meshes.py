"""Meshes of the robot: files of every format, and pieces for viewers with colors and few triangles."""

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from numpy.typing import NDArray

from common.config import RobotConfig
from common.errors import ConfigError
from common.robot.mesh_files import parts_of, triangles_of
from common.robot.model import RobotModel
from common.robot.visual_meshes import coarse, collision_pieces, visual_pieces
from tests.page.scene_cell import pieces_of, robot_of

BOX = trimesh.creation.box((0.1, 0.2, 0.3))
DAMAGED = {
    "empty.stl": b"",
    "cut_off.stl": BOX.export(file_type="stl")[:200],
    "cut_off.dae": BOX.export(file_type="dae")[:400],
    "no_xml.dae": b"solid?",
    "out_of_range.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 300\n",
    "nothing.obj": b"# nothing\n",
    "unknown.xyzzy": b"?",
}


@pytest.mark.parametrize("suffix", ["stl", "dae", "obj"])
def test_mesh_is_read_from_every_format(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"box.{suffix}"
    path.write_bytes(data.encode() if isinstance(data := BOX.export(file_type=suffix), str) else data)
    assert np.ptp(triangles_of("robot.urdf", path).reshape(-1, 3), axis=0) == pytest.approx([0.1, 0.2, 0.3])
    (part,) = parts_of("robot.urdf", path)
    assert part.extents == pytest.approx([0.1, 0.2, 0.3])


@pytest.mark.parametrize("read", [triangles_of, parts_of])
@pytest.mark.parametrize("name", [*DAMAGED, "missing.stl"])
def test_damaged_mesh_is_named_in_a_line(tmp_path: Path, name: str, read) -> None:
    path = tmp_path / name
    if name in DAMAGED:
        path.write_bytes(DAMAGED[name])
    with pytest.raises(ConfigError) as refused:
        read("robot.urdf", path)
    message = str(refused.value)
    assert message.startswith(f"robot.urdf: {str(path)!r} is a mesh that cannot be read: ") and "\n" not in message


each_cell = pytest.mark.parametrize("cell", [pytest.param("panda", marks=pytest.mark.campaign), "ur5"])
HINGE = """<joint name="hinge" type="revolute"><parent link="foot"/><child link="arm"/>
  <origin xyz="0 0 1"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>"""
POST = """<material name="blue"><color rgba="0 0 1 1"/></material>
  <link name="foot">
    <visual><origin xyz="0 0 0.5"/><geometry><box size="0.2 0.4 1.0"/></geometry><material name="blue"/></visual>
    {extra}
  </link>
  <link name="arm">
    <visual><geometry><cylinder radius="0.1" length="0.6"/></geometry></visual>
    <visual><origin xyz="1 0 0"/><geometry><sphere radius="0.25"/></geometry></visual>
  </link>"""
COARSE = """<link name="foot"><collision><geometry><box size="0.2 0.4 1.0"/></geometry></collision></link>
  <link name="arm">{extra}<collision><geometry><sphere radius="0.25"/></geometry></collision></link>
  <joint name="fixed" type="fixed"><parent link="arm"/><child link="arm_coarse"/></joint>
  <link name="arm_coarse"><collision><geometry><sphere radius="0.5"/></geometry></collision></link>"""


def post(folder: Path, extra: str = "", links: str = POST) -> RobotModel:
    urdf = folder / "post.urdf"
    urdf.write_text(f'<robot name="post">{links.format(extra=extra)}{HINGE}</robot>')
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


def assert_same_extent(found: NDArray[np.float64], expected: NDArray[np.float64], tolerance: float) -> None:
    for one, other in ((found.min(axis=0), expected.min(axis=0)), (found.max(axis=0), expected.max(axis=0))):
        np.testing.assert_allclose(one, other, atol=tolerance)


@pytest.mark.parametrize(("visual", "links"), [
    ("", ["arm", "arm_coarse", "foot"]),
    ('<visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual>', ["arm", "foot"]),
])
def test_links_with_collision_shapes_only_are_drawn_as_these(tmp_path: Path, visual: str, links: list[str]) -> None:
    robot = post(tmp_path, visual, COARSE)
    assert sorted({piece.link for piece in visual_pieces(robot)}) == links
    assert {piece.link for piece in collision_pieces(robot)} == {"foot", "arm", "arm_coarse"}


@each_cell
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
            assert_same_extent(np.concatenate(shown[link]), np.concatenate(parts), 0.004)


@each_cell
def test_colors_are_those_of_the_files_and_the_urdf(cell: str) -> None:
    caps, gripper = (64, 89, 104), (38, 38, 41)  # of the joints; by the URDF of the gripper
    colors = {"ur5": {caps, gripper}, "panda": {(255, 255, 255), (64, 64, 64)}}
    assert {piece.color for piece in pieces_of(cell)} >= colors[cell]


@each_cell
@pytest.mark.slow
def test_simplification_leaves_few_triangles_and_loses_no_part(cell: str) -> None:
    full_pieces, few = visual_pieces(robot_of(cell), 10**9), pieces_of(cell)
    assert sum(len(piece.faces) for piece in few) < 50_000 < sum(len(piece.faces) for piece in full_pieces)
    for full, simple in zip(full_pieces, few, strict=True):
        assert (simple.link, simple.color) == (full.link, full.color)
        assert simple.faces.max() < len(simple.vertices)
        assert_same_extent(simple.vertices, full.vertices, 0.003)


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
    np.testing.assert_allclose([arm.min(axis=0)[2], *arm.max(axis=0)[[0, 2]]], [-0.3, 1.25, 0.3], atol=1e-6)


@pytest.mark.parametrize(("mesh", "corners"), [
    (trimesh.creation.box(extents=(1, 2, 3)), 24), (trimesh.creation.icosphere(0), 60),  # split at sharp edges
    (trimesh.creation.icosphere(2), 162)])
def test_file_without_colors_gets_color_and_scale_of_the_urdf(tmp_path: Path, mesh, corners: int) -> None:
    mesh.export(tmp_path / "mesh.stl")
    visual = """<visual><geometry><mesh filename="mesh.stl" scale="0.1 0.1 0.1"/></geometry>
      <material name="red"><color rgba="1 0 0 1"/></material></visual>"""
    red = next(piece for piece in visual_pieces(post(tmp_path, visual)) if piece.color == (255, 0, 0))
    np.testing.assert_allclose(red.vertices.max(axis=0), 0.1 * mesh.vertices.max(axis=0), atol=1e-6)
    assert len(red.vertices) == corners


@pytest.mark.parametrize(("shape", "message"), [
    ('<mesh filename="/nowhere/box.stl"/>', r"nowhere/box\.stl"),
    ('<mesh filename="box.unknown"/>', r"box\.unknown"),
    ("<torus/>", "'torus' is an unknown shape; choices: box, capsule"),
])
def test_unreadable_mesh_and_unknown_shape_are_named(tmp_path: Path, shape: str, message: str) -> None:
    robot = post(tmp_path)
    (tmp_path / "box.unknown").write_text("no mesh")
    robot.urdf = robot.urdf.replace('<box size="0.2 0.4 1.0" />', shape)
    with pytest.raises(ConfigError, match=message):
        visual_pieces(robot)
