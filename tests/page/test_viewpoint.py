"""The field of view fits robot and table into narrow scenes."""

import math

import pytest

from page.viewpoint import FOV, MAX_FOV, field_of_view


@pytest.mark.parametrize(("width", "height", "as_wide"), [(1600, 900, False), (550, 700, True), (0, 0, False)])
def test_narrow_scene_is_as_wide_as_a_square_one(width: float, height: float, as_wide: bool) -> None:
    fov = field_of_view(width, height)
    assert fov == FOV if not as_wide else math.tan(fov / 2) * width / height == pytest.approx(math.tan(FOV / 2))
    assert field_of_view(1, 1000) == MAX_FOV
