"""Kinds of objects: shape, size, mass, friction and color of an object, drawn at random.

`TEST_KINDS` are for measurements: nothing is trained or tuned with them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from applications.sorting.objects import shapes
from applications.sorting.objects.pieces import Piece, points_of, triangles_of, volume_and_center

Array = npt.NDArray[np.float64]
Range = tuple[float, float]

TRAIN_KINDS: Mapping[str, Callable[[np.random.Generator], list[Piece]]] = {shape.__name__: shape for shape in (
    shapes.block, shapes.can, shapes.pebble, shapes.bar, shapes.plate, shapes.angle_bracket, shapes.tee, shapes.cross,
    shapes.washer, shapes.hammer, shapes.mug, shapes.bottle, shapes.bolt, shapes.channel, shapes.cluster,
)}
TEST_KINDS: Mapping[str, Callable[[np.random.Generator], list[Piece]]] = {shape.__name__: shape for shape in (
    shapes.wrench, shapes.screwdriver, shapes.goblet, shapes.star, shapes.dumbbell, shapes.gear, shapes.hook,
    shapes.key, shapes.step_block, shapes.jack, shapes.spoon, shapes.duck, shapes.castle, shapes.pipe_elbow,
)}
KINDS = {**TRAIN_KINDS, **TEST_KINDS}

PALETTE: Mapping[str, tuple[float, float, float]] = {
    "red": (0.80, 0.10, 0.10), "orange": (0.95, 0.50, 0.05), "yellow": (0.95, 0.85, 0.10),
    "green": (0.10, 0.60, 0.20), "blue": (0.10, 0.25, 0.80), "purple": (0.50, 0.15, 0.60),
    "white": (0.95, 0.95, 0.95), "black": (0.08, 0.08, 0.08),
}
SHADE = 0.06  # by which a color differs from that of the palette

LONGEST: Range = (0.040, 0.140)  # [m] longest side
WIDEST = 0.062  # [m] of the shortest side: fingers open to 80 or 85 mm
MASSES: Range = (0.05, 0.5)  # [kg]
FRICTIONS: Range = (0.2, 0.6)  # coefficient of sliding friction
DENSITIES: Range = (250.0, 8000.0)  # [kg/m^3] from hollow plastic to steel
MAX_TRIANGLES = 300
APART = 2e-6  # [m] between corners of different pieces, which would be one piece if they shared a corner


@dataclass(frozen=True, eq=False)
class DrawnObject:
    """An object in its own frame, whose origin is its center of mass.

    Attributes:
        parts: surface (n, 3, 3) [m] of each convex piece; pieces share no corner.
        surface: (n, 3, 3) [m] that cameras see, of a mesh whose pieces only approximate it; else None.
        color: red, green, blue from 0 to 1.
        mass: [kg].
        friction: coefficient of sliding friction.
        kind: name of its kind, or of the file of its mesh.
        color_name: key of `PALETTE`.
    """

    parts: list[Array]
    color: tuple[float, float, float]
    mass: float
    friction: float
    kind: str
    color_name: str
    surface: Array | None = None

    @property
    def triangles(self) -> Array:
        """Surface (n, 3, 3) [m] that cameras see."""
        return np.concatenate(self.parts) if self.surface is None else self.surface

    @property
    def size(self) -> Array:
        """(3,) of its bounding box [m]."""
        return np.asarray(np.ptp(self.triangles.reshape(-1, 3), axis=0))


def draw(
    kind: str, rng: np.random.Generator, masses: Range = MASSES, frictions: Range = FRICTIONS
) -> DrawnObject:
    """Draw an object of a kind.

    Args:
        kind: key of `KINDS`.
        rng: source of everything that varies.
        masses: smallest and largest mass [kg].
        frictions: smallest and largest coefficient of sliding friction.
    """
    parts = sized(KINDS[kind](rng), rng)
    return finished([triangles_of(part) for part in parts], kind, rng, masses, frictions)


def sized(pieces: list[Piece], rng: np.random.Generator) -> list[Piece]:
    """Scale pieces [mm] to meters; too large or too small ones to a random permitted size."""
    extent = np.sort(np.ptp(points_of(pieces), axis=0))
    scale = 1e-3
    if not LONGEST[0] <= scale * extent[2] <= LONGEST[1]:
        scale = rng.uniform(0.8 * LONGEST[1], LONGEST[1]) / extent[2]
    scale = min(scale, WIDEST / extent[0])
    return [scale * piece for piece in pieces]


def finished(
    parts: list[Array], kind: str, rng: np.random.Generator, masses: Range, frictions: Range,
    surface: Array | None = None,
) -> DrawnObject:
    """Return an object of these surfaces (n, 3, 3) [m], about its center of mass, with a random mass and color."""
    measured = [volume_and_center(part) for part in parts]
    volumes = np.array([volume for volume, _ in measured])
    center = volumes @ np.array([at for _, at in measured]) / volumes.sum()
    low, high = np.clip(volumes.sum() * np.array(DENSITIES), *masses)
    mass = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    name = str(rng.choice(list(PALETTE)))
    red, green, blue = np.clip(np.array(PALETTE[name]) + rng.uniform(-SHADE, SHADE), 0.0, 1.0).tolist()
    placed = [part - center + APART * number for number, part in enumerate(parts)]
    friction = float(rng.uniform(*frictions))
    return DrawnObject(placed, (red, green, blue), mass, friction, kind, name,
                       None if surface is None else surface - center)
