"""Ground truth, and dragging objects of the simulated world in their plane."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from common import messages as m
from common import topics
from page.layers.truth import intersect_horizontal
from tests.page.scene_cell import WORLD, Stage, at, is_shown

EYE = np.array([1.0, -1.0, 1.0])
Moved = list[tuple[str, float, float]]


def balls(state: Any = "table", **positions: tuple[float, float]) -> m.WorldObjects:
    size = m.Vector3(x=0.06, y=0.06, z=0.06)
    return m.WorldObjects(header=WORLD, objects=[
        m.WorldObject(id=name, shape="sphere", size=size, pose=at(x, y, 0.03), state=state)
        for name, (x, y) in positions.items()])


def disc(x: float) -> m.WorldObjects:
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    outline = [(float(x + 0.02 * np.cos(a)), float(0.02 * np.sin(a))) for a in angles]
    return m.WorldObjects(header=WORLD, objects=[
        m.WorldObject(id="disc", shape="cylinder", outline=outline, base=1.0, height=0.02)])


def event(phase: str, start: tuple[float, ...], end: tuple[float, ...], eye: Any = EYE) -> Any:
    return SimpleNamespace(phase=phase, client=SimpleNamespace(camera=SimpleNamespace(position=eye)),
                           start_position=start, end_position=end)


async def drag(node: Any, start: tuple[float, float], *path: tuple[float, float], z: float = 0.03, eye: Any = EYE,
               end: bool = True) -> None:
    """Send what viser sends when a node is dragged: points on a plane across the line of sight."""
    def on_view_plane(x: float, y: float) -> tuple[float, ...]:
        return tuple(eye + 0.7 * (np.array([x, y, z]) - eye))  # nearer to the eye, on the same line of sight

    for entry in list(node._impl.drag_cb):
        await entry.callback(event("start", (*start, z), (*start, z), eye))
        for position in path:
            await entry.callback(event("update", (*start, z), on_view_plane(*position), eye))
        if end:
            await entry.callback(event("end", (*start, z), on_view_plane(*path[-1]), eye))


@pytest.fixture
def moved(panda: Stage) -> Moved:
    found: Moved = panda.console.moved
    return found


def test_truth_is_hidden_by_default_and_has_the_newest_message_when_shown(panda: Stage) -> None:
    panda.say(topics.SCENE_OBJECTS, balls(ball_1=(0.4, 0.1)))
    assert panda.layer("truth").node("ball_1") is None
    for on in (True, False):
        panda.show("truth", on)
        node = panda.layer("truth").node("ball_1")
        assert is_shown(panda.server, node) is on and node.wireframe


def test_objects_beyond_the_work_limit_are_left_out(panda: Stage) -> None:
    panda.show("truth", True)
    corners = [(0.1 * np.cos(a), 0.1 * np.sin(a)) for a in np.linspace(0, 6, 1000)]
    size = m.Vector3(x=0.2, y=0.2, z=0.1)
    prisms = [m.WorldObject(id=f"{i}", shape="prism", polygon=corners, size=size) for i in range(100)]
    panda.say(topics.SCENE_OBJECTS, m.WorldObjects(header=WORLD, objects=[*prisms, *balls(last=(0.4, 0.1)).objects]))
    assert [panda.layer("truth").node(name) is not None for name in ("0", "1", "2", "99", "last")] == [
        True, True, False, False, False]


def test_objects_are_added_moved_without_sending_them_again_and_removed(ur5: Stage) -> None:
    ur5.show("truth", True)
    layer, nodes = ur5.layer("truth"), []
    for x in (0.5, 0.6):
        ur5.say(topics.SCENE_OBJECTS, disc(x))
        nodes.append(layer.node("disc"))
        np.testing.assert_allclose(nodes[-1].position, [x, 0.0, 1.01], atol=1e-6)
        np.testing.assert_allclose(np.ptp(nodes[-1].vertices, axis=0), [0.04, 0.04, 0.02], atol=1e-4)
    assert nodes[0] is nodes[1]
    ur5.say(topics.SCENE_OBJECTS, balls(ball_1=(0.4, 0.1)))
    assert layer.node("disc") is None and layer.node("ball_1") is not None


async def test_object_can_be_dragged_repeatedly(ur5: Stage) -> None:
    ur5.edit(True)
    for x, to in ((0.5, 0.55), (0.55, 0.45)):
        ur5.say(topics.SCENE_OBJECTS, disc(x))
        node = ur5.layer("truth").node("disc")
        assert is_shown(ur5.server, node)
        await drag(node, (x, 0.0), (to, 0.1), z=1.01, eye=EYE + np.array([0, 0, 1]))
    assert ur5.console.moved == [("disc", 0.55, 0.1), ("disc", 0.45, 0.1)] and ur5.console.selected == "disc"


async def test_dragged_ball_is_moved_by_the_pointer_offset(panda: Stage, moved: Moved) -> None:
    panda.say(topics.SCENE_OBJECTS, balls(ball_1=(0.4, 0.1)))
    panda.edit(True)
    node = panda.layer("truth").node("ball_1")
    assert is_shown(panda.server, node), "although the layer is switched off"
    await drag(node, (0.41, 0.1), (0.45, 0.1), (0.51, 0.2), end=False)  # grabbed 1 cm from its center
    panda.say(topics.SCENE_OBJECTS, balls(ball_1=(0.4, 0.1)))
    np.testing.assert_allclose(node.position, [0.5, 0.2, 0.03])
    assert moved == []
    (entry,) = node._impl.drag_cb
    await entry.callback(event("end", (0.41, 0.1, 0.03), (0.51, 0.2, 0.03)))
    assert moved == [("ball_1", 0.5, 0.2)]
    np.testing.assert_allclose(node.position, [0.4, 0.1, 0.03], err_msg="until the simulation reports the new one")


async def test_objects_cannot_be_dragged_without_editing(panda: Stage, moved: Moved) -> None:
    panda.show("truth", True)
    panda.say(topics.SCENE_OBJECTS, balls(ball_1=(0.4, 0.1)))
    node = panda.layer("truth").node("ball_1")
    await drag(node, (0.4, 0.1), (0.5, 0.2))
    panda.edit(True)
    panda.edit(False)
    await drag(node, (0.4, 0.1), (0.5, 0.2))
    assert moved == [] and is_shown(panda.server, node)


async def test_grasped_falling_and_removed_objects_cannot_be_dragged(panda: Stage, moved: Moved) -> None:
    panda.edit(True)
    for state, count in (("held", 0), ("falling", 0), ("contained", 1)):
        panda.say(topics.SCENE_OBJECTS, balls(state, ball_1=(0.4, 0.1)))
        await drag(panda.layer("truth").node("ball_1"), (0.4, 0.1), (0.5, 0.2))
        assert len(moved) == count
    (entry,), position = list(panda.layer("truth").node("ball_1")._impl.drag_cb), (0.4, 0.1, 0.03)
    await entry.callback(event("start", position, position))
    panda.say(topics.SCENE_OBJECTS, balls())
    for phase in ("update", "end"):
        await entry.callback(event(phase, position, position))
    assert len(moved) == 1


def test_ray_meets_the_plane_below_but_not_above_the_horizon() -> None:
    assert intersect_horizontal((0, 0, 2), (1, 1, 1), 0.0) == pytest.approx((2, 2))
    assert intersect_horizontal((0, 0, 2), (1, 1, 3), 0.0) is None
    assert intersect_horizontal((0, 0, 2), (1, 1, 2), 0.0) is None
