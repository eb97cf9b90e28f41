"""The links of a robot as triangles, from its collision geometry."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.robot.model import RobotModel
from common.robot.transforms import invert
from common.sim.solids import placed, primitive

Array = NDArray[np.float64]


def robot_shapes(robot: RobotModel) -> dict[str, Array]:
    """Triangles (n, 3, 3) [m] of every link that has a shape, in the frame of the link.

    Raises:
        ConfigError: a mesh is not there.
    """
    parts: dict[str, list[Array]] = {}
    for item in robot.full_geometry(pin.GeometryType.COLLISION).geometryObjects:
        frame = robot.full_model.frames[item.parentFrame]
        T_link_shape = invert(np.array(frame.placement.homogeneous)) @ np.array(item.placement.homogeneous)
        parts.setdefault(frame.name, []).append(placed(triangles(item.geometry), T_link_shape))
    return {link: np.concatenate(shapes) for link, shapes in parts.items()}


def triangles(shape: coal.CollisionGeometry) -> Array:
    """Triangles (n, 3, 3) [m] of one shape, about its own origin.

    Raises:
        ValueError: a shape that is neither mesh, box, cylinder, capsule nor sphere.
    """
    if isinstance(shape, coal.BVHModelBase):  # its points are scaled already
        corners = [[shape.tri_indices(i)[k] for k in range(3)] for i in range(shape.num_tris)]
        return np.asarray(np.array(shape.vertices())[np.array(corners)], dtype=float)
    if isinstance(shape, coal.Box):
        return primitive("box", [2 * float(half) for half in shape.halfSide])
    if isinstance(shape, coal.Sphere):
        return primitive("sphere", [float(shape.radius)])
    if isinstance(shape, coal.Cylinder | coal.Capsule):
        radius, half = float(shape.radius), float(shape.halfLength)
        tube = primitive("cylinder", [radius, 2 * half])
        if isinstance(shape, coal.Cylinder):
            return tube
        end, up = primitive("sphere", [radius]), np.array([0.0, 0.0, half])
        return np.concatenate([tube, end + up, end - up])
    raise ValueError(f"no triangles for a {type(shape).__name__}")
