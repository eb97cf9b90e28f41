"""The planning scene of perceived solids, and the images that count for it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from applications.outlining.contours import ContourOptions, find_contours
from applications.outlining.solids import PerceivedSolid, collision_object, perceived_solids, planning_scene
from common.config import Surroundings, load_cell
from common.messages import Color, PlanningScene
from common.perception.camera_input import FrameError
from common.robot.home import HomeMonitor
from common.sim.objects import world_object
from common.transport.codec import decode, encode
from tests.applications.outlining.outline_scenes import distances, seen, seen_world, upright, world

CELL = load_cell("ur5")
AROUND = CELL.section(Surroundings)
HOME = CELL.robot.named_poses["home"]
AWAY = [HOME[0] + 0.5, *HOME[1:]]
OUTLINE = np.array([(0.45, -0.05), (0.55, -0.05), (0.55, 0.15), (0.45, 0.05)])


def solid(label="Object_1", outline=OUTLINE):
    return PerceivedSolid(0, label, outline, 1.0, 0.1, Color(r=1, g=1, b=0), False)


def solids_of(scene, channel="saturation"):
    camera, picture, depth = scene
    return perceived_solids(find_contours(picture, ContourOptions(channel=channel)), depth, camera)


def test_every_object_becomes_a_solid_with_position_and_height():
    solids, truth = solids_of(seen_world("w5")), [world_object(o) for o in world("w5").objects]
    assert len(solids) == len(truth)
    for thing in truth:
        middle = np.mean(thing.outline, axis=0)
        nearest = min(solids, key=lambda s: float(np.linalg.norm(s.outline.mean(axis=0) - middle)))
        assert distances(nearest.outline, thing.outline).max() < 1.3e-3 and len(nearest.outline) < 30
        assert (nearest.base, nearest.height) == pytest.approx((thing.base, thing.height), abs=1e-5)


def test_ring_is_one_solid_and_the_ground_none():
    assert [len(solids_of(seen_world("w6"), channel)) for channel in ("saturation", "maximum")] == [1, 1]


def test_object_at_the_border_is_a_solid_as_far_as_visible():
    (found,) = solids_of(seen([upright(shape="box", x=0.5, y=0.25, size=(0.06, 0.06), height=0.05)]))
    assert found.touches_border and found.outline[:, 1].max() < 0.27
    assert found.height == pytest.approx(0.05, abs=1e-5)


@pytest.mark.parametrize("none", [np.inf, np.finfo(np.float32).max, 1e9])
def test_invalid_depth_values_are_no_distances(none):
    camera, picture, depth = seen_world("w5")
    contours = find_contours(picture, ContourOptions())
    ground = depth > np.nanmax(depth) - 1e-3
    with_value, missing = (np.where(ground, np.float32(value), depth) for value in (none, np.nan))
    actual, expected = (planning_scene(Surroundings(), perceived_solids(contours, d, camera), 1)
                        for d in (with_value, missing))
    assert actual == expected and actual.objects


def test_scene_has_fixtures_and_solids_at_their_positions_but_no_container():
    thing = collision_object(solid())
    at = thing.pose.position
    assert (thing.id, thing.role, thing.shape, thing.dimensions) == ("Object_1", "target", "prism", [0.1])
    assert math.isclose(at.z, 1.05) and np.allclose(np.array(thing.outline) + np.array([at.x, at.y]), OUTLINE)
    scene = planning_scene(AROUND, [solid("Object_1"), solid("Object_2")], 7)
    assert [o.id for o in scene.objects] == ["robot_base", "target_base", "Object_1", "Object_2"]
    assert (scene.header.stamp, scene.header.frame_id) == (7, "world")


def test_scene_at_its_limit_is_valid_and_beyond_rejected():
    turn = np.linspace(0, 2 * math.pi, 12, endpoint=False)
    circle = 0.1 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    full = [solid(f"Object_{index}", circle) for index in range(400)]
    assert len(decode(PlanningScene, encode(planning_scene(AROUND, full, 7))).objects) == 402
    long = solid(outline=np.resize(circle, (2001, 2)))
    for crowd in ([*full, solid()], [*full[1:], replace(long, outline=long.outline[:300])], [long]):
        with pytest.raises(FrameError, match="are more than a planning scene has room for"):
            planning_scene(AROUND, crowd, 7)


@pytest.mark.parametrize(("readings", "at_home", "away"), [
    ([], [], [5]),
    ([(HOME, 10)], [5, 20], []),  # first seen at home: covers earlier times
    ([(HOME, 10), (AWAY, 20), (AWAY, 30)], [15], [20, 35]),
    ([(HOME, 10), (AWAY, 20), (AWAY, 30), (HOME, 40)], [40, 100], [15, 39]),
    ([(AWAY, 10), (HOME, 2**63 - 1), (HOME, 40)], [40, 100], [39]),  # a return in the future
    ([(AWAY, 10)], [], [5, 15]),
    ([(AWAY, 10), (HOME, 20)], [25], [5]),
])
def test_images_count_from_the_return_home_until_the_departure(readings, at_home, away):
    monitor = HomeMonitor(HOME)
    for q, stamp in readings:
        monitor.add(q, stamp)
    assert [stamp for stamp in (*at_home, *away) if monitor.was_home(stamp)] == at_home
