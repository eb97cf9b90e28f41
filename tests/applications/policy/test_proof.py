"""The proof of chunks: what is executed of them, and why no more."""

import re
from functools import cache

import numpy as np
import pytest

from applications.policy.interface import MotionState, ProvedMotion
from applications.policy.proof import MAX_ROWS, ChunkProver, ProofOptions
from common.control.goals import Assessment
from common.control.trajectory import Tolerances, checked_trajectory
from common.messages import AttachedObject, Box, PlanningScene, Pose, Vector3
from common.planning.point_obstacles import PointObstacle
from common.planning.robot_geometry import RobotGeometry
from common.planning.trajectory import TimedPath, trajectory_message
from tests.applications.policy.hostile import WORLD, at_rest, attack, crowded, limits_of, solid
from tests.applications.policy.judge import STEP, Judge, braked_by_joints, positions_at, shares, state_at
from tests.applications.policy.panda import READY, panda

LIMITS = limits_of(panda())
GEOMETRY = RobotGeometry(panda())
EMPTY = PlanningScene(header=WORLD, objects=[])
WALL = solid("wall", "box", [0.02, 0.6, 0.6], np.array([0.6, 0.0, 0.5]))
TIMES = np.arange(1, 31) / 20


@cache
def loaded() -> ChunkProver:
    return ChunkProver(panda(), LIMITS)


def prover(scene=EMPTY, points=(), **options) -> ChunkProver:
    """The prover with a scene and options; it takes 0.3 s to load."""
    loaded().set_options(ProofOptions(**options))
    loaded().set_scene(EMPTY, READY)
    loaded().set_scene(scene, READY, points)
    return loaded()


def moving_tool(*velocity: float, ramp: float = 0.5) -> np.ndarray:
    """Rows that move the tool of READY straight at a velocity [m/s]."""
    robot, q, rows = panda(), READY.copy(), []
    for time in TIMES.tolist():
        J = robot.jacobian(q)
        step = np.array([*velocity, 0, 0, 0]) / 20 * min(time / ramp, 1.0) ** 2
        q = q + np.linalg.pinv(J) @ step
        rows.append(q)
    return np.array(rows)


def swing(joint: int, angle: float, seconds: float = 1.0, start: float = 0.0) -> np.ndarray:
    rows, u = np.tile(READY, (30, 1)), np.clip((TIMES - start) / seconds, 0.0, 1.0)
    rows[:, joint] += angle * (10 * u**3 - 15 * u**4 + 6 * u**5)
    return rows


def require_executable(motion: ProvedMotion, state: MotionState) -> None:
    """Check what holds for every motion that is proved, sampled at 1 ms."""
    assert np.array_equal(motion.positions[0], state.positions)
    assert np.array_equal(motion.velocities[0], state.velocities)
    assert np.array_equal(motion.accelerations[0], state.accelerations)
    assert (np.diff(motion.times) > 0).all()
    assert not motion.velocities[-1].any()
    assert not motion.accelerations[-1].any()
    path = positions_at(motion, np.arange(0.0, motion.times[-1], STEP))
    assert max(shares(path, LIMITS).values()) <= 1 + 1e-4


def tool_of(motion: ProvedMotion) -> np.ndarray:
    path = positions_at(motion, np.arange(0.0, motion.times[-1], 5 * STEP))
    return np.array([panda().fk(q)[:3, 3] for q in path])


@pytest.mark.parametrize("choice", ["shorten", "slow", "refuse"])
def test_smooth_chunk_is_followed_to_its_end_and_then_brakes(choice: str) -> None:
    rows = swing(0, 0.5, 2.0)
    motion = prover(on_violation=choice).prove(at_rest(), rows, TIMES)
    assert motion.violation is None
    assert (motion.rows, motion.slowed) == (30, 1.0)
    assert motion.moving == pytest.approx(1.5)
    assert motion.times[-1] > motion.moving
    assert np.abs(positions_at(motion, TIMES) - rows).max() < 2e-3
    require_executable(motion, at_rest())


def test_executor_follows_a_proved_motion_at_its_full_speed() -> None:
    motion = prover().prove(at_rest(), swing(0, 1.2), TIMES)
    path = TimedPath(motion.times, motion.positions, motion.velocities, motion.accelerations)
    checked = checked_trajectory(trajectory_message(panda(), path), LIMITS, READY, Tolerances())
    assert checked.quintic
    assert Assessment.of(checked, READY, LIMITS, 0.01).share == 1.0


