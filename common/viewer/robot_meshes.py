"""The robot's visual shapes as triangles: one piece for each link and colour, in the frame of the link."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import trimesh
from numpy.typing import NDArray

from common.errors import ConfigError
from common.robot.model import RobotModel

Array = NDArray[np.float64]
Rgb = tuple[int, int, int]

_SHARP = 0.52  # [rad] triangles that meet at more than this have an edge between them


@dataclass(frozen=True, eq=False)
class Piece:
    """Triangles of one link and one colour.

    Vertices are shared only where the surface is smooth, so that a viewer may average their normals.
    """

    link: str
    color: Rgb
    vertices: NDArray[np.float32]  # (n, 3) [m] in the frame of the link
    faces: NDArray[np.uint32]  # (m, 3)


def visual_pieces(robot: RobotModel) -> list[Piece]:
    """The visual shapes of all links, in the order of the links.

    Raises:
        ConfigError: a mesh is not there or can not be read.
    """
    found: dict[tuple[str, Rgb], list[tuple[Array, NDArray[np.int64]]]] = defaultdict(list)
    for item in robot.full_geometry(pin.GeometryType.VISUAL).geometryObjects:
        frame = robot.full_model.frames[item.parentFrame]
        T_link_shape = (frame.placement.inverse() * item.placement).homogeneous
        for color, mesh in _coloured(item):
            points = trimesh.transformations.transform_points(mesh.vertices, T_link_shape)
            found[frame.name, color].append((points, np.asarray(mesh.faces)))
    return [Piece(link, color, *_joined(parts)) for (link, color), parts in found.items()]


def coarse(pieces: Iterable[Piece], cell: float) -> list[Piece]:
    """The same links with few triangles, one colour each: vertices within the same cube of side `cell` [m] are one."""
    by_link: dict[str, list[Piece]] = defaultdict(list)
    for piece in pieces:
        by_link[piece.link].append(piece)
    result = []
    for link, parts in by_link.items():
        points, faces = _joined([(part.vertices, part.faces) for part in parts])
        _, cluster = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_inverse=True)
        cluster = cluster.reshape(-1)
        counts = np.bincount(cluster)
        centres = np.stack([np.bincount(cluster, points[:, axis]) / counts for axis in range(3)], axis=1)
        corners = cluster[faces]
        distinct = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
        corners = np.unique(corners[distinct], axis=0)
        result.append(Piece(link, parts[0].color, centres.astype(np.float32), corners.astype(np.uint32)))
    return result


def _joined(parts: Sequence[tuple[Any, Any]]) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    offsets = np.cumsum([0, *(len(points) for points, _ in parts[:-1])])
    faces = np.concatenate([faces + offset for (_, faces), offset in zip(parts, offsets, strict=True)])
    return np.concatenate([points for points, _ in parts]).astype(np.float32), faces.astype(np.uint32)


def _coloured(item: Any) -> list[tuple[Rgb, trimesh.Trimesh]]:
    """The triangles of a visual shape by colour; that of the URDF counts more than that of the file."""
    given = _rgb(item.meshColor[:3] * 255)
    path = Path(item.meshPath)
    if not path.is_file():
        return [(given, _primitive(item.geometry))]
    try:
        scene = trimesh.load_scene(path)
    except (ValueError, OSError) as error:
        raise ConfigError("robot.urdf", str(path), f"is a mesh that can not be read: {error}") from None
    meshes = []
    for mesh in scene.dump():
        if isinstance(mesh, trimesh.Trimesh):
            own = None if item.overrideMaterial else _own_color(mesh)
            mesh.vertices = mesh.vertices * item.meshScale
            meshes.append((own or given, _smoothed(mesh)))
    return meshes


def _smoothed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same triangles, with vertices shared wherever no edge is: exporters like to give each triangle its own."""
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    merged = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    smoothed: trimesh.Trimesh = trimesh.graph.smooth_shade(merged, angle=_SHARP)
    return smoothed


def _own_color(mesh: trimesh.Trimesh) -> Rgb | None:
    """The colour that the file gives to a mesh; None when it gives none."""
    look: Any = mesh.visual
    material = getattr(look, "material", None)
    if material is not None:
        return _rgb(material.main_color[:3])
    return _rgb(look.main_color[:3]) if look.defined else None


def _primitive(shape: coal.CollisionGeometry) -> trimesh.Trimesh:
    """A shape that the URDF describes by its dimensions [m]."""
    if isinstance(shape, coal.Box):
        mesh = trimesh.creation.box(extents=2 * np.array(shape.halfSide))
    elif isinstance(shape, coal.Cylinder):
        mesh = trimesh.creation.cylinder(radius=shape.radius, height=2 * shape.halfLength, sections=32)
    elif isinstance(shape, coal.Capsule):
        mesh = trimesh.creation.capsule(radius=shape.radius, height=2 * shape.halfLength)
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
    elif isinstance(shape, coal.Sphere):
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=shape.radius)
    else:
        raise ConfigError("robot.urdf", type(shape).__name__, "is a visual shape that is not known")
    return _smoothed(mesh)


def _rgb(values: Iterable[float]) -> Rgb:
    r, g, b = (round(float(value)) for value in values)
    return r, g, b
