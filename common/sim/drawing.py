"""A picture of balls on a table and an open box, as one camera sees them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from common.config import Container, Surroundings
from common.perception.pinhole import Pinhole
from common.perception.sphere import silhouette

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

BASE = 128  # grey: all three channels
GRID = 108
GRID_SPACING = 40  # [px]
RIM = (255, 255, 255)
RIM_WIDTH = 2  # [px]
_SHIFT = 4  # fractional bits of coordinates handed to OpenCV: 1/16 px


def draw(
    balls: npt.ArrayLike | Sequence[Sequence[float]],
    camera: Pinhole,
    surroundings: Surroundings,
    *,
    noise_std: float = 0.0,
    brightness: float = 0.0,
    rng: np.random.Generator | None = None,
    rim_width: float = RIM_WIDTH,
) -> Picture:
    """The bgr8 picture (height, width, 3) of balls, each as the silhouette that a sphere has from this camera.

    Args:
        balls: (n, 3) centres in world [m], in any order: what is nearer hides what is farther.
        camera: intrinsics and the pose of the optical frame.
        surroundings: radius and colour of the balls, container.
        noise_std: standard deviation of Gaussian noise added to each channel.
        brightness: added to each channel.
        rng: where the noise comes from.
        rim_width: of the white line on the outline of each ball [px]; 0 for none.
    """
    picture = np.full((camera.height, camera.width, 3), BASE, np.uint8)
    picture[::GRID_SPACING] = GRID
    picture[:, ::GRID_SPACING] = GRID
    _draw_container(picture, camera, surroundings.container, surroundings.table_height)
    color = _bgr(surroundings.ball_color)
    centers = np.asarray(balls, dtype=float).reshape(-1, 3)
    farthest_first = np.argsort(-np.linalg.norm(centers - camera.position, axis=1), kind="stable")
    for center in centers[farthest_first]:
        _draw_ball(picture, camera, center, radius=surroundings.ball_radius, color=color, rim_width=rim_width)
    return _disturb(picture, noise_std, brightness, rng)


def _draw_ball(
    picture: Picture, camera: Pinhole, center: Array, *, radius: float, color: tuple[int, int, int], rim_width: float
) -> None:
    """Blend one sphere into the picture, each pixel by how much of it is covered.

    The rim straddles the outline. OpenCV's filled polygons are half a pixel too large all the way round, which is as
    much as the whole error of a good fit; the distance of a pixel from the outline is exact.
    """
    outline = silhouette(camera, center, radius, 32)
    if not len(outline):
        return
    low = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 4 - int(rim_width), 0)
    high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 5 + int(rim_width), (camera.width, camera.height))
    if (high - low < 2).any():
        return
    x, y, z = camera.to_camera(center)
    a = ((np.arange(low[0], high[0]) - camera.cx) / camera.fx)[None, :]
    b = ((np.arange(low[1], high[1]) - camera.cy) / camera.fy)[:, None]
    along = (x * a + y * b + z) ** 2 / (1 + a * a + b * b)
    beyond = np.sqrt(np.maximum(x * x + y * y + z * z - along, 0.0)) - radius  # distance of rays from the sphere [m]
    slope = np.hypot(*np.gradient(beyond))  # [m/px]
    outside = beyond / np.maximum(slope, 1e-9)  # [px]
    cut = picture[low[1] : high[1], low[0] : high[0]]
    blended = cut.astype(np.float32)
    if rim_width:
        blended += np.clip(0.5 + rim_width / 2 - outside, 0, 1)[..., None] * (np.array(RIM, np.float32) - blended)
    blended += np.clip(0.5 - rim_width / 2 - outside, 0, 1)[..., None] * (np.array(color, np.float32) - blended)
    cut[...] = np.rint(blended).astype(np.uint8)


def _draw_container(picture: Picture, camera: Pinhole, container: Container, table_height: float) -> None:
    """The outer edges of the container: the rim, the base and the four corners between them."""
    h = container.half_side
    corners = np.array([(container.x + dx, container.y + dy) for dx, dy in ((-h, -h), (h, -h), (h, h), (-h, h))])
    rings = []
    for z in (table_height, table_height + container.wall_height):
        ring = camera.project(np.column_stack([corners, np.full(4, z)]))
        if not np.isfinite(ring).all():
            return
        rings.append(_fixed_point(ring))
    edges = [np.array([low, high]) for low, high in zip(*rings, strict=True)]
    color = _bgr(container.color)
    cv2.polylines(picture, edges, False, color, 1, cv2.LINE_AA, _SHIFT)
    cv2.polylines(picture, rings[:1], True, color, 1, cv2.LINE_AA, _SHIFT)
    cv2.polylines(picture, rings[1:], True, color, 2, cv2.LINE_AA, _SHIFT)


def _disturb(
    picture: Picture, noise_std: float, brightness: float, rng: np.random.Generator | None
) -> Picture:
    if noise_std <= 0 and brightness == 0:
        return picture
    values = picture.astype(np.float32)
    if noise_std > 0:
        generator = rng if rng is not None else np.random.default_rng(0)
        values += generator.standard_normal(picture.shape, dtype=np.float32) * np.float32(noise_std)
    values += np.float32(brightness)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _bgr(color: tuple[float, float, float]) -> tuple[int, int, int]:
    r, g, b = (round(255 * value) for value in color)
    return b, g, r


def _fixed_point(pixels: npt.NDArray[np.float64]) -> npt.NDArray[np.int32]:
    """Coordinates with fractional bits; far outside the picture they are cut, which nobody can see."""
    return np.rint(np.clip(pixels, -4000, 20000) * (1 << _SHIFT)).astype(np.int32)
