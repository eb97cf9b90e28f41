"""Words do not lie over one another: what would is said in lines of one label."""

from __future__ import annotations

import time

import numpy as np
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from page.labels import CONTROL_PATH, LETTER, Labels, grouped

Array = NDArray[np.float64]


def as_pixels(points: Array) -> Array:
    """Somebody who sees x to the right and y downwards, a pixel for each millimetre."""
    return 1e3 * points[:, :2]


@given(st.lists(st.tuples(st.text("abc", min_size=1, max_size=12), st.integers(0, 400), st.integers(0, 300)),
                min_size=1, max_size=12))
def test_no_two_labels_overlap_and_every_word_is_said_once(made: list[tuple[str, int, int]]) -> None:
    labels = [(word, np.array([x * 1e-3, y * 1e-3, 0.0])) for word, x, y in made]
    groups = grouped(labels, 1.0, as_pixels)
    boxes = []
    for group in groups:
        (left, low), (width, height) = group.corner, group.size(1.0)
        boxes.append((left, left + width, low - height, low))
    for i, (left, right, top, low) in enumerate(boxes):
        for left2, right2, top2, low2 in boxes[i + 1:]:
            assert right <= left2 or right2 <= left or low <= top2 or low2 <= top
    assert sorted(word for group in groups for word in group.words) == sorted(word for word, *_ in made)


def test_labels_apart_stay_apart_and_those_at_one_place_are_lines_of_one(server: viser.ViserServer) -> None:
    server.scene.reset()
    labels = Labels(server.scene, "/here", scale=1.0)
    wide = 1e-3 * LETTER * len("flange")
    places = {"a": ("flange", np.zeros(3)), "b": ("hand", np.zeros(3)), "c": ("tool", np.array([wide * 1.1, 0, 0]))}
    labels.show(places, as_pixels)
    assert labels.texts == ["flange\nhand", "tool"]
    places["b"] = ("hand", np.array([0, -2.1e-3 * CONTROL_PATH, 0]))
    labels.show(places, as_pixels)
    assert labels.texts == ["flange", "hand", "tool"]
    labels.show({}, as_pixels)
    assert labels.texts == []


def test_many_labels_at_one_place_among_many_apart_are_put_together_at_once() -> None:
    labels = [("a", np.array([float(x), 0, 0])) for x in range(1000)] + [("b", np.array([0.0, -9.0, 0.0]))] * 2000
    since = time.process_time()
    assert [len(group.words) for group in grouped(labels, 1.0, as_pixels)] == [1] * 1000 + [2000]
    assert time.process_time() - since < 10  # looked at pair by pair anew after each it would be hours


def test_where_nobody_tells_how_they_look_what_is_near_is_put_together() -> None:
    labels = [("a", np.zeros(3)), ("b", np.array([0.01, 0, 0])), ("c", np.array([0.2, 0, 0]))]
    assert [group.words for group in grouped(labels, 1.0, None)] == [["a", "b"], ["c"]]


def test_page_looks_through_the_camera_of_a_browser() -> None:
    from page.labels import view_of

    class Camera:  # at (0, 0, 2), looking down, x to the right
        wxyz, position = (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 2.0)
        image_height, image_width, fov = 600, 800, 2 * np.arctan(0.5)

    seen = view_of(Camera())(np.array([[0.0, 0, 0], [0.5, 0, 0], [0, 0.5, 0], [0, 0, 3.0]]))  # type: ignore[arg-type]
    assert seen[:3] == pytest.approx(np.array([[400, 300], [550, 300], [400, 150]]))
    assert np.isnan(seen[3]).all()
