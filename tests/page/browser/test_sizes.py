"""Every tab at four sizes: the same things are there, none sticks out, and STOP stays where it is."""

from __future__ import annotations

import re
from contextlib import suppress
from typing import TYPE_CHECKING

import pytest

from page.layout import TABS
from tests.page.browser.conftest import IN_BROWSER, Bring, Watched
from tests.page.browser.test_bar import PANDA, SIZES, look
from tests.page.browser.test_panels import NAMELESS, tab

if TYPE_CHECKING:
    from playwright.async_api import Page

pytestmark = IN_BROWSER

# What can be pressed or set in the panel, by the words that are beside it, and what of it sticks out sideways. An event
# can be pressed, too, under the time at which it happened.
CONTROLS = r"""() => {
  const seen = [...document.querySelectorAll("#root button, #root input, #root label, #root [role=tab]")]
    .filter(each => each.offsetParent);
  const words = each => (each.getAttribute("aria-label") || each.textContent || "").trim();
  const out = seen.filter(each => { const at = each.getBoundingClientRect();
    return at.width > 0 && (at.right > innerWidth + 1 || at.left < -1); });
  return {words: [...new Set(seen.map(words).filter(each => each && !/\d\d:\d\d:\d\d$/.test(each)))].sort(),
    out: out.map(each => each.outerHTML.slice(0, 120))};
}"""


async def controls(page: Page, wanted: list[str] | None = None) -> list[str]:
    """The words of what the panel offers; nothing of it sticks out, and all of it has a name.

    What a page that was loaded just now still shows (its own settings, ticks of what the cell does not have) goes as
    the server's messages come: those that are `wanted` are waited for.
    """
    if wanted is not None:
        from playwright.async_api import TimeoutError as NotInTime

        with suppress(NotInTime):  # comparing them tells what differs
            await page.wait_for_function(f"wanted => ({CONTROLS})().words.join() === wanted", arg=",".join(wanted))
    seen = await page.evaluate(CONTROLS)
    assert not seen["out"], seen["out"]
    await page.wait_for_function(f"() => ({NAMELESS})().length === 0")
    return list(seen["words"])


@pytest.mark.timeout(480)  # 32 looks at a page that draws without a graphics card
async def test_every_tab_has_the_same_at_every_size_and_nothing_sticks_out(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    offered: dict[str, list[str]] = {}
    page = await watched.open(cell.address)
    for size, (width, height) in SIZES.items():
        await page.set_viewport_size({"width": width, "height": height})
        await page.reload()
        await page.get_by_role("button", name="Start").wait_for()
        if size == "phone":
            await page.get_by_text(re.compile("Health · ")).click()  # opens the tabs
        for name in TABS:
            await tab(page, name)
            if name == "Cameras":
                await page.get_by_text("What its colours let through", exact=True).wait_for()
                await page.get_by_text("Depth", exact=True).wait_for(state="hidden")  # the cell has none
            await look(page)
            words = await controls(page, offered.get(name))
            assert words, (size, name)
            assert set(words) ^ set(offered.setdefault(name, words)) == set(), (size, name)
    assert not watched.errors
