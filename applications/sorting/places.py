"""Where objects can lie: the containers and the table around them, and what of a surface is a known solid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from applications.sorting.surface import Surface
from common.config import Fixture, Surroundings
from common.errors import ConfigError
from common.robot.transforms import rpy_to_matrix

Bools = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float32]
Colors = npt.NDArray[np.float32]

TABLE = "table"  # id of the place outside of all containers
LOWEST = 0.005  # [m] what is higher above a floor is an object
THIN = 0.003  # [m] what is higher and has another color than the floor is one too
NEAR_WALL = 0.007  # [m] from a wall, points may belong to it
OVER_RIM = 0.008  # [m] what is higher above a rim lies on it
AROUND = 0.012  # [m] around containers, points on the table may belong to their walls
SHARE_STEP = 0.07  # difference of the share of red or blue that makes another color
SHADE_STEP = 1.2  # difference of the logarithm of brightness that makes another color
DARK = 12.0  # [0..255] added to each channel: the noise of dark pixels is no color
FEWEST = 200  # [cells] of a floor from which its color is measured


@dataclass(frozen=True)
class Place:
    """A container seen from above, or the table.

    Attributes:
        id: of the container, or `TABLE`.
        floor: z of the surface that carries objects [m].
        rim: z of the top of the walls [m]; that of the table is its floor.
        x, y: center [m].
        inner, outer: half sides of the interior and of the outside [m].
        color: blue green red, 0 to 255, in the configuration.
    """

    id: str
    floor: float
    rim: float
    x: float
    y: float
    inner: float
    outer: float
    color: tuple[float, float, float]

    def area(self, margin: float = 0.0) -> tuple[float, float, float, float]:
        """Least x and y, largest x and y [m] of its outside and a margin around."""
        r = self.outer + margin
        return self.x - r, self.y - r, self.x + r, self.y + r

    def contains(self, x: float, y: float) -> bool:
        """Return whether a position [m] is within its outside."""
        return max(abs(x - self.x), abs(y - self.y)) <= self.outer


def containers_of(world: Surroundings) -> list[Place]:
    """Return all containers of a world."""
    found = []
    for box in world.containers.values():
        r, g, b = box.color
        found.append(Place(
            box.id, world.table_height + box.floor_thickness, world.table_height + box.wall_height, box.x, box.y,
            box.half_side - box.wall_thickness, box.half_side, (255 * b, 255 * g, 255 * r)))
    return found


def require_tray(world: Surroundings, tray: str, field: str) -> None:
    """Check the container with the objects; `field` is the parameter that names it.

    Raises:
        ConfigError: the world has no such container, or says that objects are taken from others.
    """
    if tray not in world.containers:
        raise ConfigError(field, tray, f"is no container; choices: {', '.join(world.containers) or 'none'}")
    sources = [name for name, box in world.containers.items() if box.source]
    if sources and tray not in sources:
        raise ConfigError(field, tray, f"is a destination; choices (source: true): {', '.join(sources)}")


def tray_of(world: Surroundings, tray: str, field: str) -> Place:
    """Return the container with the objects.

    Raises:
        ConfigError: see `require_tray`.
    """
    require_tray(world, tray, field)
    return next(place for place in containers_of(world) if place.id == tray)


def features(color: npt.NDArray[np.uint8]) -> Colors:
    """Colors (..., 3) in which the Euclidean distance separates surfaces, of bgr8.

    Two are the shares of red and blue, which shading does not change; the third is the logarithm of the brightness, of
    which shading changes a part only. A distance of 1 is a different color.
    """
    values = color.astype(np.float32) + np.float32(DARK)
    total = values[..., 0] + values[..., 1] + values[..., 2]
    result = np.empty(values.shape, np.float32)
    np.divide(values[..., 2], total, out=result[..., 0])
    np.divide(values[..., 0], total, out=result[..., 1])
    result[..., :2] /= np.float32(SHARE_STEP)
    np.log(total, out=result[..., 2])
    result[..., 2] /= np.float32(SHADE_STEP)
    return result


def color_distance(a: Colors, b: Colors) -> Values:
    """Distance (...) of colors (..., 3) of `features`."""
    apart = a - b
    return np.asarray(np.sqrt(np.einsum("...k,...k->...", apart, apart)), np.float32)


@dataclass(frozen=True, eq=False)
class Foreground:
    """What of a surface lies in a place.

    Attributes:
        mask: (rows, columns) cells of objects.
        near_wall: (rows, columns) cells at which a wall begins.
        gain: (3,) blue green red of the light, measured from the floor, that renders it in its configured color.
    """

    mask: Bools
    near_wall: Bools
    gain: Values


def in_container(surface: Surface, colors: Colors, place: Place) -> Foreground:
    """Return the objects in a container, of a surface around it with its colors (rows, columns, 3) of `features`."""
    rows, columns = surface.top.shape
    dx = np.abs(surface.xy(0, np.arange(columns))[:, 0] - place.x)[None, :]
    dy = np.abs(surface.xy(np.arange(rows), 0)[:, 1] - place.y)[:, None]
    away = np.maximum(dx, dy)
    inside, wall = away < place.inner, (away >= place.inner - NEAR_WALL) & (away < place.outer)
    known = np.isfinite(surface.top)
    height = np.where(known, surface.top, np.float32(place.floor)) - np.float32(place.floor)
    floor = inside & ~wall & known & (np.abs(height) < THIN)
    reference = place.color
    if np.count_nonzero(floor) >= FEWEST:
        blue, green, red = np.median(surface.color[floor], axis=0)
        reference = (float(blue), float(green), float(red))
    plain = features(np.array(reference, np.uint8))
    colored = color_distance(colors, plain) > 1
    tinted = color_distance(colors[..., :2], plain[:2]) > 1  # walls may be in shadow
    mask = (height > LOWEST) | ((height > THIN) & colored)
    over = height > place.rim - place.floor + OVER_RIM
    mask &= np.where(wall, over | (tinted & inside), inside)
    gain = np.clip(np.array(place.color) / np.maximum(reference, 1.0), 0.4, 2.5).astype(np.float32)
    return Foreground(mask & known, wall, gain)


def hidden_fraction(surface: Surface, place: Place) -> float:
    """Return the fraction of the interior of a container without a measurement."""
    r = place.inner
    first = np.clip(surface.cells((place.x - r, place.y - r)), 0, surface.top.shape)
    last = np.clip(surface.cells((place.x + r, place.y + r)), first, surface.top.shape)
    part = surface.top[first[0]:last[0], first[1]:last[1]]
    return float(np.isnan(part).mean()) if part.size else 1.0


def on_table(surface: Surface, containers: list[Place], world: Surroundings) -> Bools:
    """Return (rows, columns) cells of objects on the table outside of all containers and fixtures that stand on it."""
    with np.errstate(invalid="ignore"):
        mask = surface.top > world.table_height + 1.5 * LOWEST
    for place in containers:
        r = place.outer + AROUND
        _clear(mask, surface, (place.x - r, place.y - r, place.x + r, place.y + r))
    for fixture in world.fixtures:
        reach = reach_of(fixture)
        if fixture.position[2] + reach[2] > world.table_height + LOWEST:
            x, y, _ = fixture.position
            _clear(mask, surface, (x - reach[0] - AROUND, y - reach[1] - AROUND, x + reach[0] + AROUND,
                                   y + reach[1] + AROUND))
    return mask


def reach_of(fixture: Fixture) -> tuple[float, float, float]:
    """Half extents [m] of a fixture along the axes of world."""
    d = fixture.dimensions
    half = {"box": d, "sphere": [2 * d[0]] * 3, "cylinder": [2 * d[0], 2 * d[0], d[-1]]}[fixture.shape]
    x, y, z = np.abs(rpy_to_matrix(*fixture.rpy)) @ (np.array(half) / 2)
    return float(x), float(y), float(z)


def _clear(mask: Bools, surface: Surface, area: tuple[float, float, float, float]) -> None:
    first = np.clip(surface.cells(area[:2]), 0, mask.shape)
    last = np.clip(surface.cells(area[2:]) + 1, 0, mask.shape)
    mask[first[0]:last[0], first[1]:last[1]] = False
