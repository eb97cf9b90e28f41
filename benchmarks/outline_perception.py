"""How near perceived outlines come to the true ones on w1 to w6, and how long each step from picture to path takes.

    python -m benchmarks.outline_perception [--repeat 3]

With trimesh and embreex installed (pip install trimesh embreex) the ray caster is compared with embree as well.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from applications.outlining.contours import ContourOptions, find_contours, is_hole
from applications.outlining.solids import simplified, without_duplicates
from applications.outlining.top_face import TopFaceOptions, top_face
from common.config import Surroundings, World, check, config_root, load_robot, read_yaml
from common.messages import Header, JointState, WorldObject
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.sim.objects import object_mesh, world_object
from common.sim.ray_caster import Mesh, View, cast, empty_view
from common.sim.rendering import GROUND, Renderer
from common.sim.solids import fixture_mesh

Array = npt.NDArray[np.float64]

WORLDS = ("w1", "w2", "w3", "w4", "w5", "w6")
MODES = {
    "seed: whole pixels, 1 mm": (ContourOptions(channel="maximum", subpixel=False), TopFaceOptions(rounding=0.001)),
    "default: sub-pixel, no rounding": (ContourOptions(), TopFaceOptions()),
}
TOLERANCE = 0.00005  # of the duplicate remover [m]
OVER = (0.1, -1.3, 1.6, -1.87, -1.57, 0.1)  # joint positions with the hand above the target base [rad]
STEP = 2e-4  # between the places of a path whose distance from the outline is measured [m]


def deviation(path: Array, polygon: Array) -> Array:
    """Distance [m] from a closed polygon (m, 2) of places all along a closed path (n, 2)."""
    ends = np.roll(path, -1, axis=0)
    places = np.vstack([
        a + (b - a) * np.arange(n)[:, None] / n
        for a, b in zip(path, ends, strict=True) for n in [1 + int(np.linalg.norm(b - a) / STEP)]
    ])
    side = np.roll(polygon, -1, axis=0) - polygon
    along = ((places[:, None] - polygon) * side).sum(axis=2) / np.maximum((side**2).sum(axis=1), 1e-18)
    nearest = polygon + np.clip(along, 0, 1)[..., None] * side
    return np.asarray(np.linalg.norm(places[:, None] - nearest, axis=2).min(axis=1))


def fastest(call: Callable[[], Any], repeat: int) -> tuple[float, Any]:
    """The shortest time of several calls [ms], and what the last one gave."""
    times = []
    result = None
    for _ in range(repeat):
        start = time.perf_counter()
        result = call()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times), result


def load(name: str) -> tuple[World, list[WorldObject], list[Mesh]]:
    """A world, its objects and all its meshes."""
    world = check(World, read_yaml(config_root() / "worlds" / f"{name}.yaml"))
    objects = [world_object(thing) for thing in world.objects]
    return world, objects, [fixture_mesh(f) for f in world.fixtures] + [object_mesh(thing) for thing in objects]


def outlines(view: View, camera: Pinhole, objects: Sequence[WorldObject], repeat: int) -> None:
    """Print a line for each mode, object and hole."""
    depth = view.depth_within(0.10, 2.25)
    for mode, (how, options) in MODES.items():
        find_ms, contours = fastest(lambda how=how: find_contours(view.colour, how), repeat)
        for contour in contours:
            if contour.touches_border:
                continue
            hole = is_hole(contours, contour.index)
            face_ms, face = fastest(
                lambda c=contour, o=options, h=hole: top_face(c.pixels, depth, camera, o, hole=h), repeat)
            clear_ms, path = fastest(lambda f=face: simplified(without_duplicates(f.outline), TOLERANCE), repeat)
            middle = face.outline[:, :2].mean(axis=0)
            thing = min(objects, key=lambda o, m=middle: float(np.linalg.norm(np.mean(o.outline, axis=0) - m)))
            off = 1e3 * deviation(path[:, :2], np.array(thing.hole if hole else thing.outline))
            print(f"  {mode:32s} {thing.id + (' hole' if hole else ''):14s} {off.mean():6.3f} {off.max():6.3f} mm  "
                  f"{len(face.outline):4d} -> {len(path):3d} points  contours {find_ms:5.1f}  top face {face_ms:5.1f}  "
                  f"duplicates {clear_ms:4.1f} ms")


def arm(repeat: int) -> None:
    """Print how long the arm takes, which is all that is rendered again while it moves."""
    world, objects, meshes = load("w5")
    robot = RobotModel.load(load_robot("ur5"))
    around = Surroundings.model_validate({f: getattr(world, f) for f in Surroundings.model_fields})
    camera = Renderer(around, robot)
    positions = np.array(OVER)
    times = []
    for _ in range(repeat + 1):
        positions = positions + 0.01
        state = JointState(header=Header(), name=robot.joint_names, position=positions.tolist())
        start = time.perf_counter()
        camera.render(objects, state)
        times.append(1e3 * (time.perf_counter() - start))
    print(f"\na frame in which the arm has moved: {min(times[1:]):.0f} ms (at most 200 for 5 Hz)")
    compare_with_embree(meshes, camera.camera, repeat)


def compare_with_embree(meshes: list[Mesh], camera: Pinhole, repeat: int) -> None:
    """Print how long w5 takes with both casters and how far their depths differ, if embree is here."""
    try:
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError:
        print("embree: not installed")
        return
    corners = np.concatenate([mesh.corners for mesh in meshes])
    shape = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
    intersector = RayMeshIntersector(shape)
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    directions = camera.directions(np.stack([u, v], axis=-1).reshape(-1, 2).astype(float))
    origins = np.broadcast_to(camera.position, directions.shape)

    def embree() -> Array:
        hit = intersector.intersects_first(origins, directions)
        a, b, c = (corners[hit, k] for k in range(3))
        across = np.cross(b - a, c - a)
        distance = (across * (a - camera.position)).sum(axis=1) / (across * directions).sum(axis=1)
        depth = distance * (directions @ camera.T_world_optical[:3, 2])
        return np.where(hit >= 0, depth, np.inf).reshape(u.shape)

    theirs_ms, theirs = fastest(embree, repeat)
    ours_ms, ours = fastest(lambda: cast(meshes, camera, empty_view(camera, GROUND)), repeat)
    differs = ~np.isclose(theirs, ours.depth, atol=1e-5)
    print(f"embree: {theirs_ms:.0f} ms for depth alone, ours {ours_ms:.0f} ms with soft edges; "
          f"{int(differs.sum())} of {differs.size} pixels differ by more than 0.01 mm (rays through edges)")


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=3)
    repeat = parser.parse_args().repeat
    cv2.setNumThreads(1)
    print("deviation of the cleared path from the true outline: mean, max; times are the shortest of", repeat)
    for name in WORLDS:
        world, objects, meshes = load(name)
        camera = Pinhole.from_config(world.camera)
        cast_ms, view = fastest(lambda m=meshes, c=camera: cast(m, c, empty_view(c, GROUND)), repeat)
        print(f"{name}: {sum(len(m.corners) for m in meshes)} triangles cast in {cast_ms:.0f} ms")
        outlines(view, camera, objects, repeat)
    arm(repeat)


if __name__ == "__main__":
    main()
