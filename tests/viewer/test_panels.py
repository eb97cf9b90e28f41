"""What the panels offer: ticks for what the cell has, looking back; and names for readers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.viewer.conftest import IN_BROWSER, Bring, Watched
from tests.viewer.test_bar import PANDA, look

if TYPE_CHECKING:
    from playwright.async_api import Page

pytestmark = IN_BROWSER

# Buttons and fields that are in view without a word that a screen reader could say.
NAMELESS = """() => [...document.querySelectorAll("#zc-bar button, .zc button, #root input, #root select")]
  .filter(each => each.offsetParent && !each.getAttribute("aria-label") && !each.getAttribute("aria-labelledby")
    && !each.textContent.trim() && !(each.labels && each.labels.length) && each.type !== "hidden")
  .map(each => each.outerHTML.slice(0, 160))"""


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
