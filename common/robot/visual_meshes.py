"""The robot's shapes as triangles: one piece for each link and colour, in the frame of the link.

The URDF is read here and not by pinocchio, which loads meshes without their colours, all in one call that blocks the
process for half a second, on a busy machine for several.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import fast_simplification
import numpy as np
import trimesh
from numpy.typing import NDArray

from common.robot.link_shapes import Kind, Rgb, Shape, link_shapes, rgb
from common.robot.mesh_files import parts_of
from common.robot.model import RobotModel
from common.robot.urdf import find_description

Indices = NDArray[np.intp]

_PLAIN: Rgb = (230, 230, 230)  # without a colour in URDF and file
_MIN_TRIANGLES = 150  # of a connected part
_MAX_SHRINK = 2e-3  # [m] change of the bounding box of a simplified part
_SHARP = 0.6  # [rad] angle of two triangles from which their common edge is sharp
_LARGE = 0.1  # of a surface: a larger plane has sharp edges all around
_FLAT = 5000.0  # squared ratio of bending radius and span of two triangles: more is a plane, as in trimesh


@dataclass(frozen=True, eq=False)
class Piece:
    """Triangles of one link and one colour.

    Vertices are shared only where the surface is smooth, so that a viewer may average their normals.
    """

    link: str
    color: Rgb
    vertices: NDArray[np.float32]  # (n, 3) [m] in the frame of the link
    faces: NDArray[np.uint32]  # (m, 3)


def visual_pieces(robot: RobotModel, triangles: int = 25_000) -> list[Piece]:
    """Return the visible pieces of all links with about so many triangles in all, in the order of the links.

    Descriptions have 100 000 and more, which a browser without a graphics card draws once a second. Links with
    collision shapes only are drawn as these.

    Raises:
        ConfigError: a mesh is missing or cannot be read.
    """
    return _pieces(robot, visible_shapes(robot), triangles)


def collision_pieces(robot: RobotModel, triangles: int = 12_000) -> list[Piece]:
    """Return the collision shapes of all links, with about so many triangles in all.

    Raises:
        ConfigError: a mesh is missing or cannot be read.
    """
    return _pieces(robot, urdf_shapes(robot, "collision"), triangles)


def _pieces(robot: RobotModel, shapes: Iterable[Shape], triangles: int) -> list[Piece]:
    found: dict[tuple[str, Rgb], list[trimesh.Trimesh]] = defaultdict(list)
    for shape in shapes:
        for color, mesh in _coloured(robot, shape):
            found[shape.link, color].append(mesh.apply_transform(shape.T_link_shape))
    joined = [_merged(trimesh.util.concatenate(meshes)) for meshes in found.values()]
    share = triangles / max(1, sum(len(mesh.faces) for mesh in joined))
    return [_piece(link, color, _simplified(mesh, share)) for (link, color), mesh in zip(found, joined, strict=True)]


def coarse(pieces: Iterable[Piece], share: float) -> list[Piece]:
    """Return one piece for each link with a share of its triangles, in the colour of the first."""
    found: dict[str, list[Piece]] = defaultdict(list)
    for piece in pieces:
        found[piece.link].append(piece)
    joined = []
    for link, parts in found.items():
        meshes = [trimesh.Trimesh(part.vertices, part.faces, process=False) for part in parts]
        mesh = _simplified(_merged(trimesh.util.concatenate(meshes)), share)
        joined.append(_piece(link, parts[0].color, mesh))
    return joined


def _merged(mesh: Any) -> trimesh.Trimesh:
    """Return the same triangles with shared vertices: exporters often give each triangle its own."""
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def _simplified(mesh: trimesh.Trimesh, share: float) -> trimesh.Trimesh:
    """Return about that share of the triangles, by quadric error.

    Each connected part separately, since small ones would be lost first. Parts of few triangles and those that would
    shrink stay unchanged.
    """
    groups = _groups(_parts(mesh.face_adjacency, len(mesh.faces)))
    parts: Any = mesh.submesh(groups, only_watertight=False, repair=True)  # small holes are filled
    return cast(trimesh.Trimesh, trimesh.util.concatenate([_simplified_part(part, share) for part in parts]))


def _parts(edges: Indices, count: int) -> Indices:
    """Return (count,) the lowest node of each node's connected part, by the (n, 2) edges between nodes.

    Without scipy, trimesh computes this with networkx, which takes half of the time of a robot.
    """
    lowest = np.arange(count)
    while (lowest[edges[:, 0]] != lowest[edges[:, 1]]).any():
        ends = lowest[edges]
        np.minimum.at(lowest, ends.max(axis=1), ends.min(axis=1))
        while (lowest[lowest] != lowest).any():
            lowest = lowest[lowest]
    return lowest


def _groups(parts: Indices) -> list[Indices]:
    """Return the nodes of each part."""
    order = np.argsort(parts, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(parts[order])) + 1)


def _simplified_part(part: trimesh.Trimesh, share: float) -> trimesh.Trimesh:
    count = max(_MIN_TRIANGLES, round(share * len(part.faces)))
    if len(part.faces) <= count:
        return part
    vertices, faces = fast_simplification.simplify(
        np.asarray(part.vertices), np.asarray(part.faces, dtype=np.int32), target_count=count, agg=5,
        preserve_border=True,
    )
    simple = trimesh.Trimesh(vertices, faces, process=False)
    return simple if np.abs(simple.bounds - part.bounds).max() < _MAX_SHRINK else part


def _piece(link: str, color: Rgb, mesh: trimesh.Trimesh) -> Piece:
    """Return a piece with a vertex for each position and smooth surface; each large plane is a surface of its own."""
    adjacent, faces = mesh.face_adjacency, np.asarray(mesh.faces)
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = ~((mesh.face_adjacency_radius / mesh.face_adjacency_span) ** 2 <= _FLAT)
    planes = _parts(adjacent[flat], len(faces))
    large = (np.bincount(planes, mesh.area_faces, len(faces)) > _LARGE * mesh.area)[planes]
    separate = large & (np.bincount(planes, minlength=len(faces))[planes] > 1)
    smooth = (mesh.face_adjacency_angles < _SHARP) & ~separate[adjacent].any(axis=1)
    surface = np.where(separate, planes, _parts(adjacent[smooth], len(faces)))
    corners = np.stack([faces.ravel(), np.repeat(surface, 3)])
    shared, index = np.unique(corners, axis=1, return_inverse=True)
    return Piece(link, color, np.asarray(mesh.vertices[shared[0]], dtype=np.float32),
                 index.reshape(-1, 3).astype(np.uint32))


def _coloured(robot: RobotModel, shape: Shape) -> list[tuple[Rgb, trimesh.Trimesh]]:
    """Return the triangles of a shape by colour; the URDF's colour overrides the file's."""
    if not shape.file:
        return [(shape.color or _PLAIN, _merged(_primitive(shape)))]
    meshes = []
    for mesh in parts_of("robot.urdf", mesh_path(robot, shape)):
        color = shape.color or _file_color(mesh) or _PLAIN
        mesh.vertices = mesh.vertices * np.array(shape.size)
        meshes.append((color, _merged(mesh)))
    return meshes


def _file_color(mesh: trimesh.Trimesh) -> Rgb | None:
    """Return the colour of a mesh in its file, or None."""
    visual: Any = mesh.visual
    material = getattr(visual, "material", None)
    if material is not None:
        return rgb(material.main_color[:3])
    return rgb(visual.main_color[:3]) if visual.defined else None


def visible_shapes(robot: RobotModel) -> list[Shape]:
    """Return the visuals of the robot, and the collision shapes of links without visuals.

    A link without visuals whose parent has some is skipped: descriptions have such links for coarse shapes about the
    visible ones.
    """
    visuals = list(urdf_shapes(robot, "visual"))
    seen = {shape.link for shape in visuals}
    above = {str(joint.find("child").get("link")): str(joint.find("parent").get("link"))  # type: ignore[union-attr]
             for joint in ET.fromstring(robot.urdf).iter("joint")
             if joint.get("type") == "fixed" and joint.find("child") is not None and joint.find("parent") is not None}
    return visuals + [shape for shape in urdf_shapes(robot, "collision")
                      if shape.link not in seen and above.get(shape.link) not in seen]


def urdf_shapes(robot: RobotModel, kind: Kind) -> Iterator[Shape]:
    """Yield every shape of a kind, in the order of the robot's URDF."""
    return link_shapes(ET.fromstring(robot.urdf), kind, "robot.urdf", robot.config.urdf)


def mesh_path(robot: RobotModel, shape: Shape) -> Path:
    """Return the file of a mesh.

    Raises:
        ConfigError: it is missing.
    """
    return find_description("robot.urdf", shape.file, robot.config.package_dirs)


def _primitive(shape: Shape) -> trimesh.Trimesh:
    """Return the mesh of a shape that is described by its dimensions [m]."""
    mesh: trimesh.Trimesh
    if shape.kind == "box":
        mesh = trimesh.creation.box(extents=shape.size)
    elif shape.kind == "cylinder":
        mesh = trimesh.creation.cylinder(radius=shape.size[0], height=shape.size[1], sections=32)
    elif shape.kind == "capsule":
        mesh = trimesh.creation.capsule(radius=shape.size[0], height=shape.size[1])
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
    else:
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=shape.size[0])
    return mesh
