"""Masks of successive images equal those of single images."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from applications.pick_place.segmentation import Colours, Masks, changed

Picture = npt.NDArray[np.uint8]
WINDOWS = ((0, 120, 80), (10, 255, 255)), ((170, 120, 80), (180, 255, 255))
RED, GREY = (30, 30, 200), (120, 120, 120)


def scene(rng: np.random.Generator, width: int, height: int) -> Picture:
    picture = np.full((height, width, 3), GREY, np.uint8)
    for _ in range(12):
        spot(picture, rng)
    return picture


def spot(picture: Picture, rng: np.random.Generator) -> None:
    height, width = picture.shape[:2]
    u, v = rng.integers(-5, width), rng.integers(-5, height)
    w, h = rng.integers(1, 30, 2)
    picture[max(v, 0):v + h, max(u, 0):u + w] = RED if rng.random() < 0.6 else GREY


@pytest.mark.parametrize("kernel_px", [1, 3, 4, 7, 12])
@pytest.mark.parametrize("width", [120, 77])  # rows that are whole words, and not
def test_masks_are_independent_of_earlier_images(kernel_px: int, width: int) -> None:
    rng = np.random.default_rng(kernel_px * width)
    colours, one_after_the_other = Colours(WINDOWS, kernel_px), Masks()
    picture = scene(rng, width, 90)
    looked_at = narrow = 0
    for _ in range(60):
        picture = picture.copy()
        if rng.random() < 0.8:
            spot(picture, rng)
        masks = one_after_the_other.of(picture, colours)
        for mask, alone in zip(masks, Masks().of(picture, colours), strict=True):
            assert np.array_equal(mask, alone)
        looked_at += int(masks.closed.any())
        narrow += int(masks.narrow.any())
    assert looked_at > 50 or kernel_px == 12
    assert narrow > 30 or kernel_px == 1, "which nothing is too narrow for"


def test_repeated_image_returns_the_identical_masks() -> None:
    picture, masks = scene(np.random.default_rng(1), 120, 90), Masks()
    first = masks.of(picture, Colours(WINDOWS, 7))
    assert masks.of(picture.copy(), Colours(WINDOWS, 7))[1] is first[1]
    assert masks.of(picture, Colours(WINDOWS, 9))[1] is not first[1]


def test_visible_table_area_affects_the_masks() -> None:
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


def test_returned_masks_are_not_modified_later() -> None:
    rng = np.random.default_rng(2)
    picture, masks = scene(rng, 120, 90), Masks()
    first = masks.of(picture, Colours(WINDOWS, 7))
    copies = first[0].copy(), first[1].copy()
    picture[20:50, 20:50] = RED
    masks.of(picture, Colours(WINDOWS, 7))
    assert np.array_equal(first[0], copies[0]) and np.array_equal(first[1], copies[1])


@pytest.mark.parametrize("width", [120, 77])
def test_changed_pixels_lie_within_the_rectangle(width: int) -> None:
    rng = np.random.default_rng(3)
    before = rng.integers(0, 255, (40, width, 3), np.uint8)
    assert changed(before, before.copy()) is None
    for _ in range(50):
        after = before.copy()
        points = np.column_stack([rng.integers(0, 40, 3), rng.integers(0, width, 3)])
        after[points[:, 0], points[:, 1], rng.integers(0, 3)] ^= 1
        rows, columns = changed(before, after) or (slice(0, 0), slice(0, 0))
        assert (rows.start, rows.stop) == (points[:, 0].min(), points[:, 0].max() + 1)
        assert columns.start <= points[:, 1].min() and points[:, 1].max() < columns.stop
        assert columns.stop - columns.start <= np.ptp(points[:, 1]) + 1 + 6  # a word has up to three pixels
