"""Parts of the simulated world, drawn by the seed.

    generator: {module: applications.tending.parts, count: 4}
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from applications.tending.task import PALLET
from common.config import ObjectConfig, Parameters, World
from common.errors import ConfigError

ATTEMPTS = 200


class Options(Parameters):
    """How many parts, and where they lie."""

    count: int = Field(4, ge=1, le=8, description="number of parts")
    center: tuple[float, float] = Field((0.45, -0.25), description="of the tray [m]")
    size: tuple[float, float] = Field((0.22, 0.20), description="of the area for centers of parts [m]")
    separation: float = Field(0.085, ge=0.07, le=0.5, description="of centers: fingers fit between parts [m]")


def generate(world: World, options: Options, seed: int) -> list[ObjectConfig]:
    """Return parts at random positions and angles.

    Raises:
        ConfigError: there is no room for so many.
    """
    rng = np.random.default_rng([seed, 38])
    for _ in range(ATTEMPTS):
        places: list[tuple[float, float]] = []
        for _ in range(ATTEMPTS):
            offset = (rng.random(2) - 0.5) * options.size
            place = options.center[0] + float(offset[0]), options.center[1] + float(offset[1])
            if all(math.dist(place, other) >= options.separation for other in places):
                places.append(place)
            if len(places) == options.count:
                length, width, height = PALLET.item
                return [ObjectConfig(id=f"part_{n}", shape="box", size=(length, width), height=height, x=x, y=y,
                                     yaw=float(rng.uniform(-1.5, 1.5)), color=(0.9, 0.1, 0.1), mass=0.15)
                        for n, (x, y) in enumerate(places, 1)]
    raise ConfigError("world.generator.count", options.count, f"parts do not fit {options.separation:g} m apart")
