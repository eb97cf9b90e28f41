"""Jogging the arm on the page, and control of one page at a time."""

from __future__ import annotations

import asyncio

import pytest

from common import messages as m
from common import topics
from common.errors import Refused
from common.transport.reader import Reader
from tests.page.fake_browser import PATIENCE, FakeBrowser, opened
from tests.services.fake_cell import until as next_of
from tests.services.viewer.conftest import TOKEN, FakeServices, serve_page, until


async def ready_to_jog(panda: FakeServices, page: FakeBrowser) -> Reader[m.JogCommand]:
    reader = panda.reader(topics.MOTION_JOG)
    panda.put_motion()
    await page.until(lambda: not page.button("Open")[1])
    return reader


async def test_each_hold_message_sends_one_jog_command(panda: FakeServices, page: FakeBrowser) -> None:
    reader, held = await ready_to_jog(panda, page), []
    for _ in range(3):
        await page.hold("joint:panda_joint2:-")
        held.append(await next_of(reader))
    assert {tuple(jog.joints) for jog in held} == {("panda_joint2",)} and held[0].joints["panda_joint2"] < 0
    assert {jog.owner for jog in held} == {"page"} and all(jog.header.stamp for jog in held)
    await page.send(do="release")
    rest = await next_of(reader)
    assert not rest.joints and rest.linear == m.Vector3()
    await page.set("Tool axes of", "tool")
    await page.until(lambda: "move:tool:z:+" in page.text)
    await page.hold("move:tool:z:+", press=2)
    jog = await next_of(reader)
    assert jog.frame == "tool" and jog.linear.z == pytest.approx(0.2 * 0.25) and not jog.joints
    for invalid in ("move:moon:z:+", "joint:elbow:+", "joint:panda_joint2:", "move:tool:w:-", ""):
        await page.hold(invalid)
    await page.send(do="release")
    assert (await next_of(reader)).linear == m.Vector3()


async def test_closed_page_stops_its_jogging(panda: FakeServices) -> None:
    async with opened(panda.port) as page:
        reader = await ready_to_jog(panda, page)
        await page.hold("joint:panda_joint1:+")
        assert (await next_of(reader)).joints
    assert not (await next_of(reader)).joints


async def test_stop_ends_jogging_until_the_button_is_released(panda: FakeServices, page: FakeBrowser) -> None:
    reader = await ready_to_jog(panda, page)
    await page.hold("joint:panda_joint1:+")
    await next_of(reader)
    stop = m.Interlock(kind="stopped", by="page", since=7)
    panda.put_motion(stop)
    await page.until(lambda: "Stopped by page" in page.text)
    await page.hold("joint:panda_joint1:+")
    assert not (await next_of(reader)).joints
    for _ in range(3):
        await page.hold("joint:panda_joint1:+")  # the same press stays rejected
    await page.until(lambda: page.results and "rejected: the arm is stopped" in page.results[-1][1])
    async with asyncio.timeout(PATIENCE):
        while reader.latest is None or not reader.latest.joints:  # a new press after its own stop
            await page.hold("joint:panda_joint1:+", press=2)
            await asyncio.sleep(0.01)
    assert reader.latest.acknowledged == 7
    panda.put_motion(stop.model_copy(update={"by": "anna", "since": 8}))
    await page.until(lambda: "by anna" in page.text)
    await page.send(do="release")
    await page.hold("joint:panda_joint1:+", press=3)
    await page.until(lambda: "by anna" in page.results[-1][1])


async def test_arm_of_a_running_task_is_not_jogged(panda: FakeServices, page: FakeBrowser) -> None:
    reader = await ready_to_jog(panda, page)
    panda.put_task(state="GRASPING", started=True)
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
        await next_of(reader)
        await second.until(lambda: "has control: press Take page control, or wait" in second.status["blocked"])
        assert first.status["blocked"] == "", "both connections belong to one page"
        await second.hold("joint:panda_joint1:-")
        await second.until(lambda: second.results and "has control: press Take page control" in second.results[-1][1])
        await second.send(do="stop", n=1)
        await until(lambda: services.stops)
        await second.press("Take page control")
        await first.until(lambda: "has control" in first.status["blocked"] and second.status["blocked"] == "")
        assert all(not jog.joints or jog.joints["panda_joint1"] > 0 for jog in [reader.latest] if jog)


async def test_control_is_taken_from_another_operator_by_pressing_twice(panda, page):
    requests: list[m.OwnRequest] = []
    anna = m.MotionOwner(owner="anna", kind="operator", asked=True, since=1)

    async def own(request: m.OwnRequest) -> m.MotionOwner:
        requests.append(request)
        if not request.over:
            raise Refused("not_owner", f"the motion is {anna.description}")
        return m.MotionOwner(owner=request.owner, kind="operator", asked=True)

    panda.bus.serve(topics.MOTION_OWN, own)
    panda.put(topics.MOTION_OWNER, anna)
    await page.until(lambda: "Control: anna" in page.text and "anna controls the arm" in page.status["blocked"])
    await page.press("Take control")
    await page.until(lambda: "press Take control again to override" in page.text)
    await page.press("Take control")
    await page.until(lambda: "page controls the arm now" in page.text)
    assert [(one.act, one.over, one.owner) for one in requests] == [("take", False, "page"), ("take", True, "page")]
