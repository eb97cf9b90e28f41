"""Operating task, gripper, controller and simulated world on the page."""

from __future__ import annotations

import asyncio

import pytest

from common import messages as m
from common import topics
from common.config import Members
from common.errors import Refused
from tests.page.fake_browser import PATIENCE, FakeBrowser
from tests.services.viewer.conftest import FakeServices, page_of, until


async def test_stop_stops_the_arm_and_the_task(panda: FakeServices, page: FakeBrowser) -> None:
    await page.send(do="stop", n=3)
    await until(lambda: panda.stops and panda.commands)
    assert (panda.stops, panda.commands) == (["stopped on the page"], ["stop"])
    panda.put_motion(m.Interlock(kind="stopped", by="page", reason="stopped on the page", since=5_000_000))
    await page.until(lambda: page.results == [(3, "Stopped by page", "good")])
    await page.until(lambda: page.status["situation"]["text"] == "Stopped by page")
    assert page.status["situation"]["since"] == 5.0, "[ms]"
    assert page.text.count("Stopped by") == 1 and not page.status["note"]["text"]


@pytest.mark.parametrize(("arm", "line", "kind"), [
    (True, "Arm stopped by page; task NOT stopped: the task does not respond", "good"),
    (False, "NOT stopped: the arm's controller does not respond", "bad"),
])
async def test_missing_answer_to_a_stop_is_shown(arm: bool, line: str, kind: str) -> None:
    async with page_of("panda", serve=False) as (services, page):
        if arm:
            services.bus.serve(topics.MOTION_STOP, services.stop)
        await page.send(do="stop", n=1)
        await page.until(lambda: line in page.text and page.results == [(1, line, kind)])
        assert len(services.stops) == arm


async def test_stop_in_a_cell_without_a_task_mentions_none() -> None:
    async with page_of("panda", serve=False, members=Members(services=[])) as (services, page):
        services.bus.serve(topics.MOTION_STOP, services.stop)
        await page.send(do="stop", n=1)
        await page.until(lambda: page.results == [(1, "Stopped by page", "good")])
        await page.until(lambda: page.button("Start")[1] == "this cell has no task")


@pytest.mark.parametrize(("command", "state", "others"), [
    ("Start", {"state": "IDLE"}, {"Pause": "nothing is running", "Resume": "nothing is paused"}),
    ("Pause", {"state": "GRASPING", "started": True}, {"Start": "already running", "Resume": "nothing is paused"}),
    ("Resume", {"state": "GRASPING", "started": True, "paused": True},
     {"Start": "paused: press Resume", "Pause": "already paused"}),
    ("Start", {"state": "DONE", "started": True}, {"Pause": "nothing is running", "Resume": "nothing is paused"}),
])
async def test_command_is_sent_and_commands_without_effect_are_disabled(panda, page, command, state, others):
    await page.until(lambda: "does not respond" in page.button("Start")[1]
                     and "the arm's state is unknown" in page.button("Go home")[1])
    panda.put_motion()
    panda.put_task(**state)
    await page.press(command)
    await until(lambda: panda.commands)
    assert panda.commands == [command.lower()]
    await page.until(lambda: {label: page.button(label)[1] for label in others} == others)


async def test_hold_of_another_operator_is_overridden_by_pressing_twice(panda: FakeServices, page: FakeBrowser) -> None:
    panda.holder = "anna"
    panda.put_task()
    panda.put_motion(held=True)
    await page.press("Resume")
    await page.until(lambda: "the robot is held by anna: press Resume again to override" in page.text)
    await page.press("Resume")
    await page.until(lambda: "press Resume again" not in page.text
                     and page.button("Start")[1] == "paused: press Resume")
    assert panda.commands == ["resume", "resume"]


