"""What the panels offer: ticks for what the cell has, looking back; and names for readers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import pytest

from common import topics
from common.messages import WorldObjects
from page.world_editing import center_of, free_positions
from tests.harness import until
from tests.page.browser.conftest import IN_BROWSER, PATIENCE, Bring, Watched
from tests.page.browser.test_bar import PANDA, look

if TYPE_CHECKING:
    from playwright.async_api import Page

pytestmark = IN_BROWSER

MIDDLE = (0.5, 0.0)  # [m] of the table
CHOSEN = """() => [...document.querySelectorAll('[aria-label="At [mm]"]')].some(each => Number(each.value))"""

# Buttons and fields that are in view without a word that a screen reader could say.
NAMELESS = """() => [...document.querySelectorAll("#zc-bar button, .zc button, #root input, #root select")]
  .filter(each => each.offsetParent && !each.getAttribute("aria-label") && !each.getAttribute("aria-labelledby")
    && !each.textContent.trim() && !(each.labels && each.labels.length) && each.type !== "hidden")
  .map(each => each.outerHTML.slice(0, 160))"""


def places(told: WorldObjects) -> dict[str, tuple[float, float]]:
    """Where each object lies [m], to a tenth of a millimetre."""
    return {thing.id: (round((at := center_of(thing)).x, 4), round(at.y, 4)) for thing in told.objects}


async def tab(page: Page, name: str) -> None:
    """Open a tab by its name, wherever it is."""
    await page.get_by_role("tab", name=name).or_(page.get_by_text(name, exact=True)).first.click()


async def test_page_looks_back_and_says_so_above_everything(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await page.get_by_role("button", name="Start").wait_for()
    await tab(page, "Time")
    await page.get_by_role("button", name="− 1 s").dispatch_event("click")
    await page.get_by_role("status").get_by_text("Not now: the scene shows").wait_for()
    await look(page)
    await page.get_by_role("button", name="Now", exact=True).dispatch_event("click")
    await page.locator("#zc-past:empty").wait_for(state="attached")
    await look(page)
    assert not watched.errors


async def test_ticks_are_those_of_what_the_cell_has(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await tab(page, "View")
    await page.get_by_text("Robot: collision shapes", exact=True).wait_for()
    await page.get_by_text("Point cloud", exact=True).wait_for(state="hidden")
    await page.get_by_text("Targets", exact=True).wait_for()
    await tab(page, "Cameras")
    await page.get_by_text("What its colours let through", exact=True).wait_for()
    await page.get_by_text("Depth", exact=True).wait_for(state="hidden")


async def test_everything_that_can_be_pressed_or_set_has_a_name(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await page.get_by_role("button", name="Start").wait_for()
    for name in ("Cameras", "Plots"):
        await tab(page, name)
        await page.wait_for_function("() => document.querySelectorAll('#root input').length > 0")
        await page.wait_for_function(f"() => ({NAMELESS})().length === 0")


async def test_object_is_moved_on_the_page_and_that_is_undone(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await page.get_by_role("button", name="Start").wait_for()
    async with cell.listen() as bus:
        world = bus.reader(topics.SCENE_OBJECTS)
        before = await until(world, lambda told: bool(told.objects), PATIENCE)
        await tab(page, "View")
        tick = page.get_by_text("Edit the simulated world", exact=True)
        await tick.click()
        await page.wait_for_function(CHOSEN)
        fields = page.get_by_label("At [mm]", exact=True)
        x, y = [1e-3 * float(await field.input_value()) for field in (fields.nth(0), fields.nth(1))]
        there = min(free_positions(x, y, 0.06, before), key=lambda at: math.dist(at, MIDDLE))
        for field, value in zip((fields.nth(0), fields.nth(1)), there, strict=True):
            await field.fill(f"{1e3 * value:.0f}")
            await field.press("Enter")
        await page.get_by_role("button", name="Move there").click()
        moved = await until(world, lambda told: places(told) != places(before), PATIENCE)
        (name,) = [name for name, at in places(before).items() if places(moved)[name] != at]
        assert places(before)[name] == pytest.approx((x, y), abs=1e-3)
        assert places(moved)[name] == pytest.approx(there, abs=1e-3)
        await page.get_by_role("button", name=f"Undo: move {name}").click()
        await until(world, lambda told: places(told) == places(before), PATIENCE)
        await tick.click()
