import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from common.config import load_cell
from common.planning.ik import solve_ik
from common.planning.kernel.library import library, without_kernel
from common.planning.kernel.solvers import KernelArm
from common.robot.model import RobotModel
from common.robot.transforms import tool_down

robot = RobotModel.load(load_cell("panda").robot)
HOME = robot.named("home")


ROBOTS = {"panda": robot, "ur5": RobotModel.load(load_cell("ur5").robot)}
kernel = pytest.mark.skipif(library() is None, reason="the planning kernel is not built here")


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


def away(model: pin.Model, frame: int, q, T) -> tuple[float, float]:
    """Distance of the frame from a pose by pinocchio: [m], [rad]."""
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    left = data.oMf[frame].actInv(pin.SE3(T))
    return float(np.linalg.norm(left.translation)), float(np.linalg.norm(pin.log3(left.rotation)))


def check(model: pin.Model, frame: int, q, T) -> None:
    assert q is not None
    position, rotation = away(model, frame, q, T)
    assert position < 1.001e-5 and rotation < 1.001e-4
    assert (q >= model.lowerPositionLimit).all() and (q <= model.upperPositionLimit).all()


@kernel
@pytest.mark.parametrize("name", ROBOTS)
@settings(max_examples=300, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_ik_solves_any_reachable_pose(name, seed):
    model, rng = ROBOTS[name], np.random.default_rng(seed)
    T = model.fk(rng.uniform(model.lower, model.upper))
    check(model.model, model.tcp_frame, solve_ik(model, T, rng.uniform(model.lower, model.upper), rng=rng), T)


@kernel
def test_ik_solves_any_reachable_pose_with_sliding_joints():
    model, frame = sliding_arm()
    arm, data, rng = KernelArm(model, frame, 1e-5, 1e-4), model.createData(), np.random.default_rng(0)
    for number in range(300):
        pin.framesForwardKinematics(model, data, rng.uniform(model.lowerPositionLimit, model.upperPositionLimit))
        T, seed = data.oMf[frame].homogeneous, rng.uniform(-3, 3, model.nq)
        q = arm.solve(T, seed, restarts=300, iterations=15, random=number)
        check(model, frame, q, T)
        assert q[4] == np.clip(seed[4], -1, 1.5)  # this joint does not move the tip


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**31))
def test_ik_without_the_kernel_solves_any_reachable_pose(no_kernel, seed):
    rng = np.random.default_rng(seed)
    T = robot.fk(rng.uniform(robot.lower, robot.upper))
    check(robot.model, robot.tcp_frame, solve_ik(robot, T, HOME, rng=rng), T)


@kernel
@pytest.mark.parametrize("name", ROBOTS)
def test_kernel_and_pinocchio_agree_from_a_close_seed(name):
    model, rng = ROBOTS[name], np.random.default_rng(3)
    ends = rng.uniform(model.lower, model.upper, (50, model.dof))
    seeds = ends + rng.uniform(-0.1, 0.1, ends.shape)
    poses = [model.fk(q) for q in ends]
    found = [solve_ik(model, T, seed) for T, seed in zip(poses, seeds, strict=True)]
    with without_kernel():
        others = [solve_ik(model, T, seed, restarts=0) for T, seed in zip(poses, seeds, strict=True)]
    apart = [np.abs(q - other).max() for q, other in zip(found, others, strict=True) if other is not None]
    assert len(apart) >= 45 and max(apart) < 0.02


@pytest.mark.parametrize("yaw", [-1.0, 0.0, 1.0])
def test_grasps_on_the_complete_table_are_solved_from_home(yaw):
    for x in (0.35, 0.5, 0.62):
        for y in (-0.3, 0.0, 0.3):
            assert solve_ik(robot, tool_down(x, y, 0.03, yaw), HOME, restarts=3) is not None


def test_pose_out_of_reach_has_no_solution():
    assert solve_ik(robot, tool_down(1.5, 0, 0.3), HOME, restarts=3) is None


@kernel
@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("place", [(1.5, 0, 0.3), (0, 0, 0.1), (1e6, 0, 0), (np.nan, 0, 0)])
def test_unreachable_pose_is_reported_in_bounded_time(name, place):
    began = time.process_time()
    assert solve_ik(ROBOTS[name], tool_down(*place), ROBOTS[name].named("home")) is None
    assert time.process_time() - began < 0.1


@kernel
def test_pose_and_seed_of_wrong_shape_are_refused():
    with pytest.raises(ValueError, match="shape"):
        solve_ik(robot, np.eye(4)[:3], HOME)
    with pytest.raises(ValueError, match="shape"):
        solve_ik(robot, robot.fk(HOME), HOME[:6])


def test_seed_beyond_the_limits_is_clipped():
    model = ROBOTS["ur5"]
    q = solve_ik(model, model.fk(model.upper), model.upper + 1.0, restarts=0)
    assert q is not None and np.abs(q - model.upper).max() < 1e-3


def test_neighbouring_poses_have_neighbouring_solutions():
    q = HOME
    for x in np.linspace(robot.fk(HOME)[0, 3], 0.5, 20):
        following = solve_ik(robot, tool_down(x, 0, 0.48), q, restarts=0)
        assert following is not None
        assert np.abs(following - q).max() < 0.2
        q = following


def test_same_call_gives_the_same_solution():
    T = tool_down(0.4, -0.4, 0.05, 0.7)
    far = np.clip(-HOME, robot.lower, robot.upper)
    assert np.array_equal(solve_ik(robot, T, far), solve_ik(robot, T, far))
    found = [solve_ik(robot, T, far, rng=np.random.default_rng(seed)) for seed in (1, 1)]
    assert np.array_equal(found[0], found[1])


@kernel
def test_threads_get_their_own_answers():
    rng = np.random.default_rng(5)
    poses = [robot.fk(q) for q in rng.uniform(robot.lower, robot.upper, (200, robot.dof))]

    def ask(T):
        return solve_ik(robot, T, HOME)

    alone = [ask(T) for T in poses]
    with ThreadPoolExecutor(4) as threads:
        assert np.array_equal(alone, list(threads.map(ask, poses)))
