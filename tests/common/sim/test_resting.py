"""Where released objects come to rest in the kinematic world."""

import math

import numpy as np
import pytest

from common.robot.transforms import matrix_to_rpy, tool_down
from tests.common.sim.rig import BOX, CUBE, OPEN, SHAPES, R, Rig


def test_initial_balls_rest_on_the_table_with_ids_in_order() -> None:
    rig = Rig.with_balls((0.5, 0.0), (0.6, 0.1))
    assert list(rig.balls()) == ["ball_1", "ball_2"]
    assert rig.ball(2)[0] == "table" and np.allclose(rig.ball(2)[1], [0.6, 0.1, R])
    version = rig.world.version
    rig.settle()
    assert rig.world.version == version
    assert Rig.with_balls(BOX).ball()[0] == "box", "an initial ball may lie in the container"


def test_released_ball_falls_under_gravity_to_the_point_below() -> None:
    rig = Rig.holding_ball()
    rig.release(0.3, -0.1, 0.5)
    rig.tick()
    assert rig.ball()[0] == "falling"
    start, height = rig.now, rig.ball()[1][2]
    while rig.ball()[0] == "falling":
        rig.tick()
    assert rig.now - start <= math.sqrt(2 * (height - R) / 9.81) + 0.011
    assert rig.ball()[0] == "table" and np.allclose(rig.ball()[1], [0.3, -0.1, R])


def test_long_tick_lands_the_ball() -> None:
    rig = Rig.holding_ball()
    rig.release(0.3, 0.0)
    rig.now += 100
    rig.tick()
    assert rig.ball()[0] == "table"


# --- balls ---


def test_eight_balls_fill_the_container_and_the_ninth_lies_outside() -> None:
    spots = [(0.3 + 0.07 * i, -0.3 + 0.07 * j) for i in range(3) for j in range(3)]
    rig = Rig.with_balls(*spots)
    for x, y in spots:
        assert rig.grasp(x, y)
        rig.put_down(*BOX)
    inside = [position for label, position in rig.balls().values() if label == "box"]
    assert len(inside) == 8 and len({tuple(np.round(p, 6)) for p in inside}) == 8
    assert sorted(round(float(p[2]), 3) for p in inside) == [0.035] * 4 + [0.095] * 4
    label, ninth = rig.ball(9)
    assert label == "table" and max(abs(ninth[0] - 0.55), abs(ninth[1] - 0.25)) >= 0.08 + R - 1e-9

    rig.events()
    low, high = next((a, b) for a, (_, p) in rig.balls().items() for b, (_, q) in rig.balls().items()
                     if q[2] > 0.09 and np.allclose(q - p, [0, 0, 0.06]))
    rig.edit("remove", low)
    rig.settle()
    assert rig.balls()[high][1][2] == pytest.approx(0.035)
    assert rig.events() == [f"remove:{low}", f"remove:{high}", f"add:{high}"]


@pytest.mark.parametrize(("spot", "expected"), [
    ((0.55 + 0.02, 0.25 - 0.02), (0.55 + 0.033, 0.25 - 0.033, 0.005 + R)),  # the nearest slot of the container
    ((0.5, 0.499), (0.5, 0.499, R)),  # at the edge of the table
])
def test_ball_lies_at_its_slot_or_spot(spot: tuple[float, float], expected: tuple[float, ...]) -> None:
    rig = Rig.holding_ball()
    rig.put_down(*spot)
    assert np.allclose(rig.ball()[1], expected)


def test_ball_released_above_another_rolls_to_the_nearest_free_position() -> None:
    rig = Rig.holding_ball((0.5, 0.0), (0.3, 0.0))
    rig.put_down(0.31, 0.0)
    label, position = rig.ball()
    assert label == "table" and 2 * R <= np.hypot(*(position[:2] - (0.3, 0.0))) < 2 * R + 0.005


def test_ball_released_at_a_container_wall_keeps_clear_of_it() -> None:
    rig = Rig.holding_ball()
    rig.put_down(0.55, 0.25 - 0.09)
    label, position = rig.ball()
    assert label == "table" and position[1] <= 0.25 - 0.08 - R + 1e-9


