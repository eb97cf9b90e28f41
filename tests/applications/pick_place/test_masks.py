"""Masks of successive images equal those of single images."""

import numpy as np
import pytest

from applications.pick_place.segmentation import Colours, Masks

WINDOWS = ((0, 120, 80), (10, 255, 255)), ((170, 120, 80), (180, 255, 255))
RED, GREY = (30, 30, 200), (120, 120, 120)


def spot(picture, rng):
    height, width = picture.shape[:2]
    u, v = rng.integers(-5, width), rng.integers(-5, height)
    w, h = rng.integers(1, 30, 2)
    picture[max(v, 0):v + h, max(u, 0):u + w] = RED if rng.random() < 0.6 else GREY


def scene(rng, width=120):
    picture = np.full((90, width, 3), GREY, np.uint8)
    for _ in range(12):
        spot(picture, rng)
    return picture


@pytest.mark.parametrize(("kernel_px", "width"), [(1, 120), (3, 77), (4, 120), (7, 77), (12, 77)])  # of whole words?
def test_masks_are_independent_of_earlier_images_and_stay_unchanged(kernel_px, width):
    rng = np.random.default_rng(kernel_px * width)
    colours, reused = Colours(WINDOWS, kernel_px), Masks()
    picture = scene(rng, width)
    closed = narrow = 0
    for _ in range(40):
        picture = picture.copy()
        if rng.random() < 0.8:
            spot(picture, rng)
        masks = reused.of(picture, colours)
        for mask, fresh in zip(masks, Masks().of(picture, colours), strict=True):
            assert np.array_equal(mask, fresh)
        copies = [mask.copy() for mask in masks]
        changed = picture.copy()
        spot(changed, rng)
        reused.of(changed, colours)
        assert all(map(np.array_equal, masks, copies))
        closed, narrow = closed + masks.closed.any(), narrow + masks.narrow.any()
    assert closed > 30 or kernel_px == 12
    assert narrow > 20 or kernel_px == 1, "nothing is too narrow for it"


def test_repeated_image_returns_the_identical_masks():
    picture, masks = scene(np.random.default_rng(1)), Masks()
    first = masks.of(picture, Colours(WINDOWS, 7))
    assert masks.of(picture.copy(), Colours(WINDOWS, 7))[1] is first[1]
    assert masks.of(picture, Colours(WINDOWS, 9))[1] is not first[1]


def test_visible_table_area_affects_the_masks():
    picture = np.full((96, 128, 3), (40, 65, 90), np.uint8)
    picture[48:] = (5, 50, 230)  # a brown table in warm light
    picture[10:40, 20:60] = RED
    lower = np.zeros((12, 16), bool)
    lower[6:] = True
    masks, colours = Masks(), Colours(WINDOWS, 7)
    assert masks.of(picture, colours, ~lower).closed[48:].any()
    result = masks.of(picture, colours, lower)
    assert result.closed[20, 40] and not result.closed[48:].any(), "of the same picture, too"
    assert masks.of(picture.copy(), colours, lower) is result
