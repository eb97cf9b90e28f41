"""The ghost at the end of the plan, and the path of the tool."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from common import messages as m
from common import topics
from tests.page.scene_cell import Stage, in_world


def plan(stage: Stage, q: NDArray[np.float64], seconds: float = 2.0, count: int = 40) -> m.JointTrajectory:
    start = stage.robot.named("home")
    zeros = [0.0] * len(q)
    return m.JointTrajectory(joint_names=stage.robot.joint_names, points=[
        m.JointTrajectoryPoint(
            time_from_start=float(s * seconds), positions=(start + s * (q - start)).tolist(), velocities=zeros,
            accelerations=zeros,
        ) for s in np.linspace(0, 1, count)
    ])


@pytest.fixture
def there(panda: Stage) -> NDArray[np.float64]:
    panda.joints(panda.robot.named("home"))
    return panda.robot.named("home") + np.array([0.5, 0.2, 0, 0.1, 0, 0.1, 0])


def tool_of_ghost(stage: Stage) -> NDArray[np.float64]:
    return in_world(stage.server, stage.layer("plan").ghost.links["panda_hand"])


def test_ghost_stands_where_the_plan_ends(panda: Stage, there: NDArray[np.float64]) -> None:
    assert not panda.layer("plan").ghost.visible
    panda.say(topics.DISPLAY_TRAJECTORY, plan(panda, there))
    assert panda.layer("plan").ghost.visible
    np.testing.assert_allclose(tool_of_ghost(panda), panda.robot.link_poses(there)["panda_hand"], atol=1e-6)


def test_meshes_of_the_ghost_are_sent_with_the_first_plan_and_once(
    panda: Stage, there: NDArray[np.float64], monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[str] = []
    add = panda.server.scene.add_mesh_simple
    monkeypatch.setattr(panda.server.scene, "add_mesh_simple",
                        lambda name, *args, **options: (sent.append(name), add(name, *args, **options))[1])
    panda.joints(there - 0.05)
    assert not [name for name in sent if name.startswith("/plan/")]
    for _ in range(2):
        panda.say(topics.DISPLAY_TRAJECTORY, plan(panda, there))
    links = {name.split("/")[-2] for name in sent}
    assert len(sent) == len(links) == len(panda.layer("plan").ghost.links)


def test_line_is_the_path_of_the_tool(panda: Stage, there: NDArray[np.float64]) -> None:
    trajectory = plan(panda, there)
    panda.say(topics.DISPLAY_TRAJECTORY, trajectory)
    line = panda.layer("tool_path").line
    assert line is not None
    wanted = [panda.robot.fk(point.positions)[:3, 3] for point in trajectory.points]
    np.testing.assert_allclose([line.points[0, 0], *line.points[:, 1]], wanted, atol=1e-5)


def test_ghost_goes_when_the_robot_has_come(panda: Stage, there: NDArray[np.float64]) -> None:
    panda.say(topics.DISPLAY_TRAJECTORY, plan(panda, there))
    panda.joints(there - 0.05)
    assert panda.layer("plan").ghost.visible
    panda.joints(there)
    assert not panda.layer("plan").ghost.visible


def test_links_of_the_ghost_that_lie_in_the_robot_are_not_drawn(panda: Stage, there: NDArray[np.float64]) -> None:
    panda.say(topics.DISPLAY_TRAJECTORY, plan(panda, there))
    panda.joints(panda.robot.named("home"))
    ghost = panda.layer("plan").ghost.links
    assert not ghost["panda_link0"].visible and ghost["panda_hand"].visible


def test_ghost_plays_the_plan_over_and_over(panda: Stage, there: NDArray[np.float64]) -> None:
    home = panda.robot.named("home")
    panda.view.play(plan(panda, there, seconds=2.0))
    panda.joints(home)
    for seconds, share in ((1.0, 0.5), (1.5, 1.0), (1.0, 0.25)):  # 3.5 s: it began again after 2 s and a rest of 1 s
        panda.clock.now += seconds
        panda.joints(home)
        wanted = panda.robot.link_poses(home + share * (there - home))["panda_hand"]
        np.testing.assert_allclose(tool_of_ghost(panda), wanted, atol=1e-3)


def test_ghost_stops_playing_when_the_robot_moves(panda: Stage, there: NDArray[np.float64]) -> None:
    home = panda.robot.named("home")
    panda.view.play(plan(panda, there))
    panda.joints(home)
    panda.clock.now += 0.5
    panda.joints(home + 0.02 * (there - home) / 0.5)
    assert not panda.layer("plan").playing
    np.testing.assert_allclose(tool_of_ghost(panda), panda.robot.link_poses(there)["panda_hand"], atol=1e-6)


def test_plan_that_is_played_is_not_begun_anew_when_the_planner_says_it(
    panda: Stage, there: NDArray[np.float64]
) -> None:
    found = plan(panda, there).model_copy(update={"header": m.Header(stamp=5)})
    panda.view.play(found)
    panda.say(topics.DISPLAY_TRAJECTORY, found)
    assert panda.layer("plan").playing
    panda.say(topics.DISPLAY_TRAJECTORY, found.model_copy(update={"header": m.Header(stamp=6)}))
    assert not panda.layer("plan").playing


def test_plan_without_points_clears_the_last(panda: Stage, there: NDArray[np.float64]) -> None:
    panda.say(topics.DISPLAY_TRAJECTORY, plan(panda, there))
    panda.say(topics.DISPLAY_TRAJECTORY, m.JointTrajectory(joint_names=panda.robot.joint_names, points=[]))
    assert not panda.layer("plan").ghost.visible and panda.layer("tool_path").line is None


def test_plan_of_other_joints_does_no_harm(panda: Stage, there: NDArray[np.float64]) -> None:
    odd = plan(panda, there).model_copy(update={"joint_names": [f"other_{i}" for i in range(7)]})
    panda.view.play(odd)
    panda.joints(there)


def test_two_plans_are_played_beside_each_other_until_the_robot_moves(
    panda: Stage, there: NDArray[np.float64]
) -> None:
    first, second = plan(panda, there), plan(panda, there - 0.3)
    first.header.stamp, second.header.stamp = 10, 20
    panda.view.compare(second)
    panda.view.play(first)
    panda.say(topics.DISPLAY_TRAJECTORY, second, 0.0)  # the planner tells of the newest
    other = panda.layer("compared")
    panda.joints(panda.robot.named("home"))
    panda.clock.now += 1.999999
    panda.joints(panda.robot.named("home") + 1e-5)
    np.testing.assert_allclose(tool_of_ghost(panda), panda.robot.link_poses(there)["panda_hand"], atol=1e-3)
    beside = in_world(panda.server, other.ghost.links["panda_hand"])
    np.testing.assert_allclose(beside, panda.robot.link_poses(there - 0.3)["panda_hand"], atol=1e-3)
    assert other.line.points.shape[1:] == (2, 3) and panda.layer("tool_path").line is not None
    np.testing.assert_allclose(panda.layer("tool_path").line.points[-1][1], panda.robot.fk(there)[:3, 3], atol=1e-4)
    panda.joints(panda.robot.named("home") + 0.05)
    assert not other.ghost.visible and other.line is None
