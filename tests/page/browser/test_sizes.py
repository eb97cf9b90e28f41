"""Every tab at four sizes: the same elements, none overflows, and STOP stays visible."""

from __future__ import annotations

import re
from contextlib import suppress
from typing import TYPE_CHECKING

import pytest

from page.layout import TABS
from tests.page.browser.conftest import IN_BROWSER, Bring, Watched
from tests.page.browser.test_bar import PANDA, SIZES, check_stop
from tests.page.browser.test_panels import NAMELESS, tab

if TYPE_CHECKING:
    from playwright.async_api import Page

pytestmark = IN_BROWSER

# Labels of all buttons and fields, except events (labeled with their time), and elements that overflow sideways.
CONTROLS = r"""() => {
  const seen = [...document.querySelectorAll("#root button, #root input, #root label, #root [role=tab]")]
    .filter(each => each.offsetParent);
  const words = each => (each.getAttribute("aria-label") || each.textContent || "").trim();
  const out = seen.filter(each => { const at = each.getBoundingClientRect();
    return at.width > 0 && (at.right > innerWidth + 1 || at.left < -1); });
  return {labels: [...new Set(seen.map(words).filter(each => each && !/\d\d:\d\d:\d\d$/.test(each)))].sort(),
    out: out.map(each => each.outerHTML.slice(0, 120))};
}"""


async def controls(page: Page, expected: list[str] | None = None) -> list[str]:
    """Return the labels of the panel; check that nothing overflows and that everything has a name.

    A page that was just loaded shows other elements until the server's messages arrive: wait for `expected`.
    """
    if expected is not None:
        from playwright.async_api import TimeoutError as NotInTime

        with suppress(NotInTime):  # the comparison of the caller shows the difference
            await page.wait_for_function(f"wanted => ({CONTROLS})().labels.join() === wanted", arg=",".join(expected))
    seen = await page.evaluate(CONTROLS)
    assert not seen["out"], seen["out"]
    await page.wait_for_function(f"() => ({NAMELESS})().length === 0")
    return list(seen["labels"])


@pytest.mark.timeout(480)  # 32 checks of a page without a GPU
async def test_every_tab_has_the_same_elements_at_every_size_without_overflow(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    offered: dict[str, list[str]] = {}
    page = await watched.open(cell.address)
    for size, (width, height) in SIZES.items():
        await page.set_viewport_size({"width": width, "height": height})
        await page.reload()
        await page.get_by_role("button", name="Start").wait_for()
        if size == "phone":
            await page.get_by_text(re.compile("Health · ")).click()  # expands the tabs
        for name in TABS:
            await tab(page, name)
            if name == "Cameras":
                await page.get_by_text("Color mask", exact=True).wait_for()
                await page.get_by_text("Depth image", exact=True).wait_for(state="hidden")  # not in this cell
            await check_stop(page)
            labels = await controls(page, offered.get(name))
            assert labels, (size, name)
            assert set(labels) ^ set(offered.setdefault(name, labels)) == set(), (size, name)
    assert not watched.errors