@pytest.mark.parametrize(("rows", "times", "cause", "message"), [
    (None, TIMES, "shape", "no array of real numbers"),
    (np.zeros((30, 7), dtype=complex), TIMES, "shape", "no array of real numbers"),
    ("left", TIMES, "shape", "no array of real numbers"),
    ([[1.0], [1.0, 2.0]], TIMES, "shape", "no array of real numbers"),
    (np.zeros((30, 6)), TIMES, "shape", r"has shape \(30, 6\)"),
    (np.zeros((30, 7)), TIMES[:29], "shape", r"\(29,\) times"),
    (np.zeros((0, 7)), np.zeros(0), "shape", r"has shape \(0, 7\)"),
    (np.zeros(7), TIMES, "shape", r"has shape \(7,\)"),
    (np.zeros((MAX_ROWS + 1, 7)), np.arange(1, MAX_ROWS + 2) / 20, "shape", "shape"),
    (np.tile(READY, (30, 1)), -TIMES, "shape", "do not increase"),
    (np.tile(READY, (30, 1)), 1e300 * TIMES, "shape", "do not increase"),
    (np.tile(READY, (30, 1)), np.full(30, np.nan), "not_finite", "a time"),
    (np.full((30, 7), np.nan), TIMES, "not_finite", "row 0: panda_joint1 is nan"),
    (np.full((30, 7), -np.inf), TIMES, "not_finite", "row 0: panda_joint1 is -inf"),
    (np.full((30, 7), 1e300), TIMES, "position", "panda_joint1 at 1e\\+300 rad"),
    (np.full((30, 7), 10**400), TIMES, "shape", "no array of real numbers"),
    (READY + 0.5 * np.ones((30, 7)), TIMES, "jump", "0.500 rad away from panda_joint"),
])
def test_chunk_of_which_nothing_is_executed_is_answered_with_a_stop(rows, times, cause, message) -> None:
    for choice in ("shorten", "slow", "refuse"):
        motion = prover(on_violation=choice).prove(at_rest(), rows, times)
        assert motion.violation is not None
        assert motion.violation.cause == cause
        assert re.search(message, motion.violation.message)
        assert (motion.rows, motion.moving) == (0, 0.0)
        require_executable(motion, at_rest())


def with_row(number: int, joint: int, value: float) -> np.ndarray:
    rows = swing(0, 0.5, 2.0)
    rows[number:, joint] = value
    return rows


FAST, ABRUPT = swing(0, 1.6), swing(1, 0.5, 0.4, 0.6)  # 3 rad/s at most, 18 rad/s^2


@pytest.mark.parametrize(("rows", "options", "cause", "what", "message"), [
    (with_row(20, 3, 1e300), {}, "position", "panda_joint4", "row 20: panda_joint4 at 1e"),
    (with_row(20, 3, -3.2), {}, "position", "panda_joint4", "row 20: panda_joint4 at -3.2 rad is not within"),
    (FAST, {}, "velocity", "panda_joint1", "panda_joint1 would exceed its velocity limit after 0"),
    (ABRUPT, {}, "acceleration", "panda_joint2", "panda_joint2 would exceed its acceleration limit"),
    (moving_tool(0.3, 0, 0), {"region": Box(pose=Pose(position=Vector3(x=0.3, z=0.5)), size=Vector3(x=0.5, y=1, z=1))},
     "region", "+x", r"leave its region at \+x after"),
    (moving_tool(0, 0, -0.3), {"region": Box(pose=Pose(position=Vector3(x=0.3, z=0.8)), size=Vector3(x=1, y=1, z=0.8))},
     "region", "-z", "leave its region at -z after"),
    (moving_tool(0.3, 0, 0), {"scene": PlanningScene(header=WORLD, objects=[WALL])},
     "collision", "wall", "panda_.* would touch wall after"),
    (moving_tool(0.3, 0, 0), {"points": [PointObstacle("camera", np.array([[0.55, 0.0, 0.58, 0.01]]))]},
     "collision", "camera", "panda_.* would touch camera after"),
    (moving_tool(0, 0, -0.3), {"scene": PlanningScene(
        header=WORLD, objects=[solid("table", "box", [0.4, 1.0, 0.1], np.array([0.45, 0.0, 0.15]))],
        attached=[AttachedObject(object=solid("stick", "cylinder", [0.01, 0.1], np.array([0, 0, 0.05])),
                                 link="panda_hand_tcp")])}, "collision", "stick", "stick would touch table"),
])
def test_chunk_is_shortened_to_the_part_that_is_proved_or_refused(rows, options, cause, what, message) -> None:
    motion = prover(**options).prove(at_rest(), rows, TIMES)
    found = motion.violation
    assert found is not None
    assert found.cause == cause
    assert what in found.what
    assert re.search(message, found.message)
    assert 0 < motion.rows < 30
    assert motion.moving <= found.time + 1e-9
    require_executable(motion, at_rest())
    refused = prover(on_violation="refuse", **options).prove(at_rest(), rows, TIMES)
    assert refused.violation is not None
    assert (refused.rows, refused.moving) == (0, 0.0)


