"""Choosing a contour by a rule, and following the chosen object from image to image."""

import cv2
import numpy as np
import pytest

from applications.outlining import contour_choice as choice
from applications.outlining.contours import ContourOptions, find_contours
from applications.outlining.topics import Contour, OutlineSelect
from common.messages import Color
from tests.applications.outlining.outline_scenes import BLUE, GREEN, RED, SEED, rectangles

GREY = (128, 128, 128)


def square(index, u, v, side):
    pixels = [(u, v), (u + side, v), (u + side, v + side), (u, v + side)]
    return Contour(index=index, label=f"Object_{index}", pixels=pixels, area=side**2)


def contours_of(*boxes):
    """Return the contours of boxes (left, top, width, height, bgr8) on black."""
    return find_contours(rectangles(*boxes), SEED)


def on_grey(*boxes):
    """Return the contours of boxes (left, top, width, height, bgr8) on grey, later ones in front."""
    image = np.full((480, 640, 3), 128, np.uint8)
    for u, v, width, height, color in boxes:
        cv2.rectangle(image, (u, v), (u + width, v + height), color, -1)
    return find_contours(image, ContourOptions(subpixel=False))


def test_auto_selects_the_largest_contour_off_the_border():
    contours = contours_of((0, 0, 80, 80, RED), (100, 20, 20, 20, BLUE), (100, 60, 30, 30, GREEN))
    assert choice.colour_name(choice.choose(contours, OutlineSelect()).color) == "green"
    assert choice.colour_name(choice.choose(contours, OutlineSelect(rule="colour", colour="Blue")).color) == "blue"
    with pytest.raises(choice.NoSuchContour, match="every red contour touches the border"):
        choice.choose(contours, OutlineSelect(rule="colour", colour="red"))
    red = next(c for c in contours if c.touches_border)
    assert choice.choose(contours, OutlineSelect(rule="index", index=red.index)) is red


@pytest.mark.parametrize(("wanted", "message"), [
    (OutlineSelect(rule="index", index=5), r"no contour 5; choices: 0 \(Object_0, red\)"),
    (OutlineSelect(rule="index"), "no index is given"),
    (OutlineSelect(rule="colour", colour="green"), r"no green contour; choices: 0 \(Object_0, red\)"),
    (OutlineSelect(rule="colour", colour="beige"), "'beige' is no colour; choices: red, orange"),
])
def test_missing_contour_is_rejected_with_the_choices(wanted, message):
    with pytest.raises(choice.NoSuchContour, match=message):
        choice.choose(contours_of((20, 20, 30, 30, RED)), wanted)


def test_empty_image_has_no_contour_to_select():
    assert contours_of() == [] and choice.described([]) == "none"
    with pytest.raises(choice.NoSuchContour, match="the picture has no contour"):
        choice.choose([], OutlineSelect())


@pytest.mark.parametrize(("text", "rule", "value"), [
    ("auto", "auto", None), (3, "index", 3), ("3", "index", 3), ("Object_2", "index", 2), ("gray", "colour", "gray")])
def test_text_is_parsed_to_a_selection(text, rule, value):
    wanted = choice.parse_choice(text)
    assert wanted.rule == rule and value in (None, wanted.index, wanted.colour)


def test_empty_text_selects_nothing_and_nonsense_is_rejected():
    assert choice.parse_choice("none") is choice.parse_choice("") is None
    with pytest.raises(choice.NoSuchContour, match="choices: none, auto, an index, red"):
        choice.parse_choice("largest")


@pytest.mark.parametrize(("rgb", "name"), [
    ((1, 1, 0), "yellow"), ((1, 0, 0), "red"), ((0, 1, 0), "green"), ((0, 0, 1), "blue"), ((0, 0, 0), "black"),
    ((1, 1, 1), "white"), ((0.7, 0.7, 0.7), "grey"), ((1, 0, 0.05), "red"), ((1, 0.5, 0), "orange")])
def test_colors_have_their_common_names(rgb, name):
    assert choice.colour_name(Color(r=rgb[0], g=rgb[1], b=rgb[2])) == name and name in choice.NAMES


def test_annotation_draws_the_selected_contour_on_a_copy():
    image = rectangles((20, 20, 60, 60, RED), (100, 60, 20, 20, BLUE))
    before = image.copy()
    contours = find_contours(image, SEED)
    shown = choice.annotate_contours(image, contours, choice.choose(contours, OutlineSelect()).index)
    np.testing.assert_array_equal(image, before)
    assert (shown == choice.CHOSEN).all(axis=2).sum() > 200
    assert cv2.absdiff(shown, image)[62:78, 102:118].any() or cv2.absdiff(shown, image)[55:85, 90:130].any()


def test_selected_object_is_followed_and_not_replaced():
    tracker = choice.ContourTracker(OutlineSelect())
    here = contours_of((20, 20, 30, 30, RED), (80, 60, 20, 20, BLUE))
    index, problem = tracker.find(here)
    assert choice.colour_name(here[index].color) == "red" and not problem
    moved = contours_of((25, 22, 30, 30, RED), (80, 60, 20, 20, BLUE), (100, 5, 50, 50, GREEN))
    assert choice.colour_name(moved[tracker.find(moved)[0]].color) == "red"
    hidden = contours_of((80, 60, 20, 20, BLUE), (100, 5, 50, 50, GREEN))
    index, problem = tracker.find(hidden)
    assert index == -1 and "not seen any more" in problem
    assert choice.colour_name(moved[tracker.find(moved)[0]].color) == "red"


