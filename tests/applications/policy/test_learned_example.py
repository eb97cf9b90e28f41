"""The learned and the scripted policy of examples/policy pick a ball in layouts that no demonstration has."""

from dataclasses import replace

import numpy as np
import pytest

from applications.policy.interface import Observation
from applications.policy.sources.card import read_card
from examples.policy import scripted
from examples.policy.evaluate import attempt, interval, load_policy
from examples.policy.simulated_pick import SimulatedPick
from tests.harness import ROOT

NETWORK = ROOT / "examples" / "policy" / "pick_ball.onnx"


@pytest.fixture(scope="module", name="learned")
def _learned():
    return load_policy(str(NETWORK))


@pytest.mark.parametrize("seed", [4, 18])
def test_learned_policy_picks_ball_of_unseen_layout_under_proof(learned, seed: int) -> None:
    result = attempt(learned, seed, "slow")
    assert result["success"], result
    assert result["contacts"] == result["limits_broken"] == 0


@pytest.mark.parametrize("color", [(0, 0, 0), (255, 255, 255), (140, 90, 30), (255, 0, 0)])
def test_learned_policy_returns_numbers_for_images_unlike_those_of_the_training(learned, color) -> None:
    image = np.full((96, 96, 3), color, np.uint8)
    chunk = learned(replace(SimulatedPick(0).observe(), images={"camera": image}))
    assert np.isfinite(chunk.values).all()
    assert np.isfinite(chunk.gripper).all()


def test_scripted_policy_picks_ball_under_proof() -> None:
    result = attempt(scripted.policy, 0, "slow")
    assert result["success"], result
    assert result["contacts"] == result["limits_broken"] == 0


def test_shipped_network_is_small_and_its_card_has_data_figures_and_limits() -> None:
    card = read_card(NETWORK)
    assert NETWORK.stat().st_size < 2e6
    assert {"episodes", "layouts", "seed", "evaluation", "limits"} <= card.training.keys()


@pytest.mark.parametrize("size", [(96, 96), (320, 240), (640, 480)])
def test_scripted_policy_finds_ball_in_images_of_any_size(size: tuple[int, int]) -> None:
    pick = SimulatedPick(0, size=size)
    found = scripted.find_ball(pick.observe().images["camera"])
    assert found == pytest.approx(pick.ball, abs=2e-3)


def test_scripted_policy_without_ball_in_view_stays_where_it_is() -> None:
    pick = SimulatedPick(0)
    seen = pick.observe()
    empty = Observation(seen.stamp, seen.positions, seen.velocities, seen.tcp, seen.gripper,
                        {"camera": np.full((96, 96, 3), 128, np.uint8)})
    chunk = scripted.policy(empty)
    assert chunk.values[:, :3] == pytest.approx(np.tile(seen.tcp[:3, 3], (20, 1)), abs=1e-6)
    assert (chunk.gripper > 0.07).all()


@pytest.mark.parametrize(("successes", "low", "high"), [(100, 0.963, 1.0), (95, 0.888, 0.978), (0, 0.0, 0.037)])
def test_interval_is_wilsons(successes: int, low: float, high: float) -> None:
    assert interval(successes, 100) == pytest.approx((low, high), abs=1e-3)
