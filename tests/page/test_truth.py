"""The truth is shown when asked for; in the simulated world things are pulled about on their plane."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from common import messages as m
from common import topics
from page.layers.truth import on_plane
from tests.page.scene_cell import WORLD, Stage, at, is_shown

EYE = np.array([1.0, -1.0, 1.0])


def balls(state: str = "table", **places: tuple[float, float]) -> m.WorldObjects:
    size = m.Vector3(x=0.06, y=0.06, z=0.06)
    things = [{"id": name, "shape": "sphere", "size": size, "pose": at(x, y, 0.03), "state": state}
              for name, (x, y) in places.items()]
    return m.WorldObjects(header=WORLD, objects=[m.WorldObject.model_validate(thing) for thing in things])


def disc(x: float) -> m.WorldObject:
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    outline = [(float(x + 0.02 * np.cos(a)), float(0.02 * np.sin(a))) for a in angles]
    return m.WorldObject(id="disc", shape="cylinder", outline=outline, base=1.0, height=0.02)


def event(phase: str, start: tuple[float, ...], end: tuple[float, ...]) -> Any:
    return SimpleNamespace(
        phase=phase, client=SimpleNamespace(camera=SimpleNamespace(position=EYE)), start_position=start,
        end_position=end,
    )


async def pull(node: Any, start: tuple[float, float], *way: tuple[float, float], z: float = 0.03) -> None:
    """What viser says when somebody drags a node: points on a plane across the line of sight."""
    def seen_at(x: float, y: float) -> tuple[float, ...]:
        return tuple(EYE + 0.7 * (np.array([x, y, z]) - EYE))  # nearer to the eye, in the same line of sight

    for entry in list(node._impl.drag_cb):
        await entry.callback(event("start", (*start, z), (*start, z)))
        for place in way:
            await entry.callback(event("update", (*start, z), seen_at(*place)))
        await entry.callback(event("end", (*start, z), seen_at(*way[-1])))


@pytest.fixture
def moved(panda: Stage) -> list[tuple[str, float, float]]:
    found: list[tuple[str, float, float]] = panda.console.moved
    return found


def test_truth_is_hidden_until_it_is_asked_for(panda: Stage) -> None:
    panda.say(topics.SCENE_OBJECTS, balls(ball_1=(0.4, 0.1)))
    panda.show("truth", True)
    node = panda.layer("truth").node("ball_1")
    assert is_shown(panda.server, node) and node.wireframe
    panda.show("truth", False)
    assert not is_shown(panda.server, node)


def test_more_corners_than_can_be_drawn_at_a_look_are_left_out(panda: Stage) -> None:
    panda.show("truth", True)
    corners = [(0.1 * np.cos(a), 0.1 * np.sin(a)) for a in np.linspace(0, 6, 1000)]
    size = m.Vector3(x=0.2, y=0.2, z=0.1)
    things = [m.WorldObject(id=f"{i}", shape="prism", polygon=corners, size=size) for i in range(100)]
    panda.say(topics.SCENE_OBJECTS, m.WorldObjects(header=WORLD, objects=[*things, *balls(last=(0.4, 0.1)).objects]))
    assert [panda.layer("truth").node(name) is not None for name in ("0", "1", "2", "99", "last")] == [
        True, True, False, False, False]


def test_balls_come_move_and_go(panda: Stage) -> None:
    panda.show("truth", True)
    panda.say(topics.SCENE_OBJECTS, balls(ball_1=(0.4, 0.1), ball_2=(0.5, 0.1)))
    first = panda.layer("truth").node("ball_1")
    panda.say(topics.SCENE_OBJECTS, balls(ball_1=(0.3, 0.1)))
    assert panda.layer("truth").node("ball_1") is first and panda.layer("truth").node("ball_2") is None
    np.testing.assert_allclose(first.position, [0.3, 0.1, 0.03])


def test_object_of_the_world_is_shown_in_its_size(ur5: Stage) -> None:
    ur5.show("truth", True)
    ur5.say(topics.SCENE_OBJECTS, m.WorldObjects(header=WORLD, objects=[disc(0.5)]))
    node = ur5.layer("truth").node("disc")
    np.testing.assert_allclose(node.position, [0.5, 0.0, 1.01], atol=1e-6)
    np.testing.assert_allclose(np.ptp(node.vertices, axis=0), [0.04, 0.04, 0.02], atol=1e-4)
    ur5.say(topics.SCENE_OBJECTS, m.WorldObjects(header=WORLD, objects=[disc(0.6)]))
    np.testing.assert_allclose(ur5.layer("truth").node("disc").position, [0.6, 0.0, 1.01], atol=1e-6)
    assert ur5.layer("truth").node("disc") is node  # moved and not sent again


async def test_object_is_dropped_where_it_was_pulled_to_and_can_be_pulled_again(ur5: Stage) -> None:
    ur5.edit(True)
    for x, to in ((0.5, 0.55), (0.55, 0.45)):
        ur5.say(topics.SCENE_OBJECTS, m.WorldObjects(header=WORLD, objects=[disc(x)]))
        node = ur5.layer("truth").node("disc")
        assert is_shown(ur5.server, node)
        np.testing.assert_allclose(node.position, [x, 0.0, 1.01], atol=1e-6)
        eye = EYE + np.array([0, 0, 1])
        for entry in list(node._impl.drag_cb):
            for phase, place in (("start", x), ("update", to), ("end", to)):
                drag = event(phase, (x, 0.0, 1.01), (place, 0.1, 1.01) if phase != "start" else (x, 0.0, 1.01))
                drag.client.camera.position = eye
                await entry.callback(drag)
    assert ur5.console.moved == [("disc", 0.55, 0.1), ("disc", 0.45, 0.1)]


async def test_ball_is_dropped_where_it_was_pulled_to(panda: Stage, moved: list[tuple[str, float, float]]) -> None:
    panda.say(topics.SCENE_OBJECTS, balls(ball_1=(0.4, 0.1)))
    panda.edit(True)
    node = panda.layer("truth").node("ball_1")
    assert is_shown(panda.server, node)  # though the truth is not ticked
    await pull(node, (0.41, 0.1), (0.45, 0.1), (0.51, 0.2))  # taken 1 cm beside its middle
    assert moved == [("ball_1", 0.5, 0.2)]
    np.testing.assert_allclose(node.position, [0.4, 0.1, 0.03])  # until the world says that it was moved


async def test_ball_follows_the_pointer_and_not_the_world_meanwhile(panda: Stage) -> None:
    panda.say(topics.SCENE_OBJECTS, balls(ball_1=(0.4, 0.1)))
    panda.edit(True)
    node = panda.layer("truth").node("ball_1")
    seen: list[list[float]] = []
    for entry in node._impl.drag_cb:
        for phase, place in (("start", (0.4, 0.1, 0.03)), ("update", (0.5, 0.2, 0.03))):
            await entry.callback(event(phase, (0.4, 0.1, 0.03), place))
        panda.say(topics.SCENE_OBJECTS, balls(ball_1=(0.4, 0.1)))
        seen.append(node.position.tolist())
    np.testing.assert_allclose(seen, [[0.5, 0.2, 0.03]])


async def test_nothing_is_pulled_without_editing(panda: Stage, moved: list[tuple[str, float, float]]) -> None:
    panda.show("truth", True)
    panda.say(topics.SCENE_OBJECTS, balls(ball_1=(0.4, 0.1)))
    node = panda.layer("truth").node("ball_1")
    await pull(node, (0.4, 0.1), (0.5, 0.2))
    panda.edit(True)
    panda.edit(False)
    await pull(node, (0.4, 0.1), (0.5, 0.2))
    assert moved == [] and is_shown(panda.server, node)


async def test_ball_in_the_hand_can_not_be_pulled(panda: Stage, moved: list[tuple[str, float, float]]) -> None:
    panda.edit(True)
    for state, count in (("held", 0), ("falling", 0), ("contained", 1)):
        panda.say(topics.SCENE_OBJECTS, balls(state, ball_1=(0.4, 0.1)))
        await pull(panda.layer("truth").node("ball_1"), (0.4, 0.1), (0.5, 0.2))
        assert len(moved) == count


async def test_ball_that_goes_while_it_is_pulled_does_no_harm(
    panda: Stage, moved: list[tuple[str, float, float]]
) -> None:
    panda.edit(True)
    panda.say(topics.SCENE_OBJECTS, balls(ball_1=(0.4, 0.1)))
    node = panda.layer("truth").node("ball_1")
    callbacks, place = list(node._impl.drag_cb), (0.4, 0.1, 0.03)
    await callbacks[0].callback(event("start", place, place))
    panda.say(topics.SCENE_OBJECTS, balls())
    for phase in ("update", "end"):
        await callbacks[0].callback(event(phase, place, place))
    assert moved == []


def test_line_of_sight_meets_the_plane_below_and_not_above_the_horizon() -> None:
    assert on_plane((0, 0, 2), (1, 1, 1), 0.0) == pytest.approx((2, 2))
    assert on_plane((0, 0, 2), (1, 1, 3), 0.0) is None
    assert on_plane((0, 0, 2), (1, 1, 2), 0.0) is None
