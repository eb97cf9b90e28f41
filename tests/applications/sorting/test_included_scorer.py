"""The included network: its card is that of its figures, it is small and fast, and it prefers obviously good grasps."""

import json
import time

import numpy as np

from applications.sorting.learning.card import as_text
from applications.sorting.learning.learned import NUMBERS
from applications.sorting.learning.network import MAX_BYTES, SHIPPED, Network
from applications.sorting.learning.patches import SIZE, patches_of
from applications.sorting.surface import Surface

FLOOR = 0.005
GOOD = {"engagement": 0.02, "off_center": 0.001, "alignment": 0.98, "other_alignment": 0.99, "slack": 0.006,
        "tilt": 0.0, "spare": 0.02, "width": 0.03, "tip_height": 0.01, "extent": 1.0, "roughness": 0.001, "purity": 1.0,
        "opening": 0.05, "height": 0.019}
BAD = GOOD | {"engagement": 0.003, "off_center": 0.03, "alignment": 0.75, "other_alignment": 0.8, "slack": 0.002,
              "width": 0.06, "opening": 0.068, "tip_height": 0.027, "roughness": 0.006, "purity": 0.9, "height": 0.036}


def block(height: float, half: tuple[float, float]) -> Surface:
    """A block in the middle of a floor, with half sides along x and y [m]."""
    top, color = np.full((150, 150), FLOOR, np.float32), np.zeros((150, 150, 3), np.uint8)
    made = Surface((0.40, -0.15), 0.002, top, color, FLOOR)
    x, y = made.xy(*np.indices((150, 150))).transpose(2, 0, 1)
    made.top[(np.abs(x - 0.55) < half[0]) & (np.abs(y) < half[1])] = FLOOR + height
    return made


def down(x: float, y: float, z: float) -> np.ndarray:
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = x, y, z
    return T


def test_card_shows_the_figures_of_the_file_next_to_it() -> None:
    card = json.loads(SHIPPED.with_suffix(".json").read_text(encoding="utf-8"))
    assert SHIPPED.with_suffix(".md").read_text(encoding="utf-8") == as_text(card)
    assert tuple(card["numbers"]) == NUMBERS and sum(card["tries"].values()) > 5000
    assert SHIPPED.stat().st_size < MAX_BYTES


def test_deep_central_grasp_ranks_above_a_shallow_one_at_the_end() -> None:
    network, surface = Network.load(), block(0.04, (0.04, 0.015))
    poses = np.stack([down(0.55, 0.0, FLOOR + GOOD["height"]), down(0.585, 0.0, FLOOR + BAD["height"])])
    numbers = np.array([[values[name] for name in NUMBERS] for values in (GOOD, BAD)], np.float32)
    good, bad = network.score(patches_of(surface, poses), numbers)
    assert 0 < bad < good < 1 and good > 0.85


def test_hundred_patches_take_less_than_a_tenth_of_a_second_and_order_does_not_matter() -> None:
    network, rng = Network.load(), np.random.default_rng(0)
    patches = rng.normal(size=(100, SIZE, SIZE)).astype(np.float32)
    numbers = np.tile(np.array([GOOD[name] for name in NUMBERS], np.float32), (100, 1))
    together = network.logits(patches, numbers)
    alone = [network.logits(patches[k:k + 1], numbers[k:k + 1])[0] for k in (0, 41, 99)]
    assert np.allclose(together[[0, 41, 99]], alone, atol=1e-5)
    start = time.process_time()
    for _ in range(5):
        network.logits(patches, numbers)
    assert (time.process_time() - start) / 5 < 0.1
