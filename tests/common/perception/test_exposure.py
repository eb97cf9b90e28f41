"""A picture that tells nothing is told from one of an empty table."""

from __future__ import annotations

import numpy as np
import pytest

from common.config import Surroundings, load_cell
from common.perception.illumination import blank_image_reason
from common.perception.pinhole import Pinhole
from common.sim.rendering import Renderer, add_image_noise

AROUND = load_cell("panda").section(Surroundings)
assert isinstance(AROUND, Surroundings)
CAMERA = Pinhole.from_config(AROUND.camera)


@pytest.mark.parametrize("plain", [True, False])
def test_empty_table_is_not_blank_even_in_low_light_and_noise(plain: bool) -> None:
    picture = Renderer(AROUND, plain=plain, camera=CAMERA).render([]).colour
    dim = (picture * 0.3).astype(np.uint8)
    for shown in (picture, dim, add_image_noise(dim, 8.0, 0.0, np.random.default_rng(1))):
        assert blank_image_reason(shown) == ""


@pytest.mark.parametrize(("level", "why"), [(0, "dark"), (4, "dark"), (255, "white"), (90, "single color")])
@pytest.mark.parametrize("noise", [0.0, 6.0])
def test_covered_or_saturated_camera_gives_a_blank_image(level: int, why: str, noise: float) -> None:
    covered = np.full((480, 640, 3), level, np.uint8)
    covered[100, 100] = 255  # a hot pixel
    if not (noise and why == "white"):
        assert why in blank_image_reason(add_image_noise(covered, noise, 0.0, np.random.default_rng(1)))
