from __future__ import annotations

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


def test_object_that_moves_and_grows_slowly_stays_chosen() -> None:
    following = Following(OutlineSelect())
    following.find([square(0, 100, 100, 50)])
    for step in range(1, 12):
        moved = square(1, 100 + 20 * step, 100, 50 + 5 * step)
        assert following.find([square(0, 400, 400, 50), moved]) == (1, "")
