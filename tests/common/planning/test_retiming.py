from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from common.control.trajectory import Trajectory
from common.planning.path import blended_path, dense_path, distinct, smoothed
from common.planning.planners.joint_move import straight_profile
from common.planning.retiming import limited_jerk, parametrise
from common.planning.trajectory import TimedPath, join, sample, stretch

V = np.array([2.175, 2.175, 2.61])
A = np.array([15.0, 7.5, 20.0])
BEND = dense_path(np.array([[0, 0, 0], [0.5, 0.2, 0], [1.0, 0, 0.3]]))
STRAIGHT = dense_path(np.array([[0, 0, 0], [1.0, 0, 0]]))

waypoints = st.integers(2, 8).flatmap(
    lambda n: arrays(np.float64, (n, 3), elements=st.floats(-2.5, 2.5).map(lambda x: round(x, 4)))
).filter(lambda w: len(distinct(w)) > 1).map(distinct)


def blended(points, blend):
    return blended_path(points, np.full(len(points), blend))


def timed(paths) -> TimedPath:
    return join([parametrise(path, V, A) for path in paths])


def hermite_peaks(trajectory: TimedPath) -> tuple[float, float]:
    """Largest velocity and acceleration of the cubics between the states, as shares of the limits."""
    t = np.linspace(0, trajectory.duration, 4000)
    q = sample(trajectory, t)
    h = np.diff(trajectory.times)[:, None]
    ahead = np.diff(trajectory.positions, axis=0) / h
    v0, v1 = trajectory.velocities[:-1], trajectory.velocities[1:]
    ends = np.abs([(6 * ahead - 4 * v0 - 2 * v1) / h, (-6 * ahead + 2 * v0 + 4 * v1) / h])
    speed = np.abs(np.diff(q, axis=0) / np.diff(t)[:, None])
    return float((speed / V).max()), float((ends / A).max())


def assert_sound(trajectory: TimedPath, first, last) -> None:
    assert (np.diff(trajectory.times) > 0).all() and trajectory.times[0] == 0
    assert np.allclose(trajectory.positions[0], first)
    assert np.allclose(trajectory.positions[-1], last, atol=1e-9)
    assert np.array_equal(trajectory.velocities[[0, -1]], np.zeros((2, 3)))
    assert (np.abs(trajectory.velocities) <= V * (1 + 1e-9)).all()
    assert (np.abs(trajectory.accelerations) <= A * (1 + 1e-6)).all()
    assert max(hermite_peaks(trajectory)) <= 1.02


def away_from(points, q) -> float:
    """Least distance of a state from the edges between points."""
    found = []
    for a, b in pairwise(points):
        share = np.clip((q - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        found.append(np.linalg.norm(q - a - share * (b - a)))
    return min(found)


@settings(max_examples=15, deadline=None)
@given(waypoints, st.floats(0, 0.5))
def test_blended_paths_are_timed_within_limits_and_cut_corners_by_less_than_half_their_length(points, blend):
    paths = blended(points, blend)
    trajectory = timed(paths)
    assert_sound(trajectory, points[0], points[-1])
    assert max(away_from(points, q) for path in paths for q in path.positions(0.05)) <= blend / 2 + 1e-9
    fine = np.concatenate([path.positions(0.002) for path in paths])
    states = sample(trajectory, np.linspace(0, trajectory.duration, 40))
    assert np.linalg.norm(states[:, None, :] - fine[None, :, :], axis=2).min(axis=1).max() < 0.004


@settings(max_examples=15, deadline=None)
@given(arrays(np.float64, (4, 3), elements=st.floats(-1, 1).map(lambda x: round(x, 3))), st.integers(2, 40))
def test_dense_paths_are_timed_within_limits_from_rest_to_rest(c, count):
    s = np.linspace(0, 1, count + 1)[:, None]
    points = distinct(c[0] + c[1] * s + 0.3 * c[2] * s**2 + 0.1 * c[3] * np.sin(4 * s))
    if len(points) > 1:
        assert_sound(parametrise(dense_path(points), V, A), points[0], points[-1])


def test_corner_without_a_blend_and_turning_back_with_one_are_stops():
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0.0]])
    trajectory = timed(blended(points, 0.0))
    corner = int(np.argmin(np.linalg.norm(trajectory.positions - points[1], axis=1)))
    assert np.allclose(trajectory.velocities[corner], 0)
    assert len(blended(np.array([[0, 0, 0], [1, 0, 0], [0.2, 0.01, 0.0]]), 0.2)) == 2


