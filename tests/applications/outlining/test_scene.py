from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from applications.outlining.solids import PerceivedSolid, collision_object, planning_scene
from common.config import Surroundings, load_cell
from common.messages import Color, PlanningScene
from common.perception.camera_input import FrameError
from common.robot.home import HomeMonitor
from common.transport.codec import decode, encode

CELL = load_cell("ur5")
HOME = CELL.robot.named_poses["home"]
AWAY = [HOME[0] + 0.5, *HOME[1:]]


def solid(label: str = "Object_1") -> PerceivedSolid:
    outline = np.array([(0.45, -0.05), (0.55, -0.05), (0.55, 0.15), (0.45, 0.05)])
    return PerceivedSolid(0, label, outline, 1.0, 0.1, Color(r=1, g=1, b=0), False)


def test_solid_is_at_its_detected_position() -> None:
    thing = collision_object(solid())
    at = thing.pose.position
    assert (thing.id, thing.role, thing.shape, thing.dimensions) == ("Object_1", "target", "prism", [0.1])
    assert math.isclose(at.z, 1.05)
    placed = np.array(thing.outline) + np.array([at.x, at.y])
    assert np.allclose(placed, solid().outline)


def test_scene_has_fixtures_and_solids_but_no_container() -> None:
    around = CELL.section(Surroundings)
    assert isinstance(around, Surroundings)
    scene = planning_scene(around, [solid("Object_1"), solid("Object_2")], 7)
    assert [o.id for o in scene.objects] == ["robot_base", "target_base", "Object_1", "Object_2"]
    assert (scene.header.stamp, scene.header.frame_id) == (7, "world")


def test_scene_at_its_limit_is_valid_and_beyond_rejected() -> None:
    around = CELL.section(Surroundings)
    assert isinstance(around, Surroundings)
    turn = np.linspace(0, 2 * math.pi, 12, endpoint=False)
    round_one = replace(solid(), outline=0.1 * np.stack([np.cos(turn), np.sin(turn)], axis=1))
    full = [replace(round_one, label=f"Object_{index}") for index in range(400)]
    assert len(decode(PlanningScene, encode(planning_scene(around, full, 7))).objects) == 402
    long = replace(solid(), outline=np.resize(round_one.outline, (2001, 2)))
    for crowd in ([*full, solid()], [*full[1:], replace(long, outline=long.outline[:300])], [long]):
        with pytest.raises(FrameError, match="are more than a planning scene has room for"):
            planning_scene(around, crowd, 7)


def test_arm_first_seen_at_home_covers_earlier_times() -> None:
    watch = HomeMonitor(HOME)
    assert not watch.was_home(5)
    watch.add(HOME, 10)
    assert watch.was_home(5) and watch.was_home(20)


def test_images_count_from_return_home_until_departure() -> None:
    watch = HomeMonitor(HOME)
    watch.add(HOME, 10)
    watch.add(AWAY, 20)
    watch.add(AWAY, 30)
    assert watch.was_home(15) and not watch.was_home(20) and not watch.was_home(35)
    watch.add(HOME, 40)
    assert not watch.was_home(15) and not watch.was_home(39)
    assert watch.was_home(40) and watch.was_home(100)


def test_return_home_in_the_future_counts_until_the_next_joint_state() -> None:
    watch = HomeMonitor(HOME)
    for q, stamp in ((AWAY, 10), (HOME, 2**63 - 1), (HOME, 40)):
        watch.add(q, stamp)
    assert not watch.was_home(39) and watch.was_home(40) and watch.was_home(100)


def test_arm_first_seen_elsewhere_must_come_home() -> None:
    watch = HomeMonitor(HOME)
    watch.add(AWAY, 10)
    assert not watch.was_home(5) and not watch.was_home(15)
    watch.add(HOME, 20)
    assert watch.was_home(25) and not watch.was_home(5)
