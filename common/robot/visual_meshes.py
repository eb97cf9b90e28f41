"""The robot's shapes as triangles: one piece for each link and colour, in the frame of the link.

The URDF is read here and not by pinocchio, which would load every mesh without its colours, all in one call that lets
nothing else of the process run for half a second, on a busy machine for many.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import fast_simplification
import numpy as np
import trimesh
from numpy.typing import NDArray

from common.errors import ConfigError
from common.mesh_files import parts_of
from common.robot.description import find_description
from common.robot.model import RobotModel
from common.robot.transforms import rpy_to_matrix, transform

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Rgb = tuple[int, int, int]

_PLAIN: Rgb = (230, 230, 230)  # where neither URDF nor file give a colour
_FEW = 150  # triangles of a connected part that are always kept
_SHRINKS = 2e-3  # [m] the box about a part may change by less
_SHARP = 0.6  # [rad] triangles that meet at more than this have an edge between them
_LARGE = 0.1  # of a surface: a plane that is larger has an edge all around
_FLAT = 5000.0  # squared radius that two triangles bend at by their span: more is a plane, as trimesh has it


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
    """What is seen of all links with about so many triangles in all, in the order of the links.

    Descriptions come with 100 000 and more, which a browser without a graphics card draws once a second. Links that are
    described by collision shapes alone are seen as these.

    Raises:
        ConfigError: a mesh is not there or cannot be read.
    """
    return _pieces(seen_shapes(robot), triangles)


def collision_pieces(robot: RobotModel, triangles: int = 12_000) -> list[Piece]:
    """The collision shapes of all links, with about so many triangles in all.

    Raises:
        ConfigError: a mesh is not there or cannot be read.
    """
    return _pieces(shapes_of(robot, "collision"), triangles)


def _pieces(shapes: Iterable[Shape], triangles: int) -> list[Piece]:
    found: dict[tuple[str, Rgb], list[trimesh.Trimesh]] = defaultdict(list)
    for shape in shapes:
        for color, mesh in _coloured(shape):
            found[shape.link, color].append(mesh.apply_transform(shape.T_link_shape))
    joined = [_merged(trimesh.util.concatenate(meshes)) for meshes in found.values()]
    kept = triangles / max(1, sum(len(mesh.faces) for mesh in joined))
    return [_piece(link, color, _simplified(mesh, kept)) for (link, color), mesh in zip(found, joined, strict=True)]


def coarse(pieces: Iterable[Piece], kept: float) -> list[Piece]:
    """One piece for each link with a share of its triangles, for what is shown in one colour: that of the first."""
    found: dict[str, list[Piece]] = defaultdict(list)
    for piece in pieces:
        found[piece.link].append(piece)
    joined = []
    for link, parts in found.items():
        meshes = [trimesh.Trimesh(part.vertices, part.faces, process=False) for part in parts]
        mesh = _simplified(_merged(trimesh.util.concatenate(meshes)), kept)
        joined.append(_piece(link, parts[0].color, mesh))
    return joined


def _merged(mesh: Any) -> trimesh.Trimesh:
    """The same triangles with one vertex at each place: exporters like to give each triangle its own."""
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def _simplified(mesh: trimesh.Trimesh, kept: float) -> trimesh.Trimesh:
    """About that share of the triangles, by quadric error.

    Each connected part by itself, since among others small ones are lost first; those of few triangles stay as they
    are, as do those that would shrink.
    """
    groups = _groups(_parts(mesh.face_adjacency, len(mesh.faces)))
    parts: Any = mesh.submesh(groups, only_watertight=False, repair=True)  # small holes are filled
    return cast(trimesh.Trimesh, trimesh.util.concatenate([_simplified_part(part, kept) for part in parts]))


def _parts(edges: Indices, count: int) -> Indices:
    """(count,) number of the connected part of each node, which is its lowest node, by the (n, 2) edges between nodes.

    trimesh asks networkx for them where scipy is not installed, which takes half of the time that a robot takes.
    """
    lowest = np.arange(count)
    while (lowest[edges[:, 0]] != lowest[edges[:, 1]]).any():
        ends = lowest[edges]
        np.minimum.at(lowest, ends.max(axis=1), ends.min(axis=1))
        while (lowest[lowest] != lowest).any():
            lowest = lowest[lowest]
    return lowest


def _groups(parts: Indices) -> list[Indices]:
    """The nodes of each part."""
    order = np.argsort(parts, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(parts[order])) + 1)


def _simplified_part(part: trimesh.Trimesh, kept: float) -> trimesh.Trimesh:
    count = max(_FEW, round(kept * len(part.faces)))
    if len(part.faces) <= count:
        return part
    vertices, faces = fast_simplification.simplify(
        np.asarray(part.vertices), np.asarray(part.faces, dtype=np.int32), target_count=count, agg=5,
        preserve_border=True,
    )
    simple = trimesh.Trimesh(vertices, faces, process=False)
    return simple if np.abs(simple.bounds - part.bounds).max() < _SHRINKS else part


def _piece(link: str, color: Rgb, mesh: trimesh.Trimesh) -> Piece:
    """A vertex for each place and smooth surface there: a large plane is one of its own, whatever it meets at."""
    adjacent, faces = mesh.face_adjacency, np.asarray(mesh.faces)
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = ~((mesh.face_adjacency_radius / mesh.face_adjacency_span) ** 2 <= _FLAT)
    planes = _parts(adjacent[flat], len(faces))
    large = (np.bincount(planes, mesh.area_faces, len(faces)) > _LARGE * mesh.area)[planes]
    alone = large & (np.bincount(planes, minlength=len(faces))[planes] > 1)
    smooth = (mesh.face_adjacency_angles < _SHARP) & ~alone[adjacent].any(axis=1)
    surface = np.where(alone, planes, _parts(adjacent[smooth], len(faces)))
    corners = np.stack([faces.ravel(), np.repeat(surface, 3)])
    shared, index = np.unique(corners, axis=1, return_inverse=True)
    return Piece(link, color, np.asarray(mesh.vertices[shared[0]], dtype=np.float32),
                 index.reshape(-1, 3).astype(np.uint32))


def _coloured(shape: Shape) -> list[tuple[Rgb, trimesh.Trimesh]]:
    """The triangles of a shape by colour; that of the URDF counts more than that of the file."""
    if shape.path is None:
        return [(shape.color or _PLAIN, _merged(shape.primitive))]
    meshes = []
    for mesh in parts_of("robot.urdf", shape.path):
        color = shape.color or _own_color(mesh) or _PLAIN
        mesh.vertices = mesh.vertices * np.array(shape.scale)
        meshes.append((color, _merged(mesh)))
    return meshes


def _own_color(mesh: trimesh.Trimesh) -> Rgb | None:
    """The colour that the file gives to a mesh; None when it gives none."""
    look: Any = mesh.visual
    material = getattr(look, "material", None)
    if material is not None:
        return _rgb(material.main_color[:3])
    return _rgb(look.main_color[:3]) if look.defined else None


def _rgb(values: Iterable[float]) -> Rgb:
    r, g, b = (round(float(value)) for value in values)
    return r, g, b


@dataclass(frozen=True, eq=False)
class Shape:
    """A shape of a link: a file with its scale, or a mesh that was made from dimensions."""

    link: str
    T_link_shape: Array
    color: Rgb | None  # None: the file's own
    path: Path | None = None
    scale: tuple[float, ...] = (1.0, 1.0, 1.0)
    primitive: trimesh.Trimesh | None = None


def seen_shapes(robot: RobotModel) -> list[Shape]:
    """The visuals of the robot, and the collision shapes of links that would not be seen otherwise.

    A link without visuals that hangs on one with some is left as it is: descriptions have such for coarse shapes, about
    what is seen already.
    """
    visuals = list(shapes_of(robot, "visual"))
    seen = {shape.link for shape in visuals}
    above = {str(joint.find("child").get("link")): str(joint.find("parent").get("link"))  # type: ignore[union-attr]
             for joint in ET.fromstring(robot.urdf).iter("joint")
             if joint.get("type") == "fixed" and joint.find("child") is not None and joint.find("parent") is not None}
    return visuals + [shape for shape in shapes_of(robot, "collision")
                      if shape.link not in seen and above.get(shape.link) not in seen]


def shapes_of(robot: RobotModel, kind: Literal["visual", "collision"]) -> Iterator[Shape]:
    """Every shape of a kind, in the order of the robot's URDF.

    Raises:
        ConfigError: a mesh is not there, or a shape is not known.
    """
    root = ET.fromstring(robot.urdf)
    named = {str(m.get("name")): rgb for m in root.iter("material") if (rgb := _given(m)) is not None}
    for link in root.findall("link"):
        for part in link.findall(kind):
            origin, material, shape = part.find("origin"), part.find("material"), part.find("geometry/*")
            if shape is None:
                continue
            color = named.get(str(material.get("name"))) if material is not None else None
            if material is not None:
                color = _given(material) or color
            at = _numbers(origin, "xyz", "0 0 0")
            T = transform(rpy_to_matrix(*_numbers(origin, "rpy", "0 0 0")), (at[0], at[1], at[2]))
            name = str(link.get("name"))
            if shape.tag == "mesh":
                path = find_description("robot.urdf", str(shape.get("filename")), robot.config.package_dirs)
                yield Shape(name, T, color, path, _numbers(shape, "scale", "1 1 1"))
            else:
                yield Shape(name, T, color, primitive=_primitive(shape))


def _primitive(shape: ET.Element) -> trimesh.Trimesh:
    """A shape that is described by its dimensions [m]."""
    made: trimesh.Trimesh
    if shape.tag == "box":
        made = trimesh.creation.box(extents=_numbers(shape, "size", ""))
    elif shape.tag in ("cylinder", "capsule"):
        radius, length = float(shape.get("radius", "nan")), float(shape.get("length", "nan"))
        if shape.tag == "cylinder":
            made = trimesh.creation.cylinder(radius=radius, height=length, sections=32)
        else:
            made = trimesh.creation.capsule(radius=radius, height=length)
            made.apply_translation(-made.bounds.mean(axis=0))
    elif shape.tag == "sphere":
        made = trimesh.creation.icosphere(subdivisions=3, radius=float(shape.get("radius", "nan")))
    else:
        raise ConfigError("robot.urdf", shape.tag, "is no visual shape; choices: box, capsule, cylinder, mesh, sphere")
    return made


def _given(material: ET.Element) -> Rgb | None:
    color = material.find("color")
    if color is None:
        return None
    return _rgb(255 * value for value in _numbers(color, "rgba", "1 1 1 1")[:3])


def _numbers(element: ET.Element | None, name: str, usual: str) -> tuple[float, ...]:
    text = element.get(name, usual) if element is not None else usual
    return tuple(float(value) for value in text.split())
