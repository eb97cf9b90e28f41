"""The bar above the page at four sizes: STOP is visible and clickable, and lost connections are shown."""

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

# What is at the center and the corners of STOP, its size, and whether the bar covers any part of the page; the layout
# follows a taller bar in the next frame.
CHECK = """async () => {
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


async def check_stop(page: Page) -> None:
    """Check that STOP is completely visible, large and red, and that nothing overflows."""
    seen = await page.evaluate(CHECK)
    assert seen["inside"] and seen["apart"] and not seen["sideways"] and not seen["wide"], seen
    assert seen["width"] >= 100 and seen["height"] >= 44, seen
    red, green, blue = (int(part) for part in seen["red"].strip("rgb()").split(","))
    assert red > 180 and green < 80 and blue < 80


@pytest.mark.parametrize("size", SIZES)
async def test_stop_is_visible_and_clickable_whatever_is_open(bring: Bring, watched: Watched, size: str) -> None:
    cell = await bring(*PANDA)
    width, height = SIZES[size]
    await watched.page.set_viewport_size({"width": width, "height": height})
    page = await watched.open(cell.address)
    await page.get_by_role("button", name="Start").wait_for()
    await check_stop(page)
    for icon in await page.locator("#root .mantine-ActionIcon-root").all():  # settings and commands of the panel
        if await icon.is_visible():
            await icon.click(force=True)
            await check_stop(page)
            break
    await page.reload()
    await page.get_by_role("button", name="Start").wait_for()
    if size == "phone":
        await page.get_by_text("zencell · panda").click()  # collapses the panel
        await check_stop(page)
        await page.get_by_text("zencell · panda").click()
    await page.mouse.move(width - 60, height - 60)
    await page.mouse.wheel(0, 2000)
    await check_stop(page)
    await page.get_by_role("button", name="STOP: stop arm and task").click()
    await page.get_by_role("status").get_by_text("Stopped by page").wait_for()
    assert not watched.errors


async def test_stop_works_with_the_keyboard_alone(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await page.get_by_role("button", name="Start").wait_for()
    await page.keyboard.press("Tab")
    assert await page.evaluate("document.activeElement.id") == "zc-stop", "it is the first element"
    async with cell.listen() as bus:
        motion = bus.reader(topics.MOTION_STATUS)
        for key in ("Enter", "Space", "Escape"):
            before = (await until(motion, lambda status: True, PATIENCE)).newest
            await page.keyboard.press(key)
            await until(motion, lambda status, before=before: status.newest > before, PATIENCE)
            await page.get_by_role("status").get_by_text("Stopped by page").wait_for()


async def test_arm_is_jogged_only_while_the_button_is_held(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await page.get_by_text("Move", exact=True).first.click()
    more = page.get_by_role("button", name="jog joint1, plus")
    async with cell.listen() as bus:
        owner = bus.reader(topics.MOTION_OWNER)

        def jogging(status: MotionOwner) -> bool:
            return status.jogging and status.owner == "page"

        async def ended() -> None:
            await until(owner, lambda status: not status.jogging, PATIENCE)

        for end in ("release", "leave", "blur", "stop", "close"):
            await more.hover()
            await page.mouse.down()
            await until(owner, jogging, PATIENCE)
            if end == "release":
                await page.mouse.up()
            elif end == "leave":
                await page.mouse.move(5, 400)
            elif end == "blur":
                await page.evaluate("window.dispatchEvent(new Event('blur'))")
            elif end == "stop":
                await page.keyboard.press("Escape")
            else:
                await page.close()
            await ended()
            if end != "close":
                await page.mouse.up()


async def test_of_two_pages_that_jog_one_moves_the_arm_and_the_other_shows_why_not(
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

        message = pages[1].get_by_text("Another page is jogging the arm").first
        await pages[1].get_by_role("button", name="jog joint2, plus").hover()
        for _ in range(5):  # a busy machine may delay messages, which ends a press
            await pages[0].mouse.down()
            await until(joints, moves(0), PATIENCE)
            await pages[1].mouse.down()
            with suppress(NotInTime):
                await message.wait_for(timeout=5e3)
                break
            await release()
        assert await message.is_visible()
        await release()
        await pages[1].mouse.down()  # the earlier press has ended
        await until(joints, moves(1), PATIENCE)
        await release()


async def test_stuck_server_is_shown_in_a_banner_and_by_stop_until_it_recovers(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await page.get_by_role("button", name="Start").wait_for()
    banner, viewer = page.get_by_role("alert"), cell.processes()["viewer"]
    assert not await banner.is_visible()
    viewer.send_signal(signal.SIGSTOP)
    try:
        await banner.get_by_text("No connection to the page's server").wait_for()
        assert await page.evaluate("document.body.dataset.stale") == "all"
        await page.get_by_role("button", name="STOP").click()
        await page.get_by_role("status").get_by_text("NOT stopped: no connection").wait_for()
        await check_stop(page)
    finally:
        viewer.send_signal(signal.SIGCONT)
    await banner.wait_for(state="hidden")
    assert await page.evaluate("document.body.dataset.stale") == ""