def test_object_released_beyond_the_table_edge_is_elsewhere() -> None:
    ball, cube = Rig.holding_ball(), Rig.holding_cube()
    ball.put_down(0.5, 0.501)
    assert ball.ball()[0] == "elsewhere" and ball.ball()[1][2] < -0.5
    assert ball.events()[-1] == "remove:ball_1"
    cube.put_down(1.1, 0.0)
    assert cube.object().state == "elsewhere" and cube.place()[2] < -0.5


# --- other shapes ---


@pytest.mark.parametrize("shape", SHAPES)
def test_released_object_lies_below_the_gripper(shape: str) -> None:
    rig = Rig(SHAPES[shape])
    rig.grasp(0.4, 0.0, 0.02)
    rig.events()
    rig.put_down(0.3, -0.2, yaw=0.5)
    obj, (x, y, z) = rig.object(), rig.place()
    assert obj.state == "table" and rig.events() == ["add:object_1"]
    assert math.hypot(x - 0.3, y + 0.2) < 0.03 and z == pytest.approx(obj.size.z / 2)
    rig.grasp(x, y, 0.02, 0.5)
    rig.put_down(0.6, -0.3)
    obj, (x, y, z) = rig.object(), rig.place()
    assert (obj.state, obj.container) == ("contained", "right")
    assert max(abs(x - 0.6), abs(y + 0.3)) < 0.08 - 0.008 and z == pytest.approx(0.005 + obj.size.z / 2)


def test_stacked_cube_falls_when_its_support_is_removed() -> None:
    rig = Rig.holding_cube({**CUBE, "x": 0.3})
    rig.put_down(0.303, 0.0)
    assert rig.place()[2] == pytest.approx(0.06) and rig.object().state == "table"
    rig.edit("remove", "object_2")
    rig.settle()
    assert rig.place()[2] == pytest.approx(0.02) and rig.object().state == "table"


def test_cube_with_unsupported_center_lies_next_to_the_other() -> None:
    rig = Rig.holding_cube({**CUBE, "x": 0.3})
    rig.put_down(0.325, 0.0)
    x, y, z = rig.place()
    assert z == pytest.approx(0.02) and math.hypot(x - 0.3, y) >= 0.04 - 1e-6


def test_tilted_cube_settles_on_its_nearest_side() -> None:
    rig = Rig.holding_cube()
    tilted = tool_down(0.3, 0.1, 0.3)
    tilted[:3, :3] = tilted[:3, :3] @ np.array([[1, 0, 0], [0, math.cos(0.2), -math.sin(0.2)],
                                               [0, math.sin(0.2), math.cos(0.2)]])
    rig.tick(tilted, 0.0)
    assert abs(matrix_to_rpy(rig.pose()[:3, :3])[0]) == pytest.approx(0.2, abs=1e-6)
    rig.tick(width=OPEN)
    rig.settle()
    roll, pitch, _ = matrix_to_rpy(rig.pose()[:3, :3])
    assert (roll, pitch) == pytest.approx((0.0, 0.0), abs=1e-9) and rig.place()[2] == pytest.approx(0.02)


def test_object_without_room_in_a_container_lies_on_top() -> None:
    large = {"shape": "box", "size": [0.12, 0.06], "height": 0.05}
    rig = Rig({**large, "x": 0.6, "y": 0.3}, {**large, "x": 0.3})
    rig.edit("move", "object_1", (0.6, 0.3))
    rig.grasp(0.3, 0.0, 0.02)
    rig.put_down(0.6, 0.3, z=0.3)
    contained = rig.objects().values()
    assert [obj.container for obj in contained] == ["left", "left"]
    assert sorted(round(obj.pose.position.z, 3) for obj in contained) == [0.03, 0.08]


def test_sphere_and_cube_in_one_container_do_not_overlap() -> None:
    rig = Rig({"shape": "sphere", "radius": 0.03}, {**CUBE, "x": 0.6, "y": 0.3})
    assert rig.object("object_2").container == "left"
    rig.grasp(0.4, 0.0, 0.03)
    rig.put_down(0.61, 0.31)
    ball, cube = rig.place("object_1"), rig.place("object_2")
    assert rig.object().container == "left"
    on_top = ball[2] >= cube[2] + 0.02 + 0.03 - 1e-6
    off = np.maximum(np.abs(ball[:2] - cube[:2]) - 0.02, 0.0)
    assert on_top or float(np.hypot(*off)) >= 0.03 - 1e-6
