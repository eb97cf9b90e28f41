from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from applications.outlining.contour_choice import ContourTracker, NoSuchContour, middle_of
from applications.outlining.contours import ContourOptions, find_contours
from applications.outlining.topics import Contour, OutlineSelect


def square(index: int, u: float, v: float, side: float) -> Contour:
    pixels = [(u, v), (u + side, v), (u + side, v + side), (u, v + side)]
    return Contour(index=index, label=f"Object_{index}", pixels=pixels, area=side**2)


def test_gradually_occluded_object_is_found_again() -> None:
    whole = square(0, 100, 100, 100)
    following = ContourTracker(OutlineSelect())
    assert following.find([whole]) == (0, "")
    for side in (80, 60, 45, 35, 27, 20):
        part = square(0, 100, 100, side)
        assert following.find([part])[0] == 0
    assert following.find([])[0] == -1
    assert following.find([square(0, 400, 400, 30), square(1, 100, 100, 100)]) == (1, "")


@pytest.mark.parametrize(("by_operator", "found"), [(False, (1, "")), (True, (-1, "Object_0 is not seen any more"))])
def test_automatically_selected_part_is_replaced_by_the_complete_object(by_operator, found) -> None:
    part, others = square(0, 110, 110, 20), [square(0, 300, 100, 200), square(1, 100, 100, 100)]
    following = ContourTracker(OutlineSelect())
    assert following.find([part]) == (0, "")
    if by_operator:
        following.select([part], OutlineSelect())
    assert following.find([square(0, 300, 100, 200)])[0] == -1
    index, why = following.find(others)
    assert (index, why[:len(found[1])]) == found
    assert following.find([square(0, 110, 110, 90), square(1, 300, 100, 200)])[0] == (-1 if by_operator else 0)


def drawn(*boxes: tuple[int, int, int, int, tuple[int, int, int]]) -> list[Contour]:
    """The contours of boxes (u, v, width, height, bgr8) on grey, later ones before earlier ones."""
    picture = np.full((480, 640, 3), 128, np.uint8)
    for u, v, width, height, colour in boxes:
        cv2.rectangle(picture, (u, v), (u + width, v + height), colour, -1)
    return find_contours(picture, ContourOptions(subpixel=False))


RED, GREEN, GREY = (0, 0, 255), (0, 255, 0), (128, 128, 128)
FRAME = [(0, 50, 400, 380, RED), (50, 100, 300, 280, GREY)]


@pytest.mark.parametrize("inner", [(150, 180, 100, 100, RED), (60, 110, 280, 260, RED)], ids=["small", "large"])
def test_surrounding_hole_does_not_replace_the_selected_object(inner: tuple[int, int, int, int, Any]) -> None:
    following = ContourTracker(OutlineSelect())
    assert following.find(drawn(*FRAME, inner)) == (2, "")
    assert following.find(drawn(*FRAME))[0] == -1
    assert following.find(drawn(*FRAME, inner)) == (2, "")


@pytest.mark.parametrize("arm", [200, 130], ids=["much", "little"])
def test_object_cut_off_by_the_border_does_not_replace_the_selected_one(arm: int) -> None:
    whole = (0, 100, 300, 100, RED)
    following = ContourTracker(OutlineSelect())
    assert following.find(drawn(whole, (0, 100, arm, 100, GREY))) == (0, "")
    assert following.find(drawn(whole))[0] == -1
    assert following.find(drawn(whole, (0, 100, arm, 100, GREY))) == (0, "")
    by_index = ContourTracker(OutlineSelect(rule="index", index=0))
    assert [by_index.find(drawn(whole))[0] for _ in range(2)] == [0, 0]


@pytest.mark.parametrize("size", [60, 160])
def test_object_of_another_color_does_not_replace_the_selected_one(size: int) -> None:
    following = ContourTracker(OutlineSelect(rule="colour", colour="red"))
    red, green = ((230 - s // 2, 230 - s // 2, s, s, colour) for s, colour in ((60, RED), (size, GREEN)))
    assert following.find(drawn(red)) == (0, "")
    assert following.find(drawn(green))[0] == -1
    assert following.find(drawn(red)) == (0, "")


def test_selection_by_position_is_independent_of_the_numbering() -> None:
    seen = [square(0, 100, 300, 50), square(1, 400, 100, 50)]
    now = [square(0, 300, 400, 50), square(1, 101, 300, 50), square(2, 400, 100, 50)]
    following = ContourTracker(None)
    for contour, index in zip(seen, (1, 2), strict=True):
        choice = OutlineSelect(rule="index", index=contour.index, at=middle_of(contour))
        assert following.select(now, choice).index == index == following.find(now)[0]
    with pytest.raises(NoSuchContour, match="contour 1 is not where it was seen"):
        following.select(now[:2], OutlineSelect(rule="index", index=1, at=middle_of(seen[1])))


def test_index_distinguishes_an_object_from_its_central_hole() -> None:
    contours = [square(0, 100, 100, 100), square(1, 130, 131, 40)]
    for contour in contours:
        choice = OutlineSelect(rule="index", index=contour.index, at=middle_of(contour))
        assert ContourTracker(None).select(contours, choice) is contour


def test_slowly_changing_object_stays_selected() -> None:
    following = ContourTracker(OutlineSelect())
    following.find([square(0, 100, 100, 50)])
    for step in range(1, 12):
        moved = square(1, 100 + 20 * step, 100, 50 + 5 * step)
        assert following.find([square(0, 400, 400, 50), moved]) == (1, "")
