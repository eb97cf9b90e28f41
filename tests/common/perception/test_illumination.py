"""The colour of very warm light is told from that of things, and usual pictures stay as they are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from common.perception.illumination import amplify_green, green_gain, sampled_pixels
from common.sim.photometry import tint

TABLE, RED = (0.10, 0.35, 0.55), (0.10, 0.15, 1.0)  # blue, green, red


def table(kelvin: float, light: float = 255.0, red: float = 0.0) -> np.ndarray:
    picture = np.empty((240, 320, 3))
    picture[:] = TABLE
    picture[: int(240 * red)] = RED
    return np.clip(np.rint(light * picture * tint(kelvin)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("kelvin", [5000, 6500, 10_000])
def test_usual_light_changes_nothing(kelvin: float) -> None:
    picture = table(kelvin)
    assert green_gain(picture) == 1.0 and amplify_green(picture, 1.0) is picture


@pytest.mark.parametrize("kelvin", [2000, 2400, 2700, 3000])
@pytest.mark.parametrize("light", [120.0, 255.0])
@pytest.mark.parametrize("red", [0.0, 0.3])
def test_green_gain_keeps_the_table_from_being_red_in_warm_light(light: float, red: float, kelvin: float) -> None:
    picture = table(kelvin, 0.5 * light, red)
    raised = amplify_green(picture, green_gain(picture))
    assert green_gain(picture) > 1.2
    hue = cv2.cvtColor(raised, cv2.COLOR_BGR2HSV)[..., 0]
    assert hue[-1, 0] > 12, "of 0 to 10 red is"
    assert not red or not 10 < hue[0, 0] < 160
    assert raised[-1, 0, 1] / raised[-1, 0, 2] <= 1.2 * 0.35 / 0.55, "no greener than in daylight"


def test_grey_and_dark_images_are_unchanged() -> None:
    assert green_gain(np.full((48, 64, 3), 128, np.uint8)) == 1.0
    assert green_gain(np.zeros((48, 64, 3), np.uint8)) == 1.0


def test_green_gain_uses_only_pixels_of_the_table() -> None:
    picture = table(2700)
    picture[:120] = np.clip(128 * tint(2700), 0, 255)  # a grey floor
    pixels = sampled_pixels(240, 320)
    shown = pixels[..., 1] >= 120
    assert green_gain(picture, shown) == green_gain(picture[120:]) > green_gain(picture)
    assert green_gain(picture, np.ones(pixels.shape[:2], bool)) == green_gain(picture)
    assert green_gain(picture, np.zeros(pixels.shape[:2], bool)) == 1.0


def test_highlight_on_a_ball_stays_red_in_warm_light() -> None:
    picture = np.full((240, 320, 3), (4, 67, 238), np.uint8)  # of a lamp of 2700 K, overexposed
    picture[100:110, 100:110] = (6, 48, 255)
    hue = cv2.cvtColor(amplify_green(picture, green_gain(picture)), cv2.COLOR_BGR2HSV)[..., 0]
    assert hue[105, 105] <= 10 and hue[0, 0] > 12
