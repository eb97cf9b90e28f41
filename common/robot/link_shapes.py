"""Shapes of a URDF's links, read strictly: what other readers skip with a warning is an error here."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from common.errors import ConfigError
from common.robot.description_values import FARTHEST, LARGEST, numbers
from common.robot.transforms import rpy_to_matrix, transform

Array = NDArray[np.float64]
Rgb = tuple[int, int, int]
Kind = Literal["collision", "visual"]

THINNEST = 1e-4  # [m] of a box, cylinder or sphere with a side of 0
_SIZES = {"box": {"size": 3}, "capsule": {"radius": 1, "length": 1}, "cylinder": {"radius": 1, "length": 1},
          "mesh": {}, "sphere": {"radius": 1}}


@dataclass(frozen=True, eq=False)
class Shape:
    """A shape of a link: a mesh file with its scale, or a body with dimensions.

    Attributes:
        size: [m] of a box its sides, of a cylinder or capsule radius and length, of a sphere its radius; of a mesh the
            factors of its scale.
        T_link_shape: pose (4, 4) in the frame of the link.
        color: None: that of the file.
        file: reference to the mesh.
    """

    link: str
    kind: str
    size: tuple[float, ...]
    T_link_shape: Array
    color: Rgb | None = None
    file: str = ""


def link_shapes(root: ET.Element, kind: Kind, field: str, source: str) -> Iterator[Shape]:
    """Yield every shape of a kind, in the order of the URDF.

    Args:
        root: of the URDF.
        kind: of the shapes.
        field, source: field of the configuration and its value, for the error.

    Raises:
        ConfigError: a shape is incomplete or unknown; names the link and the value.
    """
    named = {str(m.get("name")): rgb for m in root.iter("material") if (rgb := _material_color(m)) is not None}
    for link in root.findall("link"):
        for part in link.findall(kind):
            try:
                yield _shape(str(link.get("name")), part, named)
            except ValueError as error:
                problem = f"link {link.get('name')} has a {kind} shape that cannot be read: {error}"
                raise ConfigError(field, source, f"is no usable description: {problem}") from None


def pose_of_origin(origin: ET.Element | None, bound: float = LARGEST) -> Array:
    """Return the pose (4, 4) of an <origin>; raise ValueError if a number is unusable."""
    x, y, z = numbers(origin, "xyz", 3, "0 0 0", bound)
    return transform(rpy_to_matrix(*numbers(origin, "rpy", 3, "0 0 0", bound)), (x, y, z))


def _shape(link: str, part: ET.Element, colors: dict[str, Rgb]) -> Shape:
    origin, material, geometry = part.find("origin"), part.find("material"), part.find("geometry/*")
    if geometry is None:
        raise ValueError("it has no <geometry> with a shape")
    if geometry.tag not in _SIZES:
        raise ValueError(f"<{geometry.tag}> is an unknown shape; choices: {', '.join(_SIZES)}")
    if unknown := set(origin.keys() if origin is not None else ()) - {"xyz", "rpy"}:
        raise ValueError(f"{unknown.pop()} of <origin> is unknown; choices: xyz, rpy")
    T = pose_of_origin(origin, FARTHEST)
    color = None
    if material is not None:
        color = _material_color(material) or colors.get(str(material.get("name")))
    if geometry.tag == "mesh":
        if not geometry.get("filename"):
            raise ValueError("<mesh> has no filename")
        return Shape(link, "mesh", numbers(geometry, "scale", 3, "1 1 1"), T, color, str(geometry.get("filename")))
    size = [value for name, count in _SIZES[geometry.tag].items() for value in numbers(geometry, name, count)]
    if min(size) < 0:
        raise ValueError(f"<{geometry.tag}> has a negative side: {min(size):g}")
    return Shape(link, geometry.tag, tuple(max(value, THINNEST) for value in size), T, color)


def _material_color(material: ET.Element) -> Rgb | None:
    """Return the colour of a material, or None without a usable one: a colour decides nothing."""
    color = material.find("color")
    if color is None:
        return None
    try:
        return rgb([255 * float(value) for value in color.get("rgba", "1 1 1").split()[:3]])
    except (ValueError, OverflowError):
        return None


def rgb(values: Iterable[float]) -> Rgb:
    """Return a colour from numbers of 0 to 255."""
    r, g, b = (round(float(value)) for value in values)
    return r, g, b
