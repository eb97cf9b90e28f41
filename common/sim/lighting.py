"""Brightness and color of light: from color temperature and illuminance to blue, green and red pixel values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.config import Light, Scenery

Array = NDArray[np.float64]

REFERENCE = 500.0  # [lx] of a well lit table: renders surfaces in their configured color
DAYLIGHT = 6500.0  # [K] white point
CUTOFF = 45.0  # [deg] half angle of a lamp's cone
OVERHEAD = Light()  # default of a world without lights
XYZ_TO_BGR = np.array(  # of linear sRGB, IEC 61966-2-1
    [[0.0557, -0.2040, 1.0570], [-0.9689, 1.8758, 0.0415], [3.2406, -1.5372, -0.4986]]
)


def tint(temperature: float) -> Array:
    """(3,) blue, green and red of light at a color temperature [K], at the luminance of daylight, which is all ones.

    Chromaticity of a black body by Kim et al., US patent 7024034 (2006), valid from 1667 to 25000 K.
    """
    return _black_body(temperature) / _black_body(DAYLIGHT)


def _black_body(temperature: float) -> Array:
    t = 1000.0 / temperature
    if temperature < 4000:
        x = ((-0.2661239 * t - 0.2343589) * t + 0.8776956) * t + 0.179910
    else:
        x = ((-3.0258469 * t + 2.1070379) * t + 0.2226347) * t + 0.240390
    if temperature < 2222:
        y = ((-1.1063814 * x - 1.34811020) * x + 2.18555832) * x - 0.20219683
    elif temperature < 4000:
        y = ((-0.9549476 * x - 1.37418593) * x + 2.09137015) * x - 0.16748867
    else:
        y = ((3.0817580 * x - 5.87338670) * x + 3.75112997) * x - 0.37001483
    return np.asarray(np.maximum(XYZ_TO_BGR @ np.array([x / y, 1.0, (1 - x - y) / y]), 0.0))


def lamps(scenery: Scenery) -> list[Light]:
    """Return the lights of a scenery; by default one above the table."""
    return list(scenery.lights.values()) or [OVERHEAD]


def ambient(scenery: Scenery) -> Array:
    """(3,) [lx] of blue, green and red ambient light, of the mean color of the lights."""
    lights = lamps(scenery)
    total = sum(light.illuminance for light in lights)
    if total <= 0:
        return np.full(3, scenery.ambient)
    mean = sum((light.illuminance / total * tint(light.temperature) for light in lights), np.zeros(3))
    return np.asarray(scenery.ambient * mean)


def white_level(scenery: Scenery) -> Array:
    """(3,) [lx] of blue, green and red light of all lamps together, each at normal incidence."""
    each = (light.illuminance * tint(light.temperature) for light in lamps(scenery))
    return np.asarray(sum(each, ambient(scenery)))
