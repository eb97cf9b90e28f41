"""What the visuals of a URDF say: which shape, where in its link, in which colour.

Read here and not by pinocchio, which would load every mesh without its colours, all in one call that lets nothing else
of the process run for half a second, on a busy machine for many.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from common.errors import ConfigError
from common.robot.description import find_description
from common.robot.model import RobotModel
from common.robot.transforms import rpy_to_matrix, transform

Array = NDArray[np.float64]
Rgb = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Visual:
    """A shape of a link: a file with its scale, or a mesh that was made from dimensions."""

    link: str
    T_link_shape: Array
    color: Rgb | None  # None: the file's own
    path: Path | None = None
    scale: tuple[float, ...] = (1.0, 1.0, 1.0)
    primitive: trimesh.Trimesh | None = None


def visuals_of(robot: RobotModel) -> Iterator[Visual]:
    """Every visual of the robot, in the order of its URDF.

    Raises:
        ConfigError: a mesh is not there, or a shape is not known.
    """
    root = ET.fromstring(robot.urdf)
    named = {str(m.get("name")): rgb for m in root.iter("material") if (rgb := _given(m)) is not None}
    for link in root.findall("link"):
        for visual in link.findall("visual"):
            origin, material, shape = visual.find("origin"), visual.find("material"), visual.find("geometry/*")
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
                yield Visual(name, T, color, path, _numbers(shape, "scale", "1 1 1"))
            else:
                yield Visual(name, T, color, primitive=_primitive(shape))


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
    r, g, b = (round(255 * value) for value in _numbers(color, "rgba", "1 1 1 1")[:3])
    return r, g, b


def _numbers(element: ET.Element | None, name: str, usual: str) -> tuple[float, ...]:
    text = element.get(name, usual) if element is not None else usual
    return tuple(float(value) for value in text.split())
