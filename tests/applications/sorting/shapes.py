"""Objects and a hand of the simplest shapes, for tests."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from common.config import Container

Array = npt.NDArray[np.float64]

TRAY = Container(id="tray", x=0.55, y=0.0, half_side=0.20, wall_height=0.05)
FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


@dataclass(frozen=True, eq=False)
class Block:
    """A box of one piece."""

    size: tuple[float, float, float]
    mass: float = 0.2
    friction: float = 0.5
    color: tuple[float, float, float] = (0.9, 0.2, 0.1)

    @property
    def parts(self) -> list[Array]:
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * self.size / 2
        return [np.concatenate([corners[FACES[:, :3]], corners[FACES[:, [0, 2, 3]]]])]

    def at(self, x: float, y: float, z: float = 0.0) -> Array:
        """Pose (4, 4) on the tray's floor, or `z` above it."""
        T = np.eye(4)
        T[:3, 3] = x, y, TRAY.floor_thickness + self.size[2] / 2 + z + 0.001
        return T


@dataclass(frozen=True, eq=False)
class SmallHand:
    """Two boxes as fingers below a palm, about as large as a Panda's."""

    T_tcp_closing: Array = field(default_factory=lambda: np.eye(4))
    max_width: float = 0.08
    finger: npt.NDArray[np.bool_] = field(default_factory=lambda: np.array([True, True, False]))
    table: Array = field(default_factory=lambda: np.array([[
        [[-0.011, 0.040, -0.0385], [0.011, 0.056, 0.009]],
        [[-0.011, -0.056, -0.0385], [0.011, -0.040, 0.009]],
        [[-0.032, -0.102, -0.104], [0.032, 0.102, -0.0385]]]]))
