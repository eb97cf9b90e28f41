import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from common.planning.ik import solve_ik
from common.planning.kernel.library import library
from common.planning.kernel.solvers import KernelArm
from common.robot.transforms import tool_down
from tests.common.planning.scenes import HOME, ROBOT, UR5

ROBOTS = {"panda": ROBOT, "ur5": UR5}
kernel = pytest.mark.skipif(library() is None, reason="the planning kernel is not built here")
each_robot = pytest.mark.parametrize("robot", [ROBOT, UR5], ids=ROBOTS)


def sliding_arm() -> tuple[pin.Model, int]:
    """A model with sliding first and fourth joints, skew axes, a frame at its end, and another branch."""
    rng, model, parent = np.random.default_rng(4), pin.Model(), 0
    for number in range(8):
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        kind = pin.JointModelPrismaticUnaligned(axis) if number in (0, 3) else pin.JointModelRevoluteUnaligned(axis)
        place = pin.SE3(pin.exp3(rng.normal(size=3)), rng.uniform(-0.3, 0.3, 3))
        low, high, most = np.full(1, -1.0), np.full(1, 1.5), np.full(1, 10.0)
        joint = model.addJoint(parent, kind, place, f"j{number}", most, most, low, high)
        parent = parent if number == 4 else joint
    tip = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3) * 0.1)
    return model, model.addFrame(pin.Frame("tip", parent, tip, pin.FrameType.OP_FRAME))


def check(model: pin.Model, frame: int, q, T) -> None:
    """A solution is within limits and reaches the pose, by pinocchio, within 10 um and 0.1 mrad."""
    assert q is not None
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    off = data.oMf[frame].actInv(pin.SE3(T))
    assert np.linalg.norm(off.translation) < 1.001e-5 and np.linalg.norm(pin.log3(off.rotation)) < 1.001e-4
    assert (q >= model.lowerPositionLimit).all() and (q <= model.upperPositionLimit).all()


@kernel
@each_robot
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_ik_solves_any_reachable_pose(robot, seed):
    rng = np.random.default_rng(seed)
    T = robot.fk(rng.uniform(robot.lower, robot.upper))
    check(robot.model, robot.tcp_frame, solve_ik(robot, T, rng.uniform(robot.lower, robot.upper), rng=rng), T)


@kernel
def test_ik_solves_any_reachable_pose_with_sliding_joints():
    model, frame = sliding_arm()
    arm, data, rng = KernelArm(model, frame, 1e-5, 1e-4), model.createData(), np.random.default_rng(0)
    for number in range(100):
        pin.framesForwardKinematics(model, data, rng.uniform(model.lowerPositionLimit, model.upperPositionLimit))
        T, seed = data.oMf[frame].homogeneous, rng.uniform(-3, 3, model.nq)
        q = arm.solve(T, seed, restarts=300, iterations=15, random=number)
        check(model, frame, q, T)
        assert q[4] == np.clip(seed[4], -1, 1.5)  # this joint does not move the tip


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**31))
def test_ik_without_the_kernel_solves_any_reachable_pose(no_kernel, seed):
    rng = np.random.default_rng(seed)
    T = ROBOT.fk(rng.uniform(ROBOT.lower, ROBOT.upper))
    check(ROBOT.model, ROBOT.tcp_frame, solve_ik(ROBOT, T, HOME, rng=rng), T)


@kernel
@each_robot
@pytest.mark.parametrize("place", [(1.5, 0, 0.3), (0, 0, 0.1), (1e6, 0, 0), (np.nan, 0, 0)])
def test_unreachable_pose_is_reported_in_bounded_time(robot, place):
    began = time.process_time()
    assert solve_ik(robot, tool_down(*place), robot.named("home")) is None
    assert time.process_time() - began < 0.1


@kernel
def test_pose_and_seed_of_wrong_shape_are_refused():
    for T, seed in ((np.eye(4)[:3], HOME), (ROBOT.fk(HOME), HOME[:6])):
        with pytest.raises(ValueError, match="shape"):
            solve_ik(ROBOT, T, seed)


def test_seed_beyond_the_limits_is_clipped():
    q = solve_ik(UR5, UR5.fk(UR5.upper), UR5.upper + 1.0, restarts=0)
    assert q is not None and np.abs(q - UR5.upper).max() < 1e-3


def test_neighbouring_poses_have_neighbouring_solutions():
    q = HOME
    for x in np.linspace(ROBOT.fk(HOME)[0, 3], 0.5, 20):
        following = solve_ik(ROBOT, tool_down(x, 0, 0.48), q, restarts=0)
        assert following is not None and np.abs(following - q).max() < 0.2
        q = following


@kernel
def test_threads_get_their_own_answers():
    rng = np.random.default_rng(5)
    poses = [ROBOT.fk(q) for q in rng.uniform(ROBOT.lower, ROBOT.upper, (100, ROBOT.dof))]
    alone = [solve_ik(ROBOT, T, HOME) for T in poses]
    with ThreadPoolExecutor(4) as threads:
        assert np.array_equal(alone, list(threads.map(lambda T: solve_ik(ROBOT, T, HOME), poses)))
