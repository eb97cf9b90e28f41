"""Goals, plans and saved poses on the page."""

from __future__ import annotations

import asyncio

from common import messages as m
from common import topics
from tests.page.fake_browser import PATIENCE, FakeBrowser
from tests.services.fake_cell import trajectory
from tests.services.viewer.conftest import FakeServices, page_of, until

JOINTS = [f"panda_joint{k}" for k in range(1, 8)]


async def test_invalid_goal_is_shown_and_the_service_continues(panda: FakeServices, page: FakeBrowser) -> None:
    await page.set("Goal", "tool pose")
    await page.until(lambda: page.parts[page.label("Tool position [mm]")]["visible"])
    await page.set("Tool position [mm]", [1e11, 0.0, 400.0])
    await page.press("Plan")
    await page.until(lambda: "position.x" in page.status["note"]["text"])


async def test_failed_plan_to_the_marker_names_the_collision(panda, page, scenes):
    planned = panda.serve_planner(
        error="collision", message="operator: the goal collides", colliding=("panda_hand", "table"))
    await until(lambda: scenes)
    await page.press("Plan")
    await page.until(lambda: "Drag the goal marker" in page.text)
    await until(lambda: scenes[0].calls_of("show_goal_marker") == [(True,)])
    await page.set("Planner", "chomp")
    await page.press("Plan")
    await page.until(lambda: "the goal collides; panda_hand would collide with table" in page.text)
    request = await planned.get()
    assert (request.planner, request.goal) == ("chomp", m.PoseGoal(pose=scenes[0].goal_pose))


async def test_plan_is_discarded_when_the_goal_marker_is_moved(panda, page, scenes):
    panda.serve_planner(trajectory(JOINTS, 1.0))
    panda.put_motion()
    await until(lambda: scenes)
    await page.set("Show goal marker", True)
    await until(lambda: scenes[0].calls_of("show_goal_marker"))
    await page.press("Plan")
    await page.until(lambda: page.button("Execute")[1] == "")
    scenes[0].goal_pose = m.Pose(position=m.Vector3(x=0.5, z=0.5))
    await page.until(lambda: "press Plan first" in page.button("Execute")[1]
                     and "The goal marker was moved: press Plan again." in page.text)


async def test_plan_is_executed_once(panda: FakeServices, page: FakeBrowser) -> None:
    found = trajectory(["a"], 0.0, 1.0)
    panda.serve_planner(found, planner="ompl")
    executed = panda.serve_executor("succeeded")
    panda.put_task()
    panda.put_motion()
    await page.until(lambda: page.button("Execute")[1] == "press Plan first")
    await page.set("Goal", "home")
    await page.press("Plan")
    await page.press("Execute")
    request = await asyncio.wait_for(executed.get(), PATIENCE)
    assert request.trajectory == found and request.plan
    await page.until(lambda: page.button("Execute")[1] == "press Plan first")
    assert executed.empty()


async def test_two_plans_are_animated_and_compared_and_the_second_one_is_executed(panda, page, scenes):
    first, second = (trajectory(["panda_joint1"], 0.0, seconds) for seconds in (1.0, 2.0))
    panda.serve_planner(lambda request: second if request.planner == "ptp" else first, planner="ptp", seconds=0.1)
    executed = panda.serve_executor("active")
    panda.put_task()
    panda.put_motion()
    await page.set("Goal", "home")
    await page.set("Compare with", "ptp")
    await page.until(lambda: page.button("Execute compared plan")[1] == "press Plan first")
    await page.press("Plan")
    await page.until(lambda: "motion of 1.0 s" in page.text and "ptp: Planned by ptp" in page.text)
    assert scenes[0].calls_of("play") == [(first,)] and scenes[0].calls_of("compare")[-1] == (second,)
    await page.press("Execute compared plan")
    assert (await asyncio.wait_for(executed.get(), PATIENCE)).trajectory == second
    await page.until(lambda: page.button("Execute")[1] == page.button("Execute compared plan")[1] == "press Plan first")


async def test_saved_pose_is_a_goal_on_the_next_page_too(panda: FakeServices, page: FakeBrowser) -> None:
    planned, q = panda.serve_planner(), [0.1, -0.7, 0.0, -2.0, 0.0, 1.5, 0.7]
    panda.put_joints(JOINTS, q, 1)
    panda.put_motion()
    await page.until(lambda: page.status.get("live", {}).get("j:panda_joint1") == "5.7 °")
    await page.until(lambda: page.button("Save current pose")[1] == "enter a pose name first")
    await page.set("Pose name", "over, there")
    await page.press("Save current pose")
    await page.until(lambda: "'over, there'" in page.text or "over, there" in page.status["note"]["text"])
    await page.set("Pose name", "bin")
    await page.set("Sequence", "bin")
    await page.until(lambda: not page.button("Run sequence")[1])
    await page.press("Save current pose")
    await page.until(lambda: "bin" in page.parts[page.label("Goal")]["options"])
    await page.set("Goal", "bin")
    await page.press("Plan")
    assert (await asyncio.wait_for(planned.get(), PATIENCE)).goal == m.JointGoal(positions=q)
    async with page_of("panda") as (_, later):
        await later.until(lambda: "bin" in later.parts[later.label("Goal")]["options"])


async def test_hand_eye_calibration_is_guided(panda: FakeServices, page: FakeBrowser) -> None:
    await page.until(lambda: page.button("Start calibration")[1] == "enter a name first"
                     and page.button("Capture view")[1] == "start a calibration first")
    await page.set("Capture automatically", False)
    await page.set("Calibration name", "wrist")
    await page.press("Start calibration")
    await page.until(lambda: "Missing: 15 more views: tilt the" in page.text
                     and page.button("Calibrate")[1] == "6 views are needed")
    panda.put(topics.CAMERA_IMAGE, m.Image(
        header=m.Header(), height=48, width=64, encoding="bgr8", data=bytes(3 * 48 * 64)))
    await page.press("Capture view")
    await page.until(lambda: "no joint state" in page.text or "no image received" in page.text)
    await page.press("End calibration")
    await page.until(lambda: page.button("Calibrate")[1] == "start a calibration first")
