"""The bar above the page, at four sizes: STOP is in view and reached whatever else is on, and what is lost is said."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from common import topics
from common.messages import JointState, MotionOwner
from tests.harness import until
from tests.page.browser.conftest import IN_BROWSER, PATIENCE, Bring, Opened, Watched

if TYPE_CHECKING:
    from playwright.async_api import Page

pytestmark = IN_BROWSER

LAYOUT = Path(__file__).with_name("nothing_to_draw.yaml")
PANDA = ("up", "panda", "--set", "autostart=false", "--set", f"services.viewer.layout={LAYOUT}")
MOVING = 0.01  # [rad/s]
SIZES = {"large": (1600, 1000), "usual": (1280, 800), "small": (800, 600), "phone": (390, 844)}

# What lies at the middle and the corners of STOP, how large that is, and whether the bar covers anything of the page,
# as it is seen: room for a bar that has grown is made when the next picture is drawn.
LOOK = """async () => {
  await new Promise(drawn => requestAnimationFrame(() => requestAnimationFrame(drawn)));
  const stop = document.querySelector("#zc-stop"), at = stop.getBoundingClientRect();
  const inside = [[0.5, 0.5], [0.05, 0.1], [0.95, 0.9]].every(([x, y]) =>
    document.elementFromPoint(at.x + x * at.width, at.y + y * at.height) === stop);
  const bar = document.querySelector("#zc-bar").getBoundingClientRect();
  const root = document.querySelector("#root").getBoundingClientRect();
  const wide = [...document.querySelectorAll(".zc button")].filter(each => each.offsetParent).map(each =>
    each.getBoundingClientRect()).filter(each => each.right > innerWidth + 1 || each.left < -1);
  return {inside, width: at.width, height: at.height, apart: root.top >= bar.bottom - 1, sideways:
    document.documentElement.scrollWidth > innerWidth, wide: wide.length, red: getComputedStyle(stop).backgroundColor};
}"""


async def look(page: Page) -> None:
    """STOP is whole, large and red, and nothing lies over it or sticks out."""
    seen = await page.evaluate(LOOK)
    assert seen["inside"] and seen["apart"] and not seen["sideways"] and not seen["wide"], seen
    assert seen["width"] >= 100 and seen["height"] >= 44, seen
    red, green, blue = (int(part) for part in seen["red"].strip("rgb()").split(","))
    assert red > 180 and green < 80 and blue < 80


@pytest.mark.parametrize("size", SIZES)
async def test_stop_is_in_view_and_reached_whatever_is_open(bring: Bring, watched: Watched, size: str) -> None:
    cell = await bring(*PANDA)
    width, height = SIZES[size]
    await watched.page.set_viewport_size({"width": width, "height": height})
    page = await watched.open(cell.address)
    await page.get_by_role("button", name="Start").wait_for()
    await look(page)
    for icon in await page.locator("#root .mantine-ActionIcon-root").all():  # of the panel's head: settings, commands
        if await icon.is_visible():
            await icon.click(force=True)
            await look(page)
            break
    await page.reload()
    await page.get_by_role("button", name="Start").wait_for()
    if size == "phone":
        await page.get_by_text("zencell · panda").click()  # folds the panel up
        await look(page)
        await page.get_by_text("zencell · panda").click()
    await page.mouse.move(width - 60, height - 60)
    await page.mouse.wheel(0, 2000)
    await look(page)
    await page.get_by_role("button", name="STOP: stop the arm and the task").click()
    await page.get_by_role("status").get_by_text("Stopped by page").wait_for()
    assert not watched.errors


async def test_stop_is_reached_by_keys_alone(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await page.get_by_role("button", name="Start").wait_for()
    await page.keyboard.press("Tab")
    assert await page.evaluate("document.activeElement.id") == "zc-stop", "it is the first"
    async with cell.listen() as bus:
        motion = bus.reader(topics.MOTION_STATUS)
        for key in ("Enter", "Space", "Escape"):
            before = (await until(motion, lambda told: True, PATIENCE)).newest
            await page.keyboard.press(key)
            await until(motion, lambda told, before=before: told.newest > before, PATIENCE)
            await page.get_by_role("status").get_by_text("Stopped by page").wait_for()


async def test_arm_is_jogged_only_while_the_button_is_held(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await page.get_by_text("Move", exact=True).first.click()
    more = page.get_by_role("button", name="jog joint1, plus")
    async with cell.listen() as bus:
        owner = bus.reader(topics.MOTION_OWNER)

        def jogging(told: MotionOwner) -> bool:
            return told.jogging and told.owner == "page"

        async def ended() -> None:
            await until(owner, lambda told: not told.jogging, PATIENCE)

        for let_go in ("release", "leave", "blur", "stop", "close"):
            await more.hover()
            await page.mouse.down()
            await until(owner, jogging, PATIENCE)
            if let_go == "release":
                await page.mouse.up()
            elif let_go == "leave":
                await page.mouse.move(5, 400)
            elif let_go == "blur":
                await page.evaluate("window.dispatchEvent(new Event('blur'))")
            elif let_go == "stop":
                await page.keyboard.press("Escape")
            else:
                await page.close()
            await ended()
            if let_go != "close":
                await page.mouse.up()


async def test_of_two_pages_that_jog_one_moves_the_arm_and_the_other_is_told_why_it_does_not(
    bring: Bring, watched: Watched, opened: Opened
) -> None:
    from playwright.async_api import TimeoutError as NotInTime

    cell = await bring(*PANDA)
    async with opened() as other, cell.listen() as bus:
        pages = [await watched.open(cell.address), await other.open(cell.address)]
        joints = bus.reader(topics.JOINT_STATES)
        for page in pages:
            await page.get_by_text("Move", exact=True).first.click()
            await page.get_by_role("button", name="jog joint1, plus").hover()

        def moves(index: int) -> Callable[[JointState], bool]:
            return lambda state: abs(state.velocity[index]) > MOVING and abs(state.velocity[1 - index]) < MOVING

        async def release() -> None:
            for page in pages:
                await page.mouse.up()
            await until(joints, lambda state: max(map(abs, state.velocity)) < MOVING, PATIENCE)

        told = pages[1].get_by_text("Another page jogs the arm").first
        await pages[1].get_by_role("button", name="jog joint2, plus").hover()
        for _ in range(5):  # a page whose words a busy machine holds up lets go
            await pages[0].mouse.down()
            await until(joints, moves(0), PATIENCE)
            await pages[1].mouse.down()
            with suppress(NotInTime):
                await told.wait_for(timeout=5e3)
                break
            await release()
        assert await told.is_visible()
        await release()
        await pages[1].mouse.down()  # the press before does not count any more
        await until(joints, moves(1), PATIENCE)
        await release()


async def test_server_that_does_not_answer_is_a_banner_and_stop_says_so_until_it_is_back(
    bring: Bring, watched: Watched
) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await page.get_by_role("button", name="Start").wait_for()
    banner, viewer = page.get_by_role("alert"), cell.processes()["viewer"]
    assert not await banner.is_visible()
    viewer.send_signal(signal.SIGSTOP)
    try:
        await banner.get_by_text("No connection to the page's server").wait_for()
        assert await page.evaluate("document.body.dataset.unknown") == "all"
        await page.get_by_role("button", name="STOP").click()
        await page.get_by_role("status").get_by_text("NOT stopped: no connection").wait_for()
        await look(page)
    finally:
        viewer.send_signal(signal.SIGCONT)
    await banner.wait_for(state="hidden")
    assert await page.evaluate("document.body.dataset.unknown") == ""