async def test_new_hold_after_a_rejection_is_shown_before_it_is_overridden(panda, page):
    panda.put_task()
    for since, panda.holder in ((5, "anna"), (9, "bob")):
        panda.put_motion(m.Interlock(kind="held", by=panda.holder, since=since), held=True)
        await page.until(lambda: f"Paused by {panda.holder}" in page.text)
        await page.press("Resume")
        await page.until(lambda: f"the robot is held by {panda.holder}: press Resume again to override" in page.text)
    panda.put_motion(m.Interlock(kind="stopped", by="anna", reason="smoke", since=0))
    await page.until(lambda: "Stopped by anna: smoke" in page.text)


async def test_robot_controller_shows_its_state_and_is_recovered(panda: FakeServices, page: FakeBrowser) -> None:
    panda.put(topics.ROBOT_STATUS, m.RobotStatus(mode="fault", message="the bus is off"))
    panda.put_motion(held=True)
    await page.until(lambda: "held" in page.text)
    await page.until(lambda: page.label("Robot controller"))
    folder = page.label("Robot controller")
    assert "the bus is off" not in page.text and not page.parts[folder]["visible"], "there is no controller"
    panda.put(topics.ROBOT_STATUS, m.RobotStatus(
        mode="protective_stop", message="look <why>", speed=0.3, late=0.012, controller=True))
    shown = ("Protective stop", "look &lt;why&gt;", "<b>30%</b>", "<b>12 ms</b>", 'data-mode="protective_stop"')
    await page.until(lambda: page.parts[folder]["visible"] and all(text in page.text for text in shown))
    await page.click("Recover")
    await page.until(lambda: "Recover: ready" in page.text)
    await page.click("Enable")
    await page.until(lambda: "enable: the emergency stop is pressed" in page.text)
    assert [act for act, _ in panda.orders] == ["recover", "enable"] and all(owner for _, owner in panda.orders)


async def test_gripper_buttons_send_commands(panda: FakeServices, page: FakeBrowser) -> None:
    commands: asyncio.Queue[m.GripperCommand] = asyncio.Queue()

    async def grip(request: m.GripperCommand) -> m.GripperState:
        commands.put_nowait(request)
        return m.GripperState(id=request.id, state="active")

    panda.bus.serve(topics.GRIPPER_COMMAND, grip)
    panda.put_motion()
    await page.until(lambda: not page.button("Open")[1])
    await page.set("Width [mm]", 30.0)
    await page.set("Force [N]", 12.0)
    for button, width in (("Move to width", 0.03), ("Open", 0.08), ("Close", 0.0)):
        await page.press(button)
        command = await asyncio.wait_for(commands.get(), PATIENCE)
        assert (round(command.width, 4), command.effort) == (width, 12.0)
        assert command.header.stamp, "a late command is rejected by its stamp"


async def test_dragged_object_is_moved_and_a_rejection_is_shown(panda, page, scenes):
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


async def test_page_shows_the_past_until_the_arm_is_operated(panda, page, scenes, monkeypatch):
    for name in ("SLOW_PERIOD", "FAST_PERIOD", "_PRESENT_TOLERANCE"):
        monkeypatch.setattr(f"page.history.{name}", 0.01)

    def shown() -> float | None:
        state = scenes[0].latest(topics.JOINT_STATES) if scenes else None
        return state.position[0] if state is not None else None

    for number, state in enumerate(("GRASPING", "PLACING")):
        panda.put_joints(["panda_joint1"], [1.0 + number], 1 + number)
        await until(lambda number=number: shown() == 1.0 + number)
        panda.put_task(state=state, started=True, subject="ball_1")
        await page.until(lambda number=number: f"time:event{number}" in page.text)
    await page.until(lambda: "Placing ball_1" in page.text and "Grasping ball_1" in page.text)
    await page.press("‹ Event")
    await page.press("‹ Event")
    await until(lambda: shown() == 1.0)
    await page.until(lambda: "s ago" in page.status["past"])
    await page.press("Take control")
    await until(lambda: shown() == 2.0)
    await page.until(lambda: not page.status["past"])
