"""What is held follows from the width of the fingers and from what is missing in the tray."""

import pytest

from applications.sorting.checking import by_picture, by_width, width_remark
from applications.sorting.topics import SeenObject
from common.messages import Vector3


def at(name, x, y=0.0, volume=4e-5, size=0.04):
    return SeenObject(id=name, center=Vector3(x=x, y=y), size=Vector3(x=size, y=0.03, z=0.03), volume=volume)


@pytest.mark.parametrize(("width", "holding", "held"), [
    (0.0, False, "empty"), (0.03, False, "empty"), (0.001, True, "empty"), (0.03, True, "")])
def test_width_shows_an_empty_grasp(width, holding, held):
    assert by_width(width, holding).held == held


@pytest.mark.parametrize(("width", "expected", "remark"), [
    (0.03, 0.035, ""), (0.05, 0.03, "50 mm wide, not 30 mm"), (0.01, 0.03, "10 mm wide, not 30 mm")])
def test_width_off_its_tolerance_is_remarked(width, expected, remark):
    assert width_remark(width, expected, 0.015) == remark


A, B, C = at("a", 0.50), at("b", 0.56), at("c", 0.70)


@pytest.mark.parametrize(("before", "after", "held", "why"), [
    ([A, B, C], [B, C], "one", ""),
    ([A], [], "one", ""),
    ([A, B, C], [C], "two", "a and b are missing"),
    ([A, C], [], "one", ""),  # c is too far away to be in the gripper
    ([A, B, C], [at("b", 0.60), C], "one", ""),  # b was only pushed
    ([A, B], [A, B], "one", "nothing is missing"),
    ([A, B], [at("m", 0.56, volume=5e-5)], "one", ""),
    ([at("m", 0.53, volume=8e-5, size=0.1), C], [B, C], "one", ""),  # two that touched, seen as one, and one was taken
])
def test_what_is_missing_in_the_tray_shows_what_is_held(before, after, held, why):
    found = by_picture(before[0], (0.50, 0.0), before, after)
    assert (found.held, why in found.why) == (held, True), found


TWO_COLORED = A.model_copy(update={"why": "two colors, touches others"})
TOUCHING = at("t", 0.542)
WIDER = "55 mm wide, not 30 mm"


@pytest.mark.parametrize(("before", "remark", "held", "text"), [
    ([TWO_COLORED, C], "", "one", "two colors"),
    ([A, C], WIDER, "one", WIDER),
    ([TWO_COLORED, C], WIDER, "two", f"a: two colors, {WIDER}"),
    ([A, TOUCHING, C], "", "one", "t of the same color touched it and is missing"),  # a gear that was seen as two
    ([A, TOUCHING.model_copy(update={"color_name": "red"}), C], "", "two", "a and t are missing in the tray"),
    ([A, C], "", "one", ""),
])
def test_two_objects_need_evidence_and_less_is_a_doubt(before, remark, held, text):
    found = by_picture(before[0], (0.50, 0.0), before, [C], remark)
    assert (found.held, found.why or found.doubt) == (held, text)
