"""Panels: layers for which the cell has data, the timeline, editing the world, and accessible names."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import pytest

from common import topics
from common.messages import WorldObjects
from page.world_editing import center_of, free_positions
from tests.harness import until
from tests.page.browser.conftest import IN_BROWSER, PATIENCE, Bring, Watched
from tests.page.browser.test_bar import PANDA, check_stop

if TYPE_CHECKING:
    from playwright.async_api import Page

pytestmark = IN_BROWSER

MIDDLE = (0.5, 0.0)  # [m] of the table
CHOSEN = """() => [...document.querySelectorAll('[aria-label="Position [mm]"]')].some(each => Number(each.value))"""

# Visible buttons and fields without an accessible name.
NAMELESS = """() => [...document.querySelectorAll("#zc-bar button, .zc button, #root input, #root select")]
  .filter(each => each.offsetParent && !each.getAttribute("aria-label") && !each.getAttribute("aria-labelledby")
    && !each.textContent.trim() && !(each.labels && each.labels.length) && each.type !== "hidden")
  .map(each => each.outerHTML.slice(0, 160))"""


def positions(truth: WorldObjects) -> dict[str, tuple[float, float]]:
    """Return the position of each object [m], to a tenth of a millimeter."""
    return {thing.id: (round((at := center_of(thing)).x, 4), round(at.y, 4)) for thing in truth.objects}


async def tab(page: Page, name: str) -> None:
    """Open a tab by its name."""
    await page.get_by_role("tab", name=name).or_(page.get_by_text(name, exact=True)).first.click()


async def test_display_of_the_past_is_indicated_in_the_bar(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await page.get_by_role("button", name="Start").wait_for()
    await tab(page, "Time")
    await page.get_by_role("button", name="− 1 s").dispatch_event("click")
    await page.get_by_role("status").get_by_text("Not live: the scene shows").wait_for()
    await check_stop(page)
    await page.get_by_role("button", name="Live", exact=True).dispatch_event("click")
    await page.locator("#zc-past:empty").wait_for(state="attached")
    await check_stop(page)
    assert not watched.errors


async def test_only_layers_and_images_with_data_are_offered(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await tab(page, "View")
    await page.get_by_text("Robot collision shapes", exact=True).wait_for()
    await page.get_by_text("Point cloud", exact=True).wait_for(state="hidden")
    await page.get_by_text("Targets", exact=True).wait_for()
    await tab(page, "Cameras")
    await page.get_by_text("Color mask", exact=True).wait_for()
    await page.get_by_text("Depth image", exact=True).wait_for(state="hidden")


async def test_every_button_and_field_has_an_accessible_name(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await page.get_by_role("button", name="Start").wait_for()
    for name in ("Cameras", "Plots"):
        await tab(page, name)
        await page.wait_for_function("() => document.querySelectorAll('#root input').length > 0")
        await page.wait_for_function(f"() => ({NAMELESS})().length === 0")


async def test_object_is_moved_on_the_page_and_the_move_is_undone(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await page.get_by_role("button", name="Start").wait_for()
    async with cell.listen() as bus:
        world = bus.reader(topics.SCENE_OBJECTS)
        before = await until(world, lambda truth: bool(truth.objects), PATIENCE)
        await tab(page, "View")
        tick = page.get_by_text("Edit simulated world", exact=True)
        await tick.click()
        await page.wait_for_function(CHOSEN)
        fields = page.get_by_label("Position [mm]", exact=True)
        x, y = [1e-3 * float(await field.input_value()) for field in (fields.nth(0), fields.nth(1))]
        there = min(free_positions(x, y, 0.06, before), key=lambda at: math.dist(at, MIDDLE))
        for field, value in zip((fields.nth(0), fields.nth(1)), there, strict=True):
            await field.fill(f"{1e3 * value:.0f}")
            await field.press("Enter")
        await page.get_by_role("button", name="Move object", exact=True).click()
        moved = await until(world, lambda truth: positions(truth) != positions(before), PATIENCE)
        (name,) = [name for name, at in positions(before).items() if positions(moved)[name] != at]
        assert positions(before)[name] == pytest.approx((x, y), abs=1e-3)
        assert positions(moved)[name] == pytest.approx(there, abs=1e-3)
        await page.get_by_role("button", name=f"Undo: move {name}").click()
        await until(world, lambda truth: positions(truth) == positions(before), PATIENCE)
        await tick.click()
