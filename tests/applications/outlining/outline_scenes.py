"""Images of the worlds w1 to w6 and of other objects, and the distance of an outline from the true one."""

import functools

import numpy as np

from applications.outlining.contours import ContourOptions
from common.config import ObjectConfig, World, check, config_root, read_yaml
from common.perception.pinhole import Pinhole
from common.sim.objects import object_mesh, world_object
from common.sim.ray_caster import cast, empty_view
from common.sim.solids import fixture_mesh

WORLDS = ["w1", "w2", "w3", "w4", "w5", "w6"]
GROUND = (178 / 255,) * 3
SEED = ContourOptions(subpixel=False)
RED, BLUE, GREEN, YELLOW = (0, 0, 255), (255, 0, 0), (0, 255, 0), (0, 255, 255)


def rectangles(*boxes, size=(120, 160)):
    """Return an image [bgr8] of rectangles (left, top, width, height, bgr8) on black."""
    drawn = np.zeros((*size, 3), np.uint8)
    for left, top, width, height, color in boxes:
        drawn[top : top + height, left : left + width] = color
    return drawn


@functools.cache
def world(name: str) -> World:
    return check(World, read_yaml(config_root() / "worlds" / f"{name}.yaml"))


def upright(**fields) -> ObjectConfig:
    return ObjectConfig(**({"id": "thing", "z": 1.0} | fields))


def seen(objects, around=None):
    """Return camera, image [bgr8] and depth image [m] of objects on the target base."""
    around = around or world("w2")
    camera = Pinhole.from_config(around.camera)
    meshes = [fixture_mesh(f) for f in around.fixtures] + [object_mesh(world_object(o)) for o in objects]
    view = cast(meshes, camera, empty_view(camera, GROUND))
    return camera, view.colour, view.depth_within(0.10, 2.25)


@functools.cache
def seen_world(name: str):
    return seen(world(name).objects, world(name))


def distances(points, polygon):
    """Return the distance (n,) [m] of each of the points (n, 2) from a closed polygon (m, 2)."""
    p, a = np.asarray(points)[:, None, :2], np.asarray(polygon)[:, :2]
    side = np.roll(a, -1, axis=0) - a
    length = np.maximum((side**2).sum(axis=1), 1e-18)
    along = np.clip(((p - a) * side).sum(axis=2) / length, 0, 1)
    return np.linalg.norm(p - (a + along[..., None] * side), axis=2).min(axis=1)


def dense(points, step=2e-4):
    """Return points (k, 2) all along a closed polygon (n, 2 or 3)."""
    a = np.asarray(points)[:, :2]
    b = np.roll(a, -1, axis=0)
    return np.vstack([p + (q - p) * np.arange(n)[:, None] / n for p, q in zip(a, b, strict=True)
                      for n in [1 + int(np.linalg.norm(q - p) / step)]])
