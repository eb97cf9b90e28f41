"""Contours on their objects, and selection of an object by a click."""

from typing import Any

import numpy as np
import pytest

from applications.outlining.topics import CONTOUR_PATH, CONTOURS, Contour, Contours, OutlinePoints, OutlineSelect
from common import messages as m
from common import topics
from common.perception.pinhole import Pinhole
from tests.page.scene_cell import WORLD, Stage, around_of, at, scene_of

TOP = 1.06  # of the object [m]; the base is 1 m high
CAMERA = Pinhole.from_config(around_of("ur5").camera)
INFO = CAMERA.info(m.Header(frame_id=around_of("ur5").camera.frame))


def square(x: float, y: float, z: float, half: float = 0.03) -> np.ndarray[Any, np.dtype[np.float64]]:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    return np.column_stack([corners + np.array([x, y]), np.full(4, z)])


@pytest.fixture
def stage(ur5: Stage) -> Stage:
    ur5.say(topics.DEPTH_CAMERA_INFO, INFO)
    return ur5


def contours(*squares: tuple[str, np.ndarray[Any, np.dtype[np.float64]]], selected: int = -1) -> Contours:
    return Contours(header=WORLD, width=1024, height=768, selected=selected, contours=[
        Contour(index=i, label=label, pixels=[(float(u), float(v)) for u, v in CAMERA.project(points)], area=float(i))
        for i, (label, points) in enumerate(squares)])


TWO = contours(("red_1", square(0.45, 0, 1.0)), ("blue_1", square(0.55, 0, 1.0)), selected=1)


def nodes(stage: Stage) -> dict[str, Any]:
    return {node.name.rsplit("/", 1)[1]: node for node in stage.layer("contours").nodes}


def test_contour_is_on_the_fixture_below_until_its_object_is_known(stage: Stage) -> None:
    points = square(0.5, 0.0, TOP)
    stage.say(CONTOURS, contours(("yellow_1", points)))
    assert nodes(stage)["0_line"].points[0, 0, 2] == pytest.approx(1.0, abs=0.003)
    prism = m.CollisionObject(id="yellow_1", role="target", shape="prism", dimensions=[0.06],
                              pose=at(0.5, 0, TOP - 0.03), outline=square(0, 0, 0)[:, :2].tolist())
    stage.say(topics.PLANNING_SCENE, scene_of(prism))
    line = nodes(stage)["0_line"].points
    np.testing.assert_allclose(line[:, 0], points, atol=0.003)
    np.testing.assert_allclose(line[:, 1], np.roll(points, -1, axis=0), atol=0.003)


def test_largest_contours_and_the_selected_one_are_offered_in_noise(stage: Stage) -> None:
    squares = ((f"Object_{i}", square(0.4 + 1e-3 * i, 0.0, 1.0, half=0.01)) for i in range(300))
    stage.say(CONTOURS, contours(*squares, selected=7))
    assert {int(name.partition("_")[0]) for name in nodes(stage)} == {7, *range(201, 300)}


def test_each_contour_has_a_pin_and_a_label_and_the_selected_one_is_white(stage: Stage) -> None:
    stage.say(CONTOURS, TWO)
    shown = nodes(stage)
    assert stage.layer("contours").labels.texts == ["1: blue_1", "0: red_1"]
    assert shown["1_pin"].color == (255, 255, 255)
    np.testing.assert_allclose(shown["0_pin"].position[:2], [0.45, 0.0], atol=0.002)
    with stage.sent() as sent:
        stage.say(CONTOURS, TWO.model_copy(update={"header": m.Header(stamp=5, frame_id="camera")}))
    assert not sent


async def test_click_on_a_pin_selects_its_contour(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[OutlineSelect] = []
    monkeypatch.setattr("applications.outlining.page.choose", lambda _console, choice: chosen.append(choice))
    stage.say(CONTOURS, TWO)
    for entry in nodes(stage)["1_pin"]._impl.click_cb:
        await entry.callback(None)
    at = np.mean(TWO.contours[1].pixels, axis=0)
    assert [(choice.rule, choice.index, choice.at) for choice in chosen] == [("index", 1, pytest.approx(tuple(at)))]


def test_contours_of_an_unknown_or_distorted_camera_are_left_out(ur5: Stage) -> None:
    ur5.say(CONTOURS, TWO)
    assert nodes(ur5) == {}
    ur5.say(topics.DEPTH_CAMERA_INFO, INFO.model_copy(update={"d": [0.1, 0.0, 0.0, 0.0, 0.0]}))
    ur5.say(CONTOURS, TWO)
    assert nodes(ur5) == {}


def test_outline_is_a_closed_line_and_is_removed_without_points(stage: Stage) -> None:
    poses = [at(*point) for point in square(0.5, 0, TOP).tolist()]
    stage.say(CONTOUR_PATH, OutlinePoints(header=WORLD, poses=poses, object="yellow_1"))
    node = stage.layer("outline").node
    assert len(node.points) == 4
    np.testing.assert_allclose(node.points[-1, 1], node.points[0, 0])
    stage.say(CONTOUR_PATH, OutlinePoints(header=WORLD, message="nothing is chosen"))
    assert stage.layer("outline").node is None
