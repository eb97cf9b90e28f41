"""Labels of the scene: those that would overlap on the screen are merged."""

from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from page.nodes import CHAR_WIDTH, LINE_HEIGHT, Labels, group_labels, projection_of

Array = NDArray[np.float64]


def project(points: Array) -> Array:
    """Project with x to the right and y down, one pixel per millimeter."""
    return 1e3 * points[:, :2]


@given(st.lists(st.tuples(st.text("abc", min_size=1, max_size=12), st.integers(0, 400), st.integers(0, 300)),
                min_size=1, max_size=12))
def test_groups_do_not_overlap_and_contain_every_label(made: list[tuple[str, int, int]]) -> None:
    labels = [(text, np.array([x * 1e-3, y * 1e-3, 0.0])) for text, x, y in made]
    groups = group_labels(labels, 1.0, project)
    boxes = []
    for group in groups:
        (left, low), (width, height) = group.corner, group.size(1.0)
        boxes.append((left, left + width, low - height, low))
    for (left, right, top, low), (left2, right2, top2, low2) in combinations(boxes, 2):
        assert right <= left2 or right2 <= left or low <= top2 or low2 <= top
    assert sorted(text for group in groups for text in group.lines) == sorted(text for text, *_ in made)


def test_distant_labels_are_separate_and_coinciding_ones_are_lines_of_one(server: viser.ViserServer) -> None:
    server.scene.reset()
    labels = Labels(server.scene, "/here", scale=1.0)
    width = 1e-3 * CHAR_WIDTH * len("flange")
    shown = {"a": ("flange", np.zeros(3)), "b": ("hand", np.zeros(3)), "c": ("tool", np.array([width * 1.1, 0, 0]))}
    labels.show(shown, project)
    assert labels.texts == ["flange\nhand", "tool"]
    shown["b"] = ("hand", np.array([0, -2.1e-3 * LINE_HEIGHT, 0]))
    labels.show(shown, project)
    assert labels.texts == ["flange", "hand", "tool"]
    labels.show({}, project)
    assert labels.texts == []


def test_without_a_projection_near_labels_are_merged() -> None:
    labels = [("a", np.zeros(3)), ("b", np.array([0.01, 0, 0])), ("c", np.array([0.2, 0, 0]))]
    assert [group.lines for group in group_labels(labels, 1.0, None)] == [["a", "b"], ["c"]]


def test_projection_of_a_browser_camera() -> None:
    camera: Any = SimpleNamespace(  # looking down, x to the right
        wxyz=(0.0, 1.0, 0.0, 0.0), position=(0.0, 0.0, 2.0), image_height=600, image_width=800, fov=2 * np.arctan(0.5))
    pixels = projection_of(camera)(np.array([[0.0, 0, 0], [0.5, 0, 0], [0, 0.5, 0], [0, 0, 3.0]]))
    assert pixels[:3] == pytest.approx(np.array([[400, 300], [550, 300], [400, 150]]))
    assert np.isnan(pixels[3]).all()
