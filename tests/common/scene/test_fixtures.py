import itertools

import numpy as np
import pytest

from common.config import Surroundings
from common.perception.pinhole import Pinhole
from common.scene.fixtures import container_panels, occupied_slots, slot_positions

AROUND = Surroundings()
CAMERA = Pinhole.from_config(AROUND.camera)
SLOTS = slot_positions(AROUND.container, AROUND.ball_radius, 0.0).reshape(-1, 3)


def test_balls_in_all_slots_touch_neither_each_other_nor_the_walls() -> None:
    assert len(SLOTS) == 8
    for a, b in itertools.combinations(SLOTS, 2):
        assert np.linalg.norm(a - b) >= 2 * AROUND.ball_radius - 1e-9
    for panel in container_panels(AROUND.container, 0.0):
        center = np.array([panel.pose.position.x, panel.pose.position.y, panel.pose.position.z])
        outside = np.abs(SLOTS - center) - np.array(panel.dimensions) / 2
        assert np.all(np.linalg.norm(np.maximum(outside, 0), axis=1) >= AROUND.ball_radius - 1e-9)


@pytest.mark.parametrize("filled", range(9))
def test_occupied_slots_follow_from_the_pixels_of_the_top_balls(filled: int) -> None:
    taken = set(range(filled))
    visible = [k for k in taken if k + 4 not in taken]
    jitter = np.random.default_rng(filled).uniform(-5, 5, (len(visible), 2))
    pixels = [tuple(p) for p in CAMERA.project(SLOTS[visible]).reshape(-1, 2) + jitter]
    assert occupied_slots(pixels, CAMERA, SLOTS, AROUND.ball_radius) == (set(visible), taken - set(visible))


def test_free_slot_holds_no_occluded_ball_but_a_seen_one() -> None:
    low, high = (tuple(pixel) for pixel in CAMERA.project(SLOTS[[0, 4]]).reshape(-1, 2).tolist())
    assert occupied_slots([high], CAMERA, SLOTS, AROUND.ball_radius, free={0}) == ({4}, set())
    assert occupied_slots([low, high], CAMERA, SLOTS, AROUND.ball_radius, free={0}) == ({0, 4}, set())