def test_straight_line_takes_the_time_of_the_trapezoidal_profile():
    best = 1 / V[0] + V[0] / A[0]  # 1 rad at 2.175 rad/s and 15 rad/s^2: ramps of v/a, the rest at v
    assert parametrise(STRAIGHT, V, A).duration == pytest.approx(best, rel=0.02)
    assert parametrise(STRAIGHT, V, A).duration >= best - 1e-9
    assert parametrise(STRAIGHT, 0.2 * V, 0.2 * A).duration > 2 * best


@settings(max_examples=20, deadline=None)
@given(st.floats(0.05, 1))
def test_stretched_trajectory_is_the_same_path_slower(scale):
    fast = parametrise(BEND, V, A)
    slow = stretch(fast, scale)
    assert slow.duration == pytest.approx(fast.duration / scale)
    assert np.array_equal(slow.positions, fast.positions)
    assert np.allclose(slow.velocities, fast.velocities * scale)
    assert np.allclose(slow.accelerations, fast.accelerations * scale**2)
    t = np.linspace(0, fast.duration, 50)
    assert np.allclose(sample(slow, t / scale), sample(fast, t), atol=1e-9)


@pytest.mark.parametrize("scale", [0.0, -1.0, 1.5, float("nan")])
def test_invalid_stretch_is_refused(scale):
    with pytest.raises(ValueError, match="scale"):
        stretch(parametrise(STRAIGHT, V, A), scale)


@settings(max_examples=15, deadline=None)
@given(waypoints, st.floats(0, 0.5), st.floats(10, 1000))
def test_limited_jerk_respects_all_limits_and_stays_on_the_path(points, blend, quickness):
    """Between the states by quintics, as in the executor, and by cubics, as in validation."""
    jerk, paths = quickness * A, blended(points, blend)
    given_, limited = timed(paths), limited_jerk(timed(paths), jerk)
    assert np.array_equal(limited.positions[[0, -1]], given_.positions[[0, -1]])
    assert not limited.velocities[[0, -1]].any() and not limited.accelerations[[0, -1]].any()
    assert max(hermite_peaks(limited)) <= 1.02
    longer = limited.duration - given_.duration
    assert 0 < longer <= len(paths) * 2.05 / quickness
    longer /= len(paths)  # each part starts and ends at rest
    quintic = Trajectory(limited.times, limited.positions, limited.velocities, limited.accelerations, quintic=True)
    step = max(1e-3, longer / 20)  # finer differences would suffer from rounding
    t = np.arange(-3, limited.duration / step + 3) * step
    q = quintic.positions_at(t)
    for order, limit in ((1, V), (2, A), (3, jerk)):
        assert (np.abs(np.diff(q, order, axis=0)) <= 1.03 * limit * step**order + 1e-12).all(), order
    assert np.abs(sample(limited, t) - q).max() <= 1e-5 * max(1.0, (longer / 0.02) ** 2)
    if len(paths) == 1:
        centred = sample(given_, t - longer / 2)
        assert (np.abs(q - centred) <= A * longer**2 / 8 + 1e-9).all()


def test_trajectory_within_its_jerk_limit_is_not_changed():
    profile = straight_profile(np.zeros(3), np.array([1.0, -0.3, 1e-7]), V, A, 100 * A)
    assert limited_jerk(profile, 100 * A) is profile
    assert limited_jerk(profile, 50 * A).duration > profile.duration


@settings(max_examples=20, deadline=None)
@given(st.integers(3, 200), st.floats(1e-5, 1e-3), st.integers(0, 1000))
def test_smoothed_points_stay_within_tolerances_and_ends_are_fixed(count, tolerance, seed):
    rng = np.random.default_rng(seed)
    points = np.cumsum(rng.uniform(-1e-3, 1e-3, (count, 3)) + np.array([1e-3, 0, 0]), axis=0)
    tolerances = tolerance * rng.uniform(0, 1, count)
    moved = smoothed(points, tolerances)
    assert (np.linalg.norm(moved - points, axis=1) <= tolerances + 1e-12).all()
    assert np.array_equal(moved[[0, -1]], points[[0, -1]])


def test_smoothing_does_not_change_straight_fixed_or_too_few_points():
    points = np.linspace([0, 0, 0], [0.1, 0.05, 0], 101)
    assert np.abs(smoothed(points, np.full(101, 1e-4)) - points).max() < 1e-9
    corner = np.array([[0, 0], [0.001, 0], [0.001, 0.001]], dtype=float)
    assert np.array_equal(smoothed(corner, np.zeros(3)), corner)
    assert np.array_equal(smoothed(corner[:2], np.ones(2)), corner[:2])
