"""Pictures without OpenGL: a ray through the centre of each pixel, and light without shadows."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import Scenery
from common.perception.pinhole import Pinhole
from common.sim.lighting import CUTOFF, ambient, lamps, tint
from common.sim.ray_caster import View

Array = NDArray[np.float64]


def ray_view(
    model: mujoco.MjModel, data: mujoco.MjData, camera: Pinhole, scenery: Scenery, level: Array, far: float
) -> View:
    """The view of a model in a state, lit as its surfaces are turned to the light.

    Args:
        model: what there is.
        data: where it is: its kinematics are done.
        camera: intrinsics and pose.
        scenery: the light.
        level: (3,) [lx] of blue, green and red light that is the value 255.
        far: how far rays go [m].
    """
    v, u = np.mgrid[0:camera.height, 0:camera.width]
    rays = camera.directions(np.column_stack([u.ravel(), v.ravel()]))
    count = len(rays)
    geoms, distances, found = np.full(count, -1, np.int32), np.full(count, -1.0), np.zeros(3 * count)
    all_groups, eye = np.ones(mujoco.mjNGROUP, np.uint8), camera.position
    mujoco.mj_multiRay(model, data, eye, rays.ravel(), all_groups, True, -1, geoms, distances, found, count, far)
    hit, normals = geoms >= 0, found.reshape(-1, 3)
    normals *= np.where(np.sum(normals * rays, axis=1) > 0, -1.0, 1.0)[:, None]  # on the side that is seen
    points = camera.position + distances[:, None] * rays
    light = np.broadcast_to(ambient(scenery), (count, 3)).copy()
    for lamp in lamps(scenery):
        way = np.subtract(lamp.aim, lamp.position)
        length = float(np.linalg.norm(way)) or 1.0
        if lamp.parallel:
            towards, strength = np.broadcast_to(-way / length, points.shape), np.ones(count)
        else:
            towards = np.asarray(lamp.position) - points
            away = np.maximum(np.linalg.norm(towards, axis=1), 1e-6)
            towards = towards / away[:, None]
            inside = -(towards @ way) / length >= math.cos(math.radians(CUTOFF))
            strength = inside * (length / away) ** 2
        turned = np.maximum(np.sum(normals * towards, axis=1), 0.0) * strength
        light += turned[:, None] * (lamp.illuminance * tint(lamp.temperature))
    colours = np.zeros((count, 3))
    colours[hit] = np.asarray(model.geom_rgba)[geoms[hit], 2::-1]
    colour = np.where(hit[:, None], np.clip(255 * colours * light / level, 0, 255), 0)
    along = np.asarray(rays @ camera.T_world_optical[:3, 2])
    depth = np.where(hit, distances * along, np.inf)
    shape = (camera.height, camera.width)
    return View(np.rint(colour).astype(np.uint8).reshape(*shape, 3), depth.astype(np.float32).reshape(shape))
