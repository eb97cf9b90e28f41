"""Tell the container's floor from balls: an overexposed orange floor is red in warm light."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from applications.pick_place.ball_places import BallGeometry, is_table
from common.config import Surroundings
from common.perception.illumination import BoolMask, blue_share
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

_BRIGHT = 60  # [0..255] green from which its ratio to blue is reliable, also where red is clipped
_WARMEST = 0.25  # blue relative to green that remains in light of 2700 K
_LEAST_BLUE = 0.15  # the same in light in which balls still show some blue: at 2400 K there is less
_LEAST_GREEN = 0.05  # of a ball's color; below this its blue cannot be judged
_TURNS_RED = 0.25, 0.9  # green relative to red of a container that looks red where red is clipped


class ContainerFloor:
    """The color of the container's floor, next to that of balls, in the light of an image."""

    def __init__(self, surroundings: Surroundings, resting: BallGeometry) -> None:
        """Tell the floor of these surroundings from balls that rest so."""
        self._around, self._resting = surroundings, resting

    def is_seen(
        self, pixel: tuple[float, float], outline: Array, picture: Picture, camera: Pinhole, table: BoolMask | None
    ) -> bool:
        """Return whether a detection in the container is its floor: an overexposed orange floor is red in warm light.

        Green and blue are not clipped then: balls have more blue than the floor, in any light with some blue.

        `table` is where the image shows the table; None: too little of it.
        """
        least = self._blue_of_balls
        if least is None or not self._resting.shows_container(camera, pixel):
            return False
        inner = np.concatenate([pixel + part * (outline - pixel) for part in (0.3, 0.6)])
        u, v = np.clip(np.rint(inner).astype(int), 0, (camera.width - 1, camera.height - 1)).T
        blue, green = picture[v, u, :2].astype(float).T
        bright = green >= _BRIGHT
        return bool(bright.mean() > 0.5 and np.median(blue[bright] / green[bright]) < least
                    and self._blue_of_light(picture, table) >= _LEAST_BLUE)

    def _blue_of_light(self, picture: Picture, mask: BoolMask | None) -> float:
        """Blue of the light relative to its green, measured on the table: 1 in daylight, 0 when unknown."""
        table = next((fixture for fixture in self._around.fixtures
                      if is_table(fixture, self._around.table_height)), None)
        if table is None or mask is None or min(table.color[1:]) <= 0:
            return 0.0
        return blue_share(picture, mask) * table.color[1] / table.color[2]

    @property
    def _blue_of_balls(self) -> float | None:
        """Smallest blue relative to green that balls show in warm light.

        None if the container never looks like a ball: it is neither orange nor brown, or has as much blue.
        """
        red, green, blue = self._resting.container.color
        _, green_of_ball, blue_of_ball = self._around.ball_color
        least = 0.5 * _WARMEST * min(1.0, blue_of_ball / max(green_of_ball, _LEAST_GREEN))
        return least if _TURNS_RED[0] <= green / max(red, 1e-3) <= _TURNS_RED[1] and blue <= least * green else None