def test_selection_without_match_is_retried_and_a_rejected_one_changes_nothing():
    tracker = choice.ContourTracker(OutlineSelect(rule="colour", colour="blue"))
    assert tracker.find(contours_of((20, 20, 30, 30, RED)))[0] == -1
    both = contours_of((20, 20, 30, 30, RED), (80, 60, 20, 20, BLUE))
    assert choice.colour_name(both[tracker.find(both)[0]].color) == "blue"
    with pytest.raises(choice.NoSuchContour):
        tracker.select(both, OutlineSelect(rule="index", index=9))
    assert choice.colour_name(both[tracker.find(both)[0]].color) == "blue"
    assert choice.ContourTracker(None).find(both) == (-1, f"no object is chosen; choices: {choice.described(both)}")


def test_gradually_occluded_object_is_found_again():
    tracker = choice.ContourTracker(OutlineSelect())
    for side in (100, 80, 60, 45, 35, 27, 20):
        assert tracker.find([square(0, 100, 100, side)]) == (0, "")
    assert tracker.find([])[0] == -1
    assert tracker.find([square(0, 400, 400, 30), square(1, 100, 100, 100)]) == (1, "")


def test_slowly_changing_object_stays_selected():
    tracker = choice.ContourTracker(OutlineSelect())
    tracker.find([square(0, 100, 100, 50)])
    for step in range(1, 12):
        moved = square(1, 100 + 20 * step, 100, 50 + 5 * step)
        assert tracker.find([square(0, 400, 400, 50), moved]) == (1, "")


@pytest.mark.parametrize(("by_operator", "found"), [(False, (1, "")), (True, (-1, "Object_0 is not seen any more"))])
def test_automatically_selected_part_is_replaced_by_the_complete_object(by_operator, found):
    part, others = square(0, 110, 110, 20), [square(0, 300, 100, 200), square(1, 100, 100, 100)]
    tracker = choice.ContourTracker(OutlineSelect())
    assert tracker.find([part]) == (0, "")
    if by_operator:
        tracker.select([part], OutlineSelect())
    assert tracker.find([square(0, 300, 100, 200)])[0] == -1
    index, why = tracker.find(others)
    assert (index, why[:len(found[1])]) == found
    assert tracker.find([square(0, 110, 110, 90), square(1, 300, 100, 200)])[0] == (-1 if by_operator else 0)


FRAME = [(0, 50, 400, 380, RED), (50, 100, 300, 280, GREY)]
AT_BORDER = (0, 100, 300, 100, RED)


@pytest.mark.parametrize(("rule", "there", "gone", "index"), [
    (OutlineSelect(), on_grey(*FRAME, (150, 180, 100, 100, RED)), on_grey(*FRAME), 2),  # a hole surrounds it
    (OutlineSelect(), on_grey(*FRAME, (60, 110, 280, 260, RED)), on_grey(*FRAME), 2),
    (OutlineSelect(), on_grey(AT_BORDER, (0, 100, 200, 100, GREY)), on_grey(AT_BORDER), 0),  # cut off by the border
    (OutlineSelect(), on_grey(AT_BORDER, (0, 100, 130, 100, GREY)), on_grey(AT_BORDER), 0),
    (OutlineSelect(rule="colour", colour="red"), on_grey((200, 200, 60, 60, RED)),
     on_grey((200, 200, 60, 60, GREEN)), 0),
    (OutlineSelect(rule="colour", colour="red"), on_grey((200, 200, 60, 60, RED)),
     on_grey((150, 150, 160, 160, GREEN)), 0),
])
def test_hole_cut_off_object_or_other_color_does_not_replace_the_selected_object(rule, there, gone, index):
    tracker = choice.ContourTracker(rule)
    assert tracker.find(there) == (index, "")
    assert tracker.find(gone)[0] == -1
    assert tracker.find(there) == (index, "")


def test_object_at_the_border_can_be_selected_by_its_index():
    tracker = choice.ContourTracker(OutlineSelect(rule="index", index=0))
    assert [tracker.find(on_grey(AT_BORDER))[0] for _ in range(2)] == [0, 0]


def test_selection_by_position_is_independent_of_the_numbering():
    seen = [square(0, 100, 300, 50), square(1, 400, 100, 50)]
    now = [square(0, 300, 400, 50), square(1, 101, 300, 50), square(2, 400, 100, 50)]
    tracker = choice.ContourTracker(None)
    for contour, index in zip(seen, (1, 2), strict=True):
        wanted = OutlineSelect(rule="index", index=contour.index, at=choice.middle_of(contour))
        assert tracker.select(now, wanted).index == index == tracker.find(now)[0]
    with pytest.raises(choice.NoSuchContour, match="contour 1 is not where it was seen"):
        tracker.select(now[:2], OutlineSelect(rule="index", index=1, at=choice.middle_of(seen[1])))
    nested = [square(0, 100, 100, 100), square(1, 130, 131, 40)]  # an object and its central hole
    for contour in nested:
        wanted = OutlineSelect(rule="index", index=contour.index, at=choice.middle_of(contour))
        assert choice.ContourTracker(None).select(nested, wanted) is contour
