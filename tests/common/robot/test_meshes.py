"""Meshes of the robot: files of every format, and pieces for viewers with colors and few triangles."""

import io
import json
import re
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from numpy.typing import NDArray

from common.config import RobotConfig
from common.errors import ConfigError
from common.planning.robot_geometry import convex_hulls
from common.robot.mesh_files import parts_of, triangles_of
from common.robot.model import RobotModel
from common.robot.visual_meshes import coarse, collision_pieces, visual_pieces
from tests.page.scene_cell import pieces_of, robot_of


def archive(name: str, content: bytes) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(name, content)
    return packed.getvalue()


def binary_gltf(accessor: dict[str, int]) -> bytes:
    """Return a mesh whose values are in another file, or nowhere."""
    text = json.dumps({
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}], "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"uri": "/dev/zero", "byteLength": 36}], "accessors": [accessor | {
            "componentType": 5126, "type": "VEC3"}]}).encode()
    return b"glTF" + struct.pack("<4I", 2, 20 + len(text), len(text), 0x4E4F534A) + text


BOX = trimesh.creation.box((0.1, 0.2, 0.3))
DAMAGED = {
    "empty.stl": b"",
    "cut_off.stl": BOX.export(file_type="stl")[:200],
    "cut_off.dae": BOX.export(file_type="dae")[:400],
    "no_xml.dae": b"solid?",
    "out_of_range.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 300\n",
    "nothing.obj": b"# nothing\n",
    "unknown.xyzzy": b"?",
    "lying_count.stl": bytes(80) + (4 * 10**9).to_bytes(4, "little") + BOX.export(file_type="stl")[84:],
    "no_number.stl": BOX.export(file_type="stl").replace(np.float32(0.05).tobytes(), np.float32(np.nan).tobytes()),
    "huge.obj": b"v 1e30 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "points.obj": b"v 0 0 0\nv 1 0 0\n",
    "unit.dae": BOX.export(file_type="dae").replace(b"<asset>", b'<asset><unit meter="0,001"/>'),
    "bomb.dae": archive("box.dae", b" " * 10**7),
    "bomb.zae": archive("box.dae", b" " * 10**7),
    "doubled.dae": BOX.export(file_type="dae").replace(b"<library_visual_scenes>", b"<library_nodes>" + b"".join(
        b'<node id="n%d">' % i + b'<instance_node url="#n%d"/>' % (i - 1) * 2 + b"</node>" for i in range(40))
        + b"</library_nodes><library_visual_scenes>").replace(
            b"</visual_scene>", b'<node><instance_node url="#n39"/></node></visual_scene>'),
    "announced.glb": binary_gltf({"count": 10**10}),
    "outside.glb": binary_gltf({"count": 3, "bufferView": 0}),
    "no_scene.dae": b"<COLLADA><asset/></COLLADA>",
    "word.obj": b"v 1 a 0\nf 1 2 3\n",
    "cut_off.glb": b"glTF",
}
UNREADABLE = {"no_scene.dae": "COLLADA", "word.obj": "OBJ", "out_of_range.obj": "OBJ", "cut_off.glb": "binary glTF"}


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
    assert message.startswith(f"robot.urdf: {str(path)!r} is a mesh that cannot be read") and "\n" not in message
    if name in UNREADABLE:
        assert message.endswith(f"read as {UNREADABLE[name]}: the file is damaged or of another format")


def test_file_larger_than_a_mesh_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "sparse.stl"
    with path.open("wb") as file:
        file.truncate(8 * 2**30)
    with pytest.raises(ConfigError, match="8590 MB, more than 100"):
        triangles_of("robot.urdf", path)


@pytest.mark.parametrize(("unit", "meters"), [("", 1.0), ('<unit meter="0.001" name="mm"/>', 0.001), ("<unit/>", 1.0)])
def test_unit_of_a_collada_file_counts_in_planning_and_on_the_page(tmp_path: Path, unit: str, meters: float) -> None:
    text = re.sub("<unit[^>]*>", "", BOX.export(file_type="dae").decode())
    (tmp_path / "box.dae").write_text(text.replace("</asset>", f"{unit}<up_axis>Y_UP</up_axis></asset>"))
    shape = '<geometry><mesh filename="box.dae" scale="2 2 2"/></geometry>'
    robot = post(tmp_path, links=f'<link name="foot"/><link name="arm"><visual>{shape}</visual><collision>{shape}'
                                 "</collision></link>")
    (piece,), (item,) = visual_pieces(robot), robot.full_geometry().geometryObjects
    for points in (piece.vertices, corners(item.geometry)):
        assert np.ptp(points, axis=0) == pytest.approx(np.array([0.2, 0.4, 0.6]) * meters, rel=1e-5)


@pytest.mark.parametrize("scale", [(0.1, 0.1, 0), (0.1, 1e-9, 0.1)])
def test_flat_mesh_is_a_thin_plate(tmp_path: Path, scale: tuple[float, ...]) -> None:
    turned = BOX.copy().apply_scale(scale).apply_transform(trimesh.transformations.rotation_matrix(0.7, (1, 2, 3)))
    turned.export(tmp_path / "flat.stl")
    robot = post(tmp_path, '<collision><geometry><mesh filename="flat.stl"/></geometry></collision>')
    (item,) = convex_hulls(robot.full_geometry()).geometryObjects
    found = np.array(item.geometry.points())
    across = np.linalg.svd(found - found.mean(axis=0))[2][2]
    assert np.ptp(found @ across) == pytest.approx(0.001, rel=1e-3)


@pytest.mark.parametrize("scale", ["1 0 0", "0 0 0", "1e5 1e5 1"])
def test_mesh_without_extent_or_far_too_large_is_named(tmp_path: Path, scale: str) -> None:
    BOX.export(tmp_path / "box.stl")
    robot = post(tmp_path, f'<collision><geometry><mesh filename="box.stl" scale="{scale}"/></geometry></collision>')
    with pytest.raises(ConfigError, match=r"box\.stl' is a mesh of .* m: (its corners lie on a line|check its unit)"):
        robot.full_geometry()


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
    folders = [str(folder) for folder in robot.package_folders]
    visuals = pin.buildGeomFromUrdfString(model, robot.urdf, pin.GeometryType.VISUAL, package_dirs=folders)
    for item in visuals.geometryObjects:
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
    ("<torus/>", "<torus> is an unknown shape; choices: box, capsule"),
])
def test_unreadable_mesh_and_unknown_shape_are_named(tmp_path: Path, shape: str, message: str) -> None:
    robot = post(tmp_path)
    (tmp_path / "box.unknown").write_text("no mesh")
    robot.urdf = robot.urdf.replace('<box size="0.2 0.4 1.0" />', shape)
    with pytest.raises(ConfigError, match=message):
        visual_pieces(robot)
