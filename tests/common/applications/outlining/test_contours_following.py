from __future__ import annotations

import pytest

from common.applications.outlining.contours_following import Following
from common.applications.outlining.messages import Contour, OutlineSelect


def square(index: int, u: float, v: float, side: float) -> Contour:
    pixels = [(u, v), (u + side, v), (u + side, v + side), (u, v + side)]
    return Contour(index=index, label=f"Object_{index}", pixels=pixels, area=side**2)


def test_object_that_the_arm_hid_bit_by_bit_is_found_again_when_it_is_whole() -> None:
    whole = square(0, 100, 100, 100)
    following = Following(OutlineSelect())
    assert following.find([whole]) == (0, "")
    for side in (80, 60, 45, 35, 27, 20):
        part = square(0, 100, 100, side)
        assert following.find([part])[0] == 0
    assert following.find([])[0] == -1
    assert following.find([square(0, 400, 400, 30), square(1, 100, 100, 100)]) == (1, "")


@pytest.mark.parametrize(("by_person", "found"), [(False, (1, "")), (True, (-1, "Object_0 is not seen any more"))])
def test_part_that_was_chosen_by_itself_while_the_arm_hid_the_rest_becomes_the_whole(by_person, found) -> None:
    part, others = square(0, 110, 110, 20), [square(0, 300, 100, 200), square(1, 100, 100, 100)]
    following = Following(OutlineSelect())
    assert following.find([part]) == (0, "")
    if by_person:
        following.select([part], OutlineSelect())
    assert following.find([square(0, 300, 100, 200)])[0] == -1
    index, why = following.find(others)
    assert (index, why[:len(found[1])]) == found
    assert following.find([square(0, 110, 110, 90), square(1, 300, 100, 200)])[0] == (-1 if by_person else 0)


def test_object_that_moves_and_grows_slowly_stays_chosen() -> None:
    following = Following(OutlineSelect())
    following.find([square(0, 100, 100, 50)])
    for step in range(1, 12):
        moved = square(1, 100 + 20 * step, 100, 50 + 5 * step)
        assert following.find([square(0, 400, 400, 50), moved]) == (1, "")
