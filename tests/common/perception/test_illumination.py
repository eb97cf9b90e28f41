"""Blank images are recognised, and the red cast of warm light is compensated."""

import cv2
import numpy as np
import pytest

from common.config import Surroundings, load_cell
from common.perception.illumination import amplify_green, blank_image_reason, green_gain, sampled_pixels
from common.sim.rendering import Renderer, add_image_noise
from common.sim.sensors import tint

AROUND = load_cell("panda").section(Surroundings)
TABLE, RED = (0.10, 0.35, 0.55), (0.10, 0.15, 1.0)  # blue, green, red


def noisy(picture: np.ndarray, noise: float = 8.0) -> np.ndarray:
    return add_image_noise(picture, noise, 0.0, np.random.default_rng(1))


@pytest.mark.parametrize("plain", [True, False])
def test_empty_table_is_not_blank_even_in_low_light_and_noise(plain: bool) -> None:
    picture = Renderer(AROUND, plain=plain).render([]).colour
    dim = (picture * 0.3).astype(np.uint8)
    assert {blank_image_reason(shown) for shown in (picture, dim, noisy(dim))} == {""}


@pytest.mark.parametrize(("level", "why", "noise"), [
    (0, "dark", 6.0), (4, "dark", 6.0), (255, "white", 0.0), (90, "single color", 0.0), (90, "single color", 6.0)])
def test_covered_or_saturated_camera_gives_a_blank_image(level: int, why: str, noise: float) -> None:
    covered = np.full((480, 640, 3), level, np.uint8)
    covered[100, 100] = 255  # a hot pixel
    assert why in blank_image_reason(noisy(covered, noise))


def table(kelvin: float, light: float = 255.0, red: float = 0.0) -> np.ndarray:
    picture = np.empty((240, 320, 3))
    picture[:] = TABLE
    picture[: int(240 * red)] = RED
    return np.clip(np.rint(light * picture * tint(kelvin)), 0, 255).astype(np.uint8)


def hue_of(picture: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(amplify_green(picture, green_gain(picture)), cv2.COLOR_BGR2HSV)[..., 0]


@pytest.mark.parametrize("picture", [
    *(table(kelvin) for kelvin in (5000, 6500, 10_000)), np.full((48, 64, 3), 128, np.uint8),
    np.zeros((48, 64, 3), np.uint8),
])
def test_usual_light_grey_and_dark_images_are_unchanged(picture: np.ndarray) -> None:
    assert green_gain(picture) == 1.0 and amplify_green(picture, 1.0) is picture


@pytest.mark.parametrize("kelvin", [2000, 2400, 2700, 3000])
@pytest.mark.parametrize("light", [120.0, 255.0])
@pytest.mark.parametrize("red", [0.0, 0.3])
def test_green_gain_keeps_the_table_from_being_red_in_warm_light(light: float, red: float, kelvin: float) -> None:
    picture = table(kelvin, 0.5 * light, red)
    raised = amplify_green(picture, green_gain(picture))
    assert green_gain(picture) > 1.2
    assert hue_of(picture)[-1, 0] > 12, "of 0 to 10 red is"
    assert not red or not 10 < hue_of(picture)[0, 0] < 160
    assert raised[-1, 0, 1] / raised[-1, 0, 2] <= 1.2 * 0.35 / 0.55, "no greener than in daylight"


def test_green_gain_uses_only_pixels_of_the_table() -> None:
    picture = table(2700)
    picture[:120] = np.clip(128 * tint(2700), 0, 255)  # a grey floor
    pixels = sampled_pixels(240, 320)
    shown = pixels[..., 1] >= 120
    assert green_gain(picture, shown) == green_gain(picture[120:]) > green_gain(picture)
    assert green_gain(picture, np.ones(shown.shape, bool)) == green_gain(picture)
    assert green_gain(picture, np.zeros(shown.shape, bool)) == 1.0


def test_highlight_on_a_ball_stays_red_in_warm_light() -> None:
    picture = np.full((240, 320, 3), (4, 67, 238), np.uint8)  # of a lamp of 2700 K, overexposed
    picture[100:110, 100:110] = (6, 48, 255)
    assert hue_of(picture)[105, 105] <= 10 and hue_of(picture)[0, 0] > 12
