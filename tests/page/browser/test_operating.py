"""Operating a real cell on its page: task, STOP, jogging, editing of the simulated world, and lost connections."""

from __future__ import annotations

import math
import signal
from typing import TYPE_CHECKING

import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS
from common import topics
from common.messages import JointState, WorldObjects
from common.transport.bus import Reader
from page.world_editing import center_of, free_positions
from tests.harness import until
from tests.page import fake_browser
from tests.page.browser.conftest import IN_BROWSER, PATIENCE, Opened, Viewed
from tests.page.browser.test_sizes import check_stop, tab

if TYPE_CHECKING:
    from playwright.async_api import Page

pytestmark = IN_BROWSER

MOVING = 0.01  # [rad/s]
MIDDLE = (0.5, 0.0)  # [m] of the table
# Whether the fields have the position of the selected object.
SELECTED = """() => [...document.querySelectorAll('[aria-label="Position [mm]"]')].some(each => Number(each.value))"""


def is_moving(state: JointState) -> bool:
    return max(map(abs, state.velocity)) > MOVING


async def assert_standstill(joints: Reader[JointState]) -> None:
    """Wait until the arm has stopped, and check that it does not move for a second."""
    await until(joints, lambda state: not is_moving(state), PATIENCE)
    positions = []
    for _ in range(106):
        positions.append((await joints.next()).position)
    assert positions[-1] == pytest.approx(positions[5], abs=1e-6)


async def test_stop_works_with_the_keyboard_alone(cell: Viewed, page: Page) -> None:
    await page.keyboard.press("Tab")
    assert await page.evaluate("document.activeElement.id") == "zc-stop", "it is the first element"
    async with cell.listen() as bus:
        motion = bus.reader(topics.MOTION_STATUS)
        for key in ("Enter", "Space", "Escape"):
            before = (await until(motion, lambda status: True, PATIENCE)).newest
            await page.keyboard.press(key)
            await until(motion, lambda status, before=before: status.newest > before, PATIENCE)
            await page.get_by_role("status").get_by_text("Stopped by page").wait_for()


async def test_task_is_started_paused_resumed_and_stopped(cell: Viewed, page: Page) -> None:
    async with cell.listen() as bus:
        joints, motion = bus.reader(topics.JOINT_STATES), bus.reader(topics.MOTION_STATUS)
        status = bus.reader(PICK_PLACE_STATUS)
        pause, start = page.get_by_role("button", name="Pause"), page.get_by_role("button", name="Start")
        place = await pause.bounding_box()
        await start.and_(page.locator(":not([aria-disabled])")).click()
        await until(joints, is_moving, PATIENCE)
        await pause.click()
        await until(motion, lambda status: status.held, PATIENCE)
        await assert_standstill(joints)
        await page.locator('[data-part="task"][data-paused="True"]').wait_for(state="attached")
        await page.get_by_text("Press Resume to continue.").wait_for()
        assert await pause.bounding_box() == place, "it must not move under the pointer"
        await page.get_by_role("button", name="Resume").click()
        await until(joints, is_moving, PATIENCE)
        assert not (await until(status, lambda status: not status.paused, PATIENCE)).paused
        await page.locator('[data-part="task"][data-paused="False"][data-held="False"]').wait_for(state="attached")
        await page.get_by_role("button", name="STOP").click()
        stopped = await until(status, lambda status: not status.started, PATIENCE)
        ended = await until(motion, lambda status: status.stopped and status.state != "active", PATIENCE)
        # Unless the stop came between two motions.
        assert ended.state in ("cancelled", "succeeded") and stopped.state != "ERROR"
        await assert_standstill(joints)
        await page.get_by_text("Check the cell, then press Start.").wait_for()


async def test_arm_is_jogged_only_while_the_button_is_held(cell: Viewed, page: Page, opened: Opened) -> None:
    async with cell.listen() as bus, opened() as watched:
        owner = bus.reader(topics.MOTION_OWNER)
        other = await watched.open(cell.address)
        for shown, end in (
            (page, page.mouse.up), (page, lambda: page.mouse.move(5, 400)),
            (page, lambda: page.evaluate("window.dispatchEvent(new Event('blur'))")),
            (page, lambda: page.keyboard.press("Escape")), (other, other.close),
        ):
            await tab(shown, "Move")
            plus = shown.get_by_role("button", name="jog joint1, plus")
            await plus.and_(shown.locator(":not([aria-disabled])")).hover()
            await shown.mouse.down()
            await until(owner, lambda status: status.jogging and status.owner == "page", PATIENCE)
            await end()
            await until(owner, lambda status: not status.jogging, PATIENCE)
            await page.mouse.up()


async def test_stuck_server_is_shown_in_a_banner_and_by_stop_until_it_recovers(cell: Viewed, page: Page) -> None:
    banner, viewer = page.get_by_role("alert"), cell.processes()["viewer"]
    await banner.wait_for(state="hidden")  # a delay of more than a second shows it, too
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
    await page.wait_for_function("document.body.dataset.stale === ''")


def positions(truth: WorldObjects) -> dict[str, tuple[float, float]]:
    """Return the position of each object [m], to a tenth of a millimeter."""
    return {thing.id: (round((at := center_of(thing)).x, 4), round(at.y, 4)) for thing in truth.objects}


async def test_object_is_moved_on_the_page_and_the_move_is_undone(cell: Viewed, page: Page) -> None:
    async with cell.listen() as bus:
        world = bus.reader(topics.SCENE_OBJECTS)
        before = await until(world, lambda truth: bool(truth.objects), PATIENCE)
        await tab(page, "View")
        tick = page.get_by_text("Edit simulated world", exact=True)
        await tick.click()
        await page.wait_for_function(SELECTED)
        fields = [page.get_by_label("Position [mm]", exact=True).nth(axis) for axis in (0, 1)]
        x, y = [1e-3 * float(await field.input_value()) for field in fields]
        there = min(free_positions(x, y, 0.06, before), key=lambda at: math.dist(at, MIDDLE))
        for field, value in zip(fields, there, strict=True):
            await field.fill(f"{1e3 * value:.0f}")
            await field.press("Enter")
        async with fake_browser.opened(cell.port) as other:  # the entered numbers and a press use two connections
            entered = [round(1e3 * value) for value in there]
            await other.until(lambda: other.values[other.label("Position [mm]")] == entered)
        await page.get_by_role("button", name="Move object", exact=True).click()
        moved = await until(world, lambda truth: positions(truth) != positions(before), PATIENCE)
        (name,) = [name for name, at in positions(before).items() if positions(moved)[name] != at]
        assert positions(before)[name] == pytest.approx((x, y), abs=1e-3)
        assert positions(moved)[name] == pytest.approx(there, abs=1e-3)
        await page.get_by_role("button", name=f"Undo: move {name}").click()
        await until(world, lambda truth: positions(truth) == positions(before), PATIENCE)
        await tick.click()
