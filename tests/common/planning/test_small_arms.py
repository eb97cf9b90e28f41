"""Arms of fewer than six joints: yaw and tilt that they cannot choose stay free, or the failure is explained."""

import math
from pathlib import Path

import numpy as np
import pytest

from common.config import Grasp, RobotConfig, check
from common.planning.goal_sampling import distance_outside
from common.planning.ik import explain_region_unreachable, pose_region, solve_region_ik, solve_tool_down_ik
from common.planning.pipeline import PlanningPipeline
from common.planning.problem import Region
from common.robot.model import RobotModel
from common.robot.transforms import tool_down
from common.scene.workspace import WorkspaceBounds, unreachable_reason
from tests.common.planning.checks import assert_refused, last
from tests.common.planning.requests import down, to
from tests.common.planning.scenes import CELL, only
from tests.small_arms import nodding, scara
from tools.robot_setup.proposal import draft
from tools.robot_setup.sampling import disabled_pairs, srdf

ANYWHERE = WorkspaceBounds(min_radius=0.1, max_radius=2.0)
HOMES = {"scara": [0.3, 0.8, -0.02, 0.0], "nodding": [0.0, 0.2, 1.4, 1.5]}
TEXTS = {"scara": scara, "nodding": nodding}
NO_YAW = "with 4 joints the arm cannot choose yaw there: nearest is "


@pytest.fixture(scope="module")
def arms(tmp_path_factory: pytest.TempPathFactory) -> dict[str, RobotModel]:
    folder: Path = tmp_path_factory.mktemp("arms")
    found = {}
    for name, text in TEXTS.items():
        (folder / f"{name}.urdf").write_text(text())
        values = draft(str(folder / f"{name}.urdf"), name).values
        robot = RobotModel.load(check(RobotConfig, values | {"named_poses": {"home": HOMES[name]}}, "robot"))
        (folder / f"{name}.srdf").write_text(srdf(robot, disabled_pairs(robot, samples=300)))
        with_pairs = robot.config.model_copy(update={"srdf": str(folder / f"{name}.srdf")})
        found[name] = RobotModel.load(with_pairs)
    return found


@pytest.fixture
def robot(arms) -> RobotModel:
    return arms["nodding"]


@pytest.mark.parametrize("name", TEXTS)
@pytest.mark.parametrize("bounds", [(0.0, math.pi), (0.3, math.pi), (0.3, 0.5), (0.0, 0.0)])
def test_region_about_a_reached_pose_is_reached_again(arms, name: str, bounds: tuple[float, float]) -> None:
    robot, rng = arms[name], np.random.default_rng(3)
    found = 0
    for _ in range(8):
        region = Region(robot.fk(rng.uniform(robot.lower, robot.upper)), np.zeros(3), *bounds)
        q = solve_region_ik(robot, region, robot.named("home"), rng=rng, restarts=30)
        if q is not None:
            found += 1
            assert distance_outside(region, robot.fk(q)) < 2e-4 and robot.within_limits(q)
    assert found >= 7


def test_tool_is_tilted_only_where_necessary(robot: RobotModel) -> None:
    home = robot.named("home")
    tilts = {}
    for x in (0.45, 0.68):
        q = solve_tool_down_ik(robot, (x, 0.0, 0.05), 0.0, home, tilt=0.35, restarts=5)
        assert q is not None
        tilts[x] = math.acos(-robot.fk(q)[2, 2])
    assert tilts[0.45] < 1e-3 and 0.05 < tilts[0.68] <= 0.35 + 1e-3
    assert solve_tool_down_ik(robot, (0.68, 0.0, 0.05), 0.0, home, restarts=5) is None


def test_unreachable_yaw_is_reported_with_the_nearest(robot: RobotModel) -> None:
    T, home = tool_down(0.3, 0.3, 0.1), robot.named("home")  # the gripper is turned with the arm by 45 degrees
    free = solve_region_ik(robot, pose_region(robot, T, 0.0), home, restarts=5)
    assert free is not None
    turned = T[:3, :3].T @ robot.fk(free)[:3, :3]
    off = abs(math.degrees(math.atan2(turned[1, 0], turned[0, 0])))
    reason = explain_region_unreachable(robot, Region(T, np.zeros(3), 0.0, 0.0), home)
    assert reason.startswith(NO_YAW)
    assert float(reason.removeprefix(NO_YAW).split()[0]) == pytest.approx(off, abs=5)

    request = to(down(0.4, 0.0, 0.1, 0.8), HOMES["nodding"], planner="rrt_connect")
    response = PlanningPipeline(robot, CELL.motion, CELL.pipeline).plan(request, only())
    assert_refused(response, "no_ik", NO_YAW)


def test_insufficient_tilt_is_reported_with_the_least_needed(robot: RobotModel) -> None:
    upright = Grasp(approach_clearance=0.04, lift_height=0.06, max_tilt=0.0)
    tilted = upright.model_copy(update={"max_tilt": 1.0})
    place = (0.70, 0.1, 0.03)
    reason = unreachable_reason(robot, place, upright, ANYWHERE)
    assert "with 4 joints the arm cannot choose tilt there: nearest is " in reason and "0 deg are allowed" in reason
    assert 3 < float(reason.partition("nearest is ")[2].split()[0]) < 57
    assert unreachable_reason(robot, place, tilted, ANYWHERE) == ""
    assert "the arm reaches" in unreachable_reason(robot, (1.5, 0.0, 0.03), tilted, ANYWHERE)


def test_default_tilt_depends_on_the_number_of_joints() -> None:
    assert [Grasp().tilt(joints) for joints in (4, 5, 6, 7)] == [0.35, 0.35, 0.0, 0.0]
    assert [Grasp(max_tilt=0.1).tilt(joints) for joints in (4, 6)] == [0.1, 0.1]


@pytest.mark.parametrize("name", TEXTS)
@pytest.mark.parametrize("straight", [False, True])
def test_planners_leave_yaw_and_tilt_of_small_arms_free(arms, name: str, straight: bool) -> None:
    robot = arms[name]
    start = solve_tool_down_ik(robot, (0.38, -0.2, 0.2), 0.0, robot.named("home"), restarts=5)
    assert start is not None
    goal = down(0.38, -0.2, 0.05, 1.0, tilt_tolerance=0.35, yaw_tolerance=math.pi)
    response = PlanningPipeline(robot, CELL.motion, CELL.pipeline).plan(to(goal, start, straight=straight), only())
    assert robot.fk(last(response))[:3, 3] == pytest.approx([0.38, -0.2, 0.05], abs=1e-3)
    if straight:
        places = np.array([robot.fk(point.positions)[:3, 3] for point in response.trajectory.points])
        assert np.abs(places[:, :2] - [0.38, -0.2]).max() < 2e-3
