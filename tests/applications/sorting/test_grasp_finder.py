"""Grasps from an image: objects without a proved grasp have a reason, and a network may rank the candidates."""

import numpy as np
import pytest

from applications.sorting.grasp_finder import GraspFinder
from applications.sorting.learning.learned import NUMBERS
from applications.sorting.learning.network import Network
from common.config import Surroundings
from common.config.loading import load_robot
from common.errors import ConfigError
from tests.applications.sorting.scenes import BLUE, FLOOR, GREEN, RED, box, found_in, surface_with, tray_world

WORLD = Surroundings.model_validate({name: getattr(tray_world(), name) for name in Surroundings.model_fields})
MESHES = (box(0.53, 0.05, (0.04, 0.06, 0.05), RED, 0.3), box(0.60, -0.10, (0.12, 0.13, 0.06), BLUE),
          box(0.45, 0.40, (0.04, 0.04, 0.04), GREEN))


class LowestFirst(Network):
    """Prefers grasps near the floor."""

    def __init__(self) -> None:
        super().__init__(NUMBERS, None)

    def score(self, patches, numbers):
        """Return scores that fall with the height of the tool."""
        assert patches.shape == (len(numbers), 32, 32) and numbers.shape[1] == len(NUMBERS)
        return np.exp(-20 * numbers[:, NUMBERS.index("height")].astype(float))


def grasps(network=None):
    labels, objects = found_in(MESHES)
    finder = GraspFinder(WORLD, load_robot("panda"), "tray", network=network)
    return finder.find(surface_with(MESHES), labels, objects), {seen.color_name: seen.id for seen in objects}


def test_object_that_is_too_wide_has_a_reason_and_others_are_no_targets():
    found, ids = grasps()
    assert {grasp.object for grasp in found.grasps if grasp.proved} == {ids["red"]}
    reason, = found.left
    assert reason.object == ids["blue"] and reason.reason
    assert found.scorer == "geometric"


def test_network_ranks_the_candidates():
    found, _ = grasps(LowestFirst())
    proved = [grasp for grasp in found.grasps if grasp.proved]
    assert found.scorer == "learned" and proved
    for grasp in proved:
        assert grasp.score == pytest.approx(np.exp(-20 * (grasp.pose.position.z - FLOOR)), rel=1e-3)
        assert grasp.parts["learned"] == grasp.score


def test_missing_network_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.onnx"):
        Network.load(tmp_path / "none.onnx", NUMBERS)
