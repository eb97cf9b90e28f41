"""Labels in images."""

import numpy as np
import pytest

from common.perception.labels import draw_labels


@pytest.mark.parametrize(("width", "places"), [
    (640, [(320, 240), (340, 240), (330, 250)]), (1280, [(5, 5), (1279, 700)]), (20, [(10, 10)])])
def test_labels_stay_in_the_image_and_none_covers_another(width: int, places: list[tuple[int, int]]) -> None:
    image = np.zeros((width * 3 // 4, width, 3), np.uint8)
    drawn = []
    for count in range(1, len(places) + 1):
        image[:] = 0
        draw_labels(image, [(f"{number}.500 -0.170", u, v, 20.0) for number, (u, v) in enumerate(places[:count])])
        drawn.append(int((image.max(axis=2) > 0).sum()))
    areas = np.diff([0, *drawn])
    assert width < 100 or areas == pytest.approx(areas[0], rel=0.2), "each label is drawn completely"
