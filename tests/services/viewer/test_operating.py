"""Operating task and arm on the page."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS, PickPlaceStatus
from common import messages as m
from common import topics
from common.errors import Refused
from common.transport.reader import Reader
from tests.page.fake_browser import PATIENCE, FakeBrowser, opened
from tests.services.viewer.conftest import TOKEN, FakeScene, FakeServices, serve_page, until


async def aim(page: FakeBrowser, goal: str) -> None:
    """Select a goal, and wait for it: a press uses another connection."""
    await page.set("Goal", goal)
    await page.until(lambda: not page.parts[page.label("Show goal marker")]["visible"])


async def test_stop_stops_the_arm_and_the_task(panda: FakeServices, page: FakeBrowser) -> None:
    await page.send(do="stop", n=3)
    await until(lambda: panda.stops and panda.commands)
    assert (panda.stops, panda.commands) == (["stopped on the page"], ["stop"])
    await page.until(lambda: ">Stopped by page<" in page.text and page.results == [(3, "Stopped by page", "good")])
    await page.until(lambda: page.status["note"]["text"] == "Stopped by page")


async def test_arm_is_stopped_and_the_missing_answer_of_the_task_is_shown(panda: FakeServices) -> None:
    async with serve_page("panda", serve=False) as alone:
        alone.bus.serve(topics.MOTION_STOP, alone.stop)
        async with opened(alone.port) as page:
            await page.send(do="stop", n=1)
            await until(lambda: alone.stops)
            line = "Arm stopped by page; task NOT stopped: no service answers task/command now"
            await page.until(lambda: line in page.text and page.results == [(1, line, "good")])


async def test_failed_stop_is_shown() -> None:
    async with serve_page("panda", serve=False) as services, opened(services.port) as page:
        await page.send(do="stop", n=7)
        line = "NOT stopped: no service answers motion/stop now"
        await page.until(lambda: line in page.text and page.results == [(7, line, "bad")])


@pytest.mark.parametrize(("command", "state", "others"), [
    ("Start", {"state": "IDLE"}, {"Pause": "nothing is running", "Resume": "nothing is paused"}),
    ("Pause", {"state": "GRASPING", "started": True}, {"Start": "already running", "Resume": "nothing is paused"}),
    ("Resume", {"state": "GRASPING", "started": True, "paused": True},
     {"Start": "the task is paused: press Resume", "Pause": "already paused"}),
    ("Start", {"state": "DONE", "started": True}, {"Pause": "nothing is running", "Resume": "nothing is paused"}),
])
async def test_command_is_sent_and_commands_without_effect_are_disabled(
    panda: FakeServices, page: FakeBrowser, command: str, state: dict[str, Any], others: dict[str, str]
) -> None:
    panda.bus.writer(topics.MOTION_STATUS).put(m.MotionStatus())
    panda.bus.writer(PICK_PLACE_STATUS).put(PickPlaceStatus(**state))
    await page.press(command)
    await until(lambda: panda.commands)
    assert panda.commands == [command.lower()]
    assert {label: page.button(label)[1] for label in others} == others


async def test_commands_are_disabled_until_task_and_arm_publish(panda: FakeServices, page: FakeBrowser) -> None:
    await page.until(lambda: "does not respond" in page.button("Start")[1])
    assert "the arm's state is unknown" in page.button("Go home")[1]


async def test_hold_of_another_operator_is_overridden_by_pressing_twice(panda: FakeServices, page: FakeBrowser) -> None:
    panda.holder = "anna"
    panda.bus.writer(PICK_PLACE_STATUS).put(PickPlaceStatus())
    panda.bus.writer(topics.MOTION_STATUS).put(m.MotionStatus(held=True))
    await page.press("Resume")
    await page.until(lambda: "the robot is held by anna: press Resume again to override" in page.text)
    await page.press("Start")
    await page.until(lambda: "press Start again" in page.text)
    await page.press("Start")
    await page.until(lambda: "press Start again" not in page.text)
    assert panda.commands == ["resume", "start", "start"]


async def test_new_hold_after_a_rejection_is_shown_before_it_is_overridden(
    panda: FakeServices, page: FakeBrowser
) -> None:
    motion, task = panda.bus.writer(topics.MOTION_STATUS), panda.bus.writer(PICK_PLACE_STATUS)
    task.put(PickPlaceStatus())
    for since, panda.holder in ((5, "anna"), (9, "bob")):
        motion.put(m.MotionStatus(held=True, interlocks=[m.Interlock(kind="held", by=panda.holder, since=since)]))
        await page.until(lambda: f"UTC by {panda.holder}" in page.text)
        await page.press("Start")
        await page.until(lambda: f"the robot is held by {panda.holder}: press Start again to override" in page.text)


async def test_operator_who_stopped_the_robot_is_shown(panda: FakeServices, page: FakeBrowser) -> None:
    stop = m.Interlock(kind="stopped", by="anna", reason="smoke", since=0)
    panda.bus.writer(topics.MOTION_STATUS).put(m.MotionStatus(interlocks=[stop]))
    await page.until(lambda: "stopped since 1970-01-01 00:00:00 UTC by anna (smoke)" in page.text)


async def test_robot_controller_shows_its_state_and_is_recovered(
    panda: FakeServices, page: FakeBrowser
) -> None:
    robot = panda.bus.writer(topics.ROBOT_STATUS)
    robot.put(m.RobotStatus(mode="fault", message="the bus is off"))
    panda.bus.writer(topics.MOTION_STATUS).put(m.MotionStatus(held=True))
    await page.until(lambda: "held" in page.text)
    folder = page.label("Robot controller")
    assert "the bus is off" not in page.text and not page.parts[folder]["visible"], "there is no controller"
    robot.put(m.RobotStatus(mode="protective_stop", message="look <why>", speed=0.3, late=0.012, controller=True))
    await page.until(lambda: "Protective stop" in page.text and page.parts[folder]["visible"])
    for shown in ("look &lt;why&gt;", "<b>30%</b>", "<b>12 ms</b>", 'data-mode="protective_stop"'):
        assert shown in page.text
    await page.click("Recover")
    await page.until(lambda: "Recover: ready" in page.text)
    await page.click("Enable")
    await page.until(lambda: "enable: the emergency stop is pressed" in page.text)
    assert [act for act, _ in panda.orders] == ["recover", "enable"] and all(owner for _, owner in panda.orders)


async def test_invalid_goal_is_shown_and_the_service_continues(panda: FakeServices, page: FakeBrowser) -> None:
    await page.set("Goal", "tool pose")
    await page.until(lambda: page.parts[page.label("Tool position [mm]")]["visible"])
    await page.set("Tool position [mm]", [1e11, 0.0, 400.0])
    async with asyncio.timeout(PATIENCE):
        while "position.x" not in page.status["note"]["text"]:
            await page.send(do="press", what="move:plan")  # the numbers use another connection
            await asyncio.sleep(0.05)


async def test_dragged_object_is_moved_and_a_rejection_is_shown(
    panda: FakeServices, page: FakeBrowser, scenes: list[FakeScene]
) -> None:
    moved: list[m.WorldEdit] = []

    async def edit(request: m.WorldEdit) -> m.WorldEditReply:
        moved.append(request)
        raise Refused("not_free", "ball_1 is there")

    panda.bus.serve(topics.WORLD_EDIT, edit)
    await page.set("Edit simulated world", True)
    await until(lambda: scenes and scenes[0].calls_of("set_editing"))
    console = scenes[0].console
    await asyncio.to_thread(lambda: console.put(lambda: console.on_object_moved("ball_2", 0.5, 0.1)))
    await page.until(lambda: "ball_1 is there" in page.text)
    assert moved == [m.WorldEdit(op="move", id="ball_2", position=m.Vector3(x=0.5, y=0.1))]


async def test_failed_plan_to_the_marker_names_the_collision(
    panda: FakeServices, page: FakeBrowser, scenes: list[FakeScene]
) -> None:
    asked: list[m.PlanRequest] = []

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        asked.append(request)
        return m.PlanResponse(id=request.id, ok=False, error="collision", message="operator: the goal collides",
                              colliding=("panda_hand", "table"))

    panda.bus.serve(topics.MOTION_PLAN, plan)
    await until(lambda: scenes)
    await page.press("Plan")
    await page.until(lambda: "Drag the goal marker" in page.text)
    await until(lambda: scenes[0].calls_of("show_goal_marker") == [(True,)])
    await page.set("Planner", "chomp")
    await page.press("Plan")
    await page.until(lambda: "the goal collides; panda_hand would collide with table" in page.text)
    assert (asked[0].planner, asked[0].goal) == ("chomp", m.PoseGoal(pose=scenes[0].goal_pose))


async def test_plan_is_discarded_when_the_goal_marker_is_moved(
    panda: FakeServices, page: FakeBrowser, scenes: list[FakeScene]
) -> None:
    point = m.JointTrajectoryPoint(time_from_start=1.0, positions=[0.0] * 7, velocities=[0.0] * 7,
                                   accelerations=[0.0] * 7)
    way = m.JointTrajectory(joint_names=[f"panda_joint{k}" for k in range(1, 8)], points=[point])

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        return m.PlanResponse(id=request.id, ok=True, trajectory=way)

    panda.bus.serve(topics.MOTION_PLAN, plan)
    panda.bus.writer(topics.MOTION_STATUS).put(m.MotionStatus())
    await until(lambda: scenes)
    await page.set("Show goal marker", True)
    await until(lambda: scenes[0].calls_of("show_goal_marker"))
    await page.press("Plan")
    await page.until(lambda: page.button("Execute")[1] == "")
    scenes[0].goal_pose = m.Pose(position=m.Vector3(x=0.5, z=0.5))
    await page.until(lambda: "press Plan first" in page.button("Execute")[1])
    assert "The goal marker was moved: press Plan again." in page.text


async def jogs_of(reader: Reader[m.JogCommand], count: int) -> list[m.JogCommand]:
    async with asyncio.timeout(PATIENCE):
        return [await reader.next() for _ in range(count)]


async def ready_to_jog(panda: FakeServices, page: FakeBrowser) -> Reader[m.JogCommand]:
    reader = panda.bus.reader(topics.MOTION_JOG)
    panda.bus.writer(topics.MOTION_STATUS).put(m.MotionStatus())
    await page.until(lambda: not page.button("Open")[1])
    return reader


async def test_each_hold_message_sends_one_jog_command(
    panda: FakeServices, page: FakeBrowser
) -> None:
    reader = await ready_to_jog(panda, page)
    held = []
    for _ in range(3):
        await page.hold("joint:panda_joint2:-")
        held += await jogs_of(reader, 1)
    assert {tuple(jog.joints) for jog in held} == {("panda_joint2",)} and held[0].joints["panda_joint2"] < 0
    assert {jog.owner for jog in held} == {"page"} and all(jog.header.stamp for jog in held)
    await page.send(do="release")
    (rest,) = await jogs_of(reader, 1)
    assert not rest.joints and rest.linear == m.Vector3()
    await page.set("Jog mode", "tool, tool frame")
    await page.until(lambda: "move:tool:z:+" in page.text)
    await page.hold("move:tool:z:+", press=2)
    (jog,) = await jogs_of(reader, 1)
    assert jog.frame == "tool" and jog.linear.z == pytest.approx(0.2 * 0.25) and not jog.joints
    for odd in ("move:moon:z:+", "joint:elbow:+", "joint:panda_joint2:", "move:tool:w:-", ""):
        await page.hold(odd)
    await page.send(do="release")
    (rest,) = await jogs_of(reader, 1)
    assert rest.linear == m.Vector3()


async def test_closed_page_stops_its_jogging(panda: FakeServices) -> None:
    async with opened(panda.port) as page:
        reader = await ready_to_jog(panda, page)
        await page.hold("joint:panda_joint1:+")
        (jog,) = await jogs_of(reader, 1)
        assert jog.joints
    (rest,) = await jogs_of(reader, 1)
    assert not rest.joints


async def test_stop_ends_jogging_until_the_button_is_released(panda: FakeServices, page: FakeBrowser) -> None:
    reader, status = await ready_to_jog(panda, page), panda.bus.writer(topics.MOTION_STATUS)
    await page.hold("joint:panda_joint1:+")
    await jogs_of(reader, 1)
    stop = m.Interlock(kind="stopped", by="page", since=7)
    status.put(m.MotionStatus(interlocks=[stop]))
    await page.until(lambda: "stopped since" in page.text)
    await page.hold("joint:panda_joint1:+")
    assert not (await jogs_of(reader, 1))[0].joints
    for _ in range(3):
        await page.hold("joint:panda_joint1:+")  # the same press stays rejected
    await page.until(lambda: page.results and "rejected: the arm is stopped" in page.results[-1][1])
    async with asyncio.timeout(PATIENCE):
        while reader.latest is None or not reader.latest.joints:  # a new press after its own stop
            await page.hold("joint:panda_joint1:+", press=2)
            await asyncio.sleep(0.04)
    assert reader.latest.acknowledged == 7
    status.put(m.MotionStatus(interlocks=[stop.model_copy(update={"by": "anna", "since": 8})]))
    await page.until(lambda: "by anna" in page.text)
    await page.send(do="release")
    await page.hold("joint:panda_joint1:+", press=3)
    await page.until(lambda: "by anna" in page.results[-1][1])


async def test_arm_of_a_running_task_is_not_jogged(panda: FakeServices, page: FakeBrowser) -> None:
    reader = await ready_to_jog(panda, page)
    panda.bus.writer(PICK_PLACE_STATUS).put(PickPlaceStatus(state="GRASPING", started=True))
    await page.until(lambda: "the task controls the arm" in page.button("Open")[1])
    await page.hold("joint:panda_joint1:+")
    await page.until(lambda: page.results and "Jogging rejected: the task controls the arm" in page.results[-1][1])
    assert reader.latest is None


async def test_second_operator_sees_the_page_with_control_and_takes_control() -> None:
    async with (
        serve_page("panda", token=TOKEN) as services,
        opened(services.port, TOKEN) as first, opened(services.port, TOKEN) as second,
    ):
        reader = await ready_to_jog(services, first)
        await first.hold("joint:panda_joint1:+")
        await jogs_of(reader, 1)
        await second.until(lambda: "has control: press Take page control, or wait" in second.status["blocked"])
        assert first.status["blocked"] == "", "both connections belong to one page"
        await second.hold("joint:panda_joint1:-")
        await second.until(lambda: second.results and "has control: press Take page control" in second.results[-1][1])
        await second.send(do="stop", n=1)
        await until(lambda: services.stops)
        await second.press("Take page control")
        await first.until(lambda: "has control" in first.status["blocked"] and second.status["blocked"] == "")
        assert all(not jog.joints or jog.joints["panda_joint1"] > 0 for jog in [reader.latest] if jog)


async def test_gripper_buttons_send_commands(panda: FakeServices, page: FakeBrowser) -> None:
    asked: list[m.GripperCommand] = []

    async def grip(request: m.GripperCommand) -> m.GripperState:
        asked.append(request)
        return m.GripperState(id=request.id, state="active")

    panda.bus.serve(topics.GRIPPER_COMMAND, grip)
    await ready_to_jog(panda, page)
    await page.set("Width [mm]", 30.0)
    await page.set("Force [N]", 12.0)
    for button in ("Move to width", "Open", "Close"):
        await page.press(button)
        await until(lambda button=button: len(asked) == 1 + ("Move to width", "Open", "Close").index(button))
    assert [(round(one.width, 4), one.effort) for one in asked] == [(0.03, 12.0), (0.08, 12.0), (0.0, 12.0)]
    assert all(one.header.stamp for one in asked), "a late command is rejected by its stamp"


async def test_saved_pose_is_a_goal_on_the_next_page_too(panda: FakeServices, page: FakeBrowser) -> None:
    asked: list[m.PlanRequest] = []

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        asked.append(request)
        return m.PlanResponse(id=request.id, ok=False, error="unreachable", message="not today")

    panda.bus.serve(topics.MOTION_PLAN, plan)
    names = [f"panda_joint{k}" for k in range(1, 8)]
    q = [0.1, -0.7, 0.0, -2.0, 0.0, 1.5, 0.7]
    panda.bus.writer(topics.JOINT_STATES).put(m.JointState(header=m.Header(stamp=1), name=names, position=q))
    await ready_to_jog(panda, page)
    await page.until(lambda: page.status.get("live", {}).get("j:panda_joint1") == "5.7 °")
    assert page.button("Save current pose")[1] == "enter a pose name first"
    await page.set("Pose name", "over, there")
    await page.press("Save current pose")
    await page.until(lambda: "'over, there'" in page.text or "over, there" in page.status["note"]["text"])
    await page.set("Pose name", "bin")
    await page.set("Sequence", "bin")  # a press uses another connection
    await page.until(lambda: not page.button("Run sequence")[1])
    await page.press("Save current pose")
    await page.until(lambda: "bin" in page.parts[page.label("Goal")]["options"])
    await aim(page, "bin")
    await page.press("Plan")
    await until(lambda: asked)
    assert asked[0].goal == m.JointGoal(positions=q)
    async with serve_page("panda") as again, opened(again.port) as later:
        await later.until(lambda: "bin" in later.parts[later.label("Goal")]["options"])


async def test_plan_is_executed_once(panda: FakeServices, page: FakeBrowser) -> None:
    found = m.JointTrajectory(header=m.Header(stamp=5), joint_names=["a"], points=[
        m.JointTrajectoryPoint(positions=[float(k)], velocities=[0.0], accelerations=[0.0], time_from_start=float(k))
        for k in range(2)])
    asked: list[m.ExecuteRequest] = []

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        return m.PlanResponse(id=request.id, ok=True, planner="ompl", trajectory=found)

    async def execute(request: m.ExecuteRequest) -> m.MotionStatus:
        asked.append(request)
        return m.MotionStatus(id=request.id, state="succeeded")

    panda.bus.serve(topics.MOTION_PLAN, plan)
    panda.bus.serve(topics.MOTION_EXECUTE, execute)
    panda.bus.writer(PICK_PLACE_STATUS).put(PickPlaceStatus())
    await ready_to_jog(panda, page)
    await page.until(lambda: page.button("Execute")[1] == "press Plan first")
    await aim(page, "home")
    await page.press("Plan")
    await page.press("Execute")
    await until(lambda: asked)
    assert asked[0].trajectory == found and asked[0].plan
    await page.until(lambda: page.button("Execute")[1] == "press Plan first")


async def test_two_plans_are_compared_and_the_second_one_is_executed(
    panda: FakeServices, page: FakeBrowser, scenes: list[FakeScene]
) -> None:
    asked: list[m.ExecuteRequest] = []

    def found(seconds: float) -> m.JointTrajectory:
        return m.JointTrajectory(joint_names=["panda_joint1"], points=[
            m.JointTrajectoryPoint(time_from_start=at, positions=[at], velocities=[0.0], accelerations=[0.0])
            for at in (0.0, seconds)])

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        return m.PlanResponse(id=request.id, ok=True, planner=request.planner or "first", seconds=0.1,
                              trajectory=found(2.0 if request.planner else 1.0))

    async def execute(request: m.ExecuteRequest) -> m.MotionStatus:
        asked.append(request)
        return m.MotionStatus(id=request.id, state="active")

    panda.bus.serve(topics.MOTION_PLAN, plan)
    panda.bus.serve(topics.MOTION_EXECUTE, execute)
    panda.bus.writer(PICK_PLACE_STATUS).put(PickPlaceStatus())
    await ready_to_jog(panda, page)
    await page.set("Goal", "home")
    await page.set("Compare with", "ptp")
    await page.until(lambda: page.button("Execute compared plan")[1] == "press Plan first")
    await page.press("Plan")
    await page.until(lambda: "motion of 1.0 s" in page.text and "ptp: Planned by ptp" in page.text)
    assert scenes[0].calls_of("play") == [(found(1.0),)] and scenes[0].calls_of("compare")[-1] == (found(2.0),)
    await page.press("Execute compared plan")
    await until(lambda: asked)
    assert asked[0].trajectory == found(2.0)
    await page.until(lambda: page.button("Execute")[1] == page.button("Execute compared plan")[1] == "press Plan first")


async def test_control_is_taken_from_another_operator_by_pressing_twice(
    panda: FakeServices, page: FakeBrowser
) -> None:
    asked: list[m.OwnRequest] = []
    anna = m.MotionOwner(owner="anna", kind="operator", asked=True, since=1)

    async def own(request: m.OwnRequest) -> m.MotionOwner:
        asked.append(request)
        if not request.over:
            raise Refused("not_owner", f"the motion is {anna.description}")
        return m.MotionOwner(owner=request.owner, kind="operator", asked=True)

    panda.bus.serve(topics.MOTION_OWN, own)
    panda.bus.writer(topics.MOTION_OWNER).put(anna)
    await page.until(lambda: all("owned by anna (operator)" in shown for shown in (page.text, page.status["blocked"])))
    await page.press("Take control")
    await page.until(lambda: "press Take control again to override" in page.text)
    await page.press("Take control")
    await page.until(lambda: "The motion is owned by page" in page.text)
    assert [(one.act, one.over, one.owner) for one in asked] == [("take", False, "page"), ("take", True, "page")]


async def test_plan_is_animated(
    panda: FakeServices, page: FakeBrowser, scenes: list[FakeScene]
) -> None:
    found = m.JointTrajectory(header=m.Header(stamp=5), joint_names=["a"], points=[])

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        return m.PlanResponse(id=request.id, ok=True, planner="ompl", trajectory=found)

    panda.bus.serve(topics.MOTION_PLAN, plan)
    await page.set("Show goal marker", True)
    await until(lambda: scenes and scenes[0].calls_of("show_goal_marker"))
    await page.press("Plan")
    await page.until(lambda: "Planned by ompl" in page.text)
    await until(lambda: scenes[0].calls_of("play") == [(found,)])


async def test_page_shows_the_past_until_the_arm_is_operated(
    panda: FakeServices, page: FakeBrowser, scenes: list[FakeScene]
) -> None:
    joints, status = panda.bus.writer(topics.JOINT_STATES), panda.bus.writer(PICK_PLACE_STATUS)

    def seen() -> float | None:
        state = scenes[0].latest(topics.JOINT_STATES) if scenes else None
        return state.position[0] if state is not None else None

    async def say(state: Any, value: float) -> None:
        status.put(PickPlaceStatus(state=state, started=True, subject="ball_1"))
        joints.put(m.JointState(header=m.Header(stamp=round(1 + value)), name=["panda_joint1"], position=[value]))
        await until(lambda: seen() == value)
        await asyncio.sleep(0.5)  # stored by then

    await say("GRASPING", 1.0)
    await say("PLACING", 2.0)
    await page.until(lambda: "Placing ball_1" in page.text and "Grasping ball_1" in page.text)
    await page.press("‹ Event")
    await page.press("‹ Event")
    await until(lambda: seen() == 1.0)
    await page.until(lambda: "s ago" in page.status["past"])
    await page.press("Take control")
    await until(lambda: seen() == 2.0)
    await page.until(lambda: not page.status["past"])


async def test_hand_eye_calibration_is_guided(panda: FakeServices, page: FakeBrowser) -> None:
    await page.until(lambda: page.button("Start calibration")[1] == "enter a name first")
    assert page.button("Capture view")[1] == "start a calibration first"
    await page.set("Capture automatically", False)
    await page.set("Calibration name", "wrist")
    await page.press("Start calibration")
    await page.until(lambda: "Missing: 15 more views: tilt the" in page.text)
    assert page.button("Calibrate")[1] == "6 views are needed"
    picture = m.Image(header=m.Header(), height=48, width=64, encoding="bgr8", data=bytes(3 * 48 * 64))
    panda.bus.writer(topics.CAMERA_IMAGE).put(picture)
    await page.press("Capture view")
    await page.until(lambda: "no joint state" in page.text or "no image received" in page.text)
    await page.press("End calibration")
    await page.until(lambda: page.button("Calibrate")[1] == "start a calibration first")