def test_arm_does_not_come_so_close_that_it_could_not_stop() -> None:
    rows, scene = moving_tool(0.3, 0, 0), PlanningScene(header=WORLD, objects=[WALL])
    proving = prover(scene)
    end = proving.prove(at_rest(), rows, TIMES).rows + 1
    motion = proving.prove(at_rest(), rows[:end], TIMES[:end])  # ends before the wall, at speed
    assert motion.violation is not None
    assert motion.violation.cause == "stop"
    assert "could not stop any more" in motion.violation.message
    judge = Judge(panda(), GEOMETRY, scene)
    assert judge.contacts(positions_at(motion, np.arange(0, motion.times[-1], STEP))) == 0
    for time in np.linspace(0, motion.times[-1], 20):
        assert judge.contacts(braked_by_joints(LIMITS, state_at(motion, time))) == 0


@pytest.mark.parametrize(("rows", "cause"), [
    (FAST, "velocity"), (ABRUPT, "acceleration"), (swing(4, 0.5, 0.1), "velocity"),
    (np.tile(READY + 0.4, (30, 1)) * [1, 0, 0, 0, 0, 0, 0] + READY * [0, 1, 1, 1, 1, 1, 1], "jump"),
])
def test_chunk_that_is_too_fast_is_slowed_along_its_path(rows, cause) -> None:
    motion = prover(on_violation="slow").prove(at_rest(), rows, TIMES)
    assert motion.violation is not None
    assert motion.violation.cause == cause
    require_executable(motion, at_rest())
    if cause == "jump":
        assert motion.rows == 0
        return
    assert motion.rows == 30
    assert 1 < motion.slowed < 4
    path = positions_at(motion, np.arange(0.0, motion.times[-1], STEP))
    off = np.linalg.norm(path[:, None] - rows[None], axis=2).min(axis=0)
    assert off.max() < 0.02, "it passes each row"


def test_motion_joins_at_speed_without_a_jump() -> None:
    proving = prover()
    first = proving.prove(at_rest(), swing(0, 1.0), TIMES)
    state = state_at(first, 0.31)
    assert np.abs(state.velocities).max() > 0.5
    rest = TIMES[TIMES > 0.31]
    second = proving.prove(state, swing(0, 1.0)[TIMES > 0.31], rest - 0.31)
    assert second.violation is None
    require_executable(second, state)


def test_clearance_holds_and_attached_objects_may_leave_what_they_touch() -> None:
    low = panda().fk(READY)[2, 3]
    box = solid("box", "box", [0.04, 0.04, 0.1], np.array([0, 0, 0.04]))
    held = [AttachedObject(object=box, link="panda_hand_tcp")]
    table = solid("table", "box", [0.1, 0.1, 0.1], np.array([panda().fk(READY)[0, 3], 0.0, low - 0.09 - 0.05]))
    proving = prover(PlanningScene(header=WORLD, objects=[table], attached=held))
    lifted = proving.prove(at_rest(), moving_tool(0, 0, 0.1), TIMES)
    assert lifted.violation is None
    pressed = proving.prove(at_rest(), moving_tool(0, 0, -0.1), TIMES)
    assert pressed.violation is not None
    assert pressed.violation.what == "box - table"
    assert tool_of(pressed)[:, 2].min() > low - 1e-3


def test_gripper_may_touch_perceived_objects_and_the_arm_may_not() -> None:
    target = solid("target", "sphere", [0.03], np.append(panda().fk(READY)[:2, 3], panda().fk(READY)[2, 3] - 0.1),
                   role="target")
    rows = moving_tool(0, 0, -0.1)
    assert prover(PlanningScene(header=WORLD, objects=[target])).prove(at_rest(), rows, TIMES).violation is None
    fixture = target.model_copy(update={"role": "fixture"})
    found = prover(PlanningScene(header=WORLD, objects=[fixture])).prove(at_rest(), rows, TIMES).violation
    assert found is not None
    assert found.cause == "collision"


def test_judge_finds_contact_of_a_motion_that_was_not_proved() -> None:
    scene = PlanningScene(header=WORLD, objects=[WALL])
    free = prover().prove(at_rest(), moving_tool(0.3, 0, 0), TIMES)
    assert Judge(panda(), GEOMETRY, scene).contacts(positions_at(free, np.arange(0, free.times[-1], STEP))) > 10


@pytest.mark.parametrize("seed", range(12))
def test_hostile_chunks_never_leave_limits_or_touch_anything(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = crowded(rng, 12)
    places = np.array([[o.pose.position.x, o.pose.position.y, o.pose.position.z] for o in scene.objects])
    judge = Judge(panda(), GEOMETRY, scene)
    assert judge.contacts(READY[None]) == 0
    proving, state, path = prover(scene, on_violation=str(rng.choice(["shorten", "slow"]))), at_rest(), []
    for _ in range(6):
        _, rows, times = attack(rng, state, places)
        motion = proving.prove(state, rows, times)
        if not len(motion.times):
            continue
        require_executable(motion, state)
        until = float(rng.uniform(0.0, motion.times[-1]))
        path.append(positions_at(motion, np.arange(0.0, until, 5 * STEP)))
        state = state_at(motion, until)
        path.append(braked_by_joints(LIMITS, state)[::5])
    assert judge.contacts(np.concatenate(path)) == 0
