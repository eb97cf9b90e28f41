from functools import cache

import numpy as np
import pytest

from common.messages import AttachedObject, CollisionObject, Pose
from common.planning.arms import way_back
from common.planning.arms.pair_world import ArmGeometry, PairWorld
from common.planning.arms.timed_pairs import ArmMotion, PairProof, Schedule
from common.planning.trajectory import TimedPath, sample
from lab.arm_distance import ArmDistance
from tests.two_arms import Array, reachable, robots

CLEARANCE, BAND = 0.02, 0.2


@cache
def arms() -> tuple[ArmGeometry, ArmGeometry]:
    left, right = (ArmGeometry(name, robot) for name, robot in robots().items())
    return left, right


def proof(one: TimedPath, other: TimedPath, carried: list[AttachedObject] | None = None) -> PairProof:
    left, right = arms()
    return PairProof(PairWorld(left.body(carried or []), right.body()), ArmMotion(one), ArmMotion(other), CLEARANCE)


def stretched(path: TimedPath, seconds: float) -> TimedPath:
    scale = seconds / path.duration
    return TimedPath(path.times * scale, path.positions, path.velocities / scale, path.accelerations / scale**2)


def crossing(seed: int) -> tuple[TimedPath, TimedPath]:
    """Motions of both arms between two random places of the middle, and home."""
    rng, found = np.random.default_rng(seed), []
    for geometry in arms():
        poses = reachable(geometry.robot, 2, int(rng.integers(1000)))
        start = geometry.home if rng.random() < 0.7 else poses[1]
        limits = _limits(geometry)
        found.append(stretched(way_back.straight(start, poses[0], limits), rng.uniform(1.0, 4.0)))
    return found[0], found[1]


def _limits(geometry: ArmGeometry):  # noqa: ANN202
    from common.planning.arms.arm import Arm

    return Arm(geometry).limits


def nearest(one: TimedPath, other: TimedPath, delay: float, steps: int = 60) -> float:
    """Return the least distance of the arms at sampled pairs of times that the proof covers."""
    judge = ArmDistance(arms()[0].robot, arms()[1].robot)
    end = max(one.duration, other.duration + delay)
    times = np.linspace(0.0, end, steps)
    least = np.inf
    for off in (-BAND, 0.0, BAND):
        q, p = sample(one, times), sample(other, times - delay + off)
        least = min(least, *(judge.least(a, b) for a, b in zip(q, p, strict=True)))
    return float(least)


def test_motions_that_are_proved_keep_the_clearance_at_all_times_of_the_band() -> None:
    outcomes = {True: 0, False: 0}
    for seed in range(12):
        one, other = crossing(seed)
        clash = proof(one, other).in_time(Schedule(0.0), Schedule(0.3), BAND)
        outcomes[clash is None] += 1
        if clash is None:
            assert nearest(one, other, 0.3) >= CLEARANCE
    assert min(outcomes.values()) >= 2, outcomes


def test_a_certain_clash_is_closer_than_the_clearance_where_it_says() -> None:
    judge, found = ArmDistance(arms()[0].robot, arms()[1].robot), 0
    for seed in range(12):
        one, other = crossing(seed)
        clash = proof(one, other).in_time(Schedule(0.0), Schedule(0.0), BAND)
        if clash is not None and clash.certain:
            found += 1
            assert judge.least(sample(one, [clash.one])[0], sample(other, [clash.other])[0]) < CLEARANCE + 1e-6
            assert abs(clash.one - clash.other) <= BAND or clash.one >= one.duration or clash.other >= other.duration
    assert found >= 2


def test_an_arm_that_leaves_in_time_is_followed_and_one_that_leaves_late_is_not() -> None:
    left, right = arms()
    middle = [reachable(geometry.robot, 1, 3)[0] for geometry in (left, right)]
    away = stretched(way_back.straight(middle[0], left.home, _limits(left)), 2.0)
    there = stretched(way_back.straight(right.home, middle[1], _limits(right)), 2.0)
    pair = proof(away, there)
    assert pair.in_time(Schedule(5.0), Schedule(0.0), BAND) is not None
    assert pair.in_time(Schedule(0.0), Schedule(2.5), BAND) is None
    free = [delay for delay in np.arange(0.0, 2.0, 0.1) if pair.in_time(Schedule(0.0), Schedule(delay), BAND) is None]
    assert free, "it may start before the other one has come to rest"
    assert pair.in_time(Schedule(0.0), Schedule(free[0]), 1.5) is not None, "but not with a wide band"


def test_a_slower_rate_is_part_of_the_schedule() -> None:
    left, right = arms()
    middle = [reachable(geometry.robot, 1, 3)[0] for geometry in (left, right)]
    away = stretched(way_back.straight(middle[0], left.home, _limits(left)), 2.0)
    there = stretched(way_back.straight(right.home, middle[1], _limits(right)), 2.0)
    pair = proof(away, there)
    assert pair.in_time(Schedule(0.0, 1.0), Schedule(2.0), BAND) is None
    assert pair.in_time(Schedule(0.0, 0.2), Schedule(2.0), BAND) is not None


def test_what_an_arm_carries_counts() -> None:
    left, right = arms()
    one = reachable(left.robot, 1, 5)[0]
    near: Array | None = None
    for seed in range(40):
        other = reachable(right.robot, 1, seed)[0]
        distance = ArmDistance(left.robot, right.robot).least(one, other)
        if 0.05 < distance < 0.09:
            near = other
            break
    assert near is not None
    still = [way_back.straight(q, q, _limits(left)) for q in (one, near)]
    box = AttachedObject(link=left.robot.config.tcp_link, object=CollisionObject(
        id="box", role="attached", shape="sphere", dimensions=[0.25], pose=Pose()))
    assert proof(*still).anywhere((0.0, 1.0), (0.0, 1.0)) is None
    clash = proof(*still, [box]).anywhere((0.0, 1.0), (0.0, 1.0))
    assert clash is not None
    assert clash.pair[0] == "box"


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_reach_bounds_how_far_the_joints_get(share: float) -> None:
    path, _ = crossing(1)
    motion = ArmMotion(path)
    begin, end = share * path.duration - 0.1, share * path.duration + 0.15
    middle = (begin + end) / 2
    q = sample(path, np.linspace(begin, end, 200))
    assert (np.abs(q - motion.at(middle)).max(axis=0) <= motion.reach(begin, middle, end) + 1e-9).all()
    assert (motion.reach(begin, middle, end) <= 1.2 * np.abs(q - motion.at(middle)).max(axis=0) + 0.02).all()
